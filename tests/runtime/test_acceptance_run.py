"""The steps of `share doctor --acceptance` over a recording: at rest, a loop, back, use."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from share.config import Config
from share.devices.acceptance import STEPS
from share.odometry.track_result import TrackResult
from share.runtime.acceptance import AcceptanceLine, AcceptanceRun, accept_device
from share.runtime.offline_tracking import OfflineFrame
from share.runtime.source import open_source
from share.sensors.profile import load_profile
from share.types import Frame, ImuBatch, TrackState

PROFILE = load_profile("d435i", "640x480@15")
RATE_HZ, SECONDS = 15.0, 60.0


def position(t_s: float) -> np.ndarray:
    """At rest for 18 s, a circle of 2 m for 12 s, back within a centimetre, then on."""
    turn = np.clip((t_s - 18.0) / 12.0, 0.0, 1.0) * 2 * np.pi
    drift = 0.01 * np.clip((t_s - 18.0) / 12.0, 0.0, 1.0)
    on = max(0.0, t_s - 33.0)
    return np.array([2 * np.sin(turn) + drift, 2 - 2 * np.cos(turn), 0.1 * on])


def frame(k: int, segment_at: int = 0) -> OfflineFrame:
    t_ns = 10**9 + int(k / RATE_HZ * 1e9)
    rng = np.random.default_rng(k)
    n = 26
    stamps = t_ns - (np.arange(n)[::-1] * int(1e9 / RATE_HZ / n))
    imu = ImuBatch(
        stamps.astype(np.int64),
        2.4435e-4 * 20 * rng.standard_normal((n, 3)),
        np.array([0.0, -9.81, 0.0]) + 1.47e-3 * 20 * rng.standard_normal((n, 3)),
    )
    T = np.eye(4)
    T[:3, 3] = position(k / RATE_HZ)
    image = np.zeros((4, 4), np.uint8)
    result = TrackResult(TrackState.OK, T, new_segment=k == segment_at)
    return OfflineFrame(Frame(t_ns, k, image, imu=imu), result, None, None, 0.005, 0.006, 0.004)


REPORT = {
    "frames": 900,
    "tracked": 895,
    "lost_s": 0.0,
    "init_s": 0.3,
    "track_ms": {"p50": 5.0, "p95": 9.0},
    "over_20ms": 0.0,
}


def played(**kinds: int) -> tuple[dict[str, str], list[str], list[AcceptanceLine]]:
    said: list[str] = []
    shown: list[AcceptanceLine] = []
    ends: list[None] = []
    run = AcceptanceRun(SECONDS, said.append, shown.append, lambda: ends.append(None))
    for k in range(903):
        run.add(frame(k, **kinds))
    assert ends  # it ends itself
    found = {one.name: one.state.value for one in run.findings(REPORT, PROFILE)}
    return found, said, shown


def test_a_good_device_passes() -> None:
    found, said, shown = played()
    assert len(said) == len(STEPS) and "do not touch it" in said[0]
    assert {one.step for one in shown} == {step.name for step in STEPS}
    assert "rest: 0:1" in str(shown[2])
    judged = {
        *("rest", "gyroscope noise", "accelerometer noise", "gyroscope bias", "tracking", "loop"),
        *("pose latency", "cam0 rate"),
    }
    assert {found[name] for name in judged} == {"OK"}, found


def test_a_new_segment_on_the_way_fails_the_loop() -> None:
    found, _, _ = played(segment_at=400)
    assert found["loop"] == "FAIL"


@pytest.mark.long
def test_a_recording_is_judged(plain_session: Path) -> None:
    """All that is asked of a camera is asked of a recording too, which walks from the start."""
    source = open_source(f"{plain_session}/ar1")
    run = AcceptanceRun(3.0, lambda text: None)
    findings, figures = accept_device(source, Config(), PROFILE, run, lambda text: None)
    found = {one.name: one for one in findings}
    assert found["cam0 rate"].state.value == "OK", found["cam0 rate"]
    assert found["tracking"].state.value == "OK", found["tracking"]
    assert found["rest"].state.value == "FAIL"  # too short, and it moves
    assert figures["tracking"]["frames"] == 45 and len(figures["computer"]) >= 1


def test_the_device_clock_is_compared_with_the_earliest_arrivals() -> None:
    """It gains 50 ppm; images come up to 30 ms late, and nobody hears of those that wait."""
    rng = np.random.default_rng(2)

    def arrived_ns(stamp_ns: int) -> int:
        return int((stamp_ns - 10**9) * (1 - 50e-6)) + 10**12 + int(rng.exponential(10e6))

    run = AcceptanceRun(SECONDS, lambda text: None, arrived_ns=arrived_ns)
    assert run.clock_drift_ppm() is None
    for k in range(900):
        run.add(frame(k))
    assert run.clock_drift_ppm() == pytest.approx(50, abs=15)
