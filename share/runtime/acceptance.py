"""`share doctor --acceptance`: track a device while a person goes through the steps, and judge the results.

The time is that of the source, so that a recording of the same steps is judged alike.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from share.config import Config
from share.devices import acceptance as judge
from share.devices import host as facts
from share.devices.acceptance import BACK, LOOP, REST, STEPS, AcceptanceStep, HostSample, RestNoise
from share.devices.checks import CheckResult
from share.metrics.frame_log import latency
from share.net import tcp
from share.recordings.recording import Source
from share.runtime.offline_tracking import OfflineFrame, track
from share.sensors.measurement import CAM0, CAM1, IMU
from share.sensors.profile_types import Profile
from share.sensors.sample_processor import ACCEL, GYRO
from share.types import F64, ImuBatch

_SETTLE = 0.1  # of the time at rest, at its start, before it counts
_STANDING_S = 2.0  # whose mean position is that of the mark
_HOST_PERIOD_S = 5.0
_PATH_STEP_M = 0.05  # of the length of a path, so that noise adds nothing
_SHOW_PERIOD_S = 1.0
_LEAST_ARRIVALS = 100  # for the drift of the device's clock


@dataclass(frozen=True)
class AcceptanceLine:
    """The status shown while it runs."""

    step: str
    left_s: float
    frames: int
    state: str
    track_ms: float

    def __str__(self) -> str:
        minutes, seconds = divmod(round(self.left_s), 60)
        pose = f"{self.state}, pose after {self.track_ms:.1f} ms"
        return f"{self.step}: {minutes}:{seconds:02} left   {self.frames} frames   {pose}"


@dataclass
class _Pause:
    """The positions (3,) of the last seconds of a time at rest, with their stamps."""

    stamps_ns: list[int] = field(default_factory=list)
    positions: list[F64] = field(default_factory=list)
    segment: int = -1

    def mark(self) -> F64 | None:
        """Return the mean position (3,); None without a pose."""
        if not self.positions:
            return None
        since_ns = self.stamps_ns[-1] - int(_STANDING_S * 1e9)
        late = [p for stamp, p in zip(self.stamps_ns, self.positions, strict=True) if stamp >= since_ns]
        return np.asarray(np.mean(late, axis=0))


class AcceptanceRun:
    """Collects the measurements. tell: is called with a line for the person. show: with the live line.

    arrived_ns: returns the arrival of a live camera's image by its stamp, monotonic; None for a recording.
    """

    def __init__(
        self,
        seconds: float,
        tell: Callable[[str], None],
        show: Callable[[AcceptanceLine], None] = lambda line: None,
        on_end: Callable[[], None] = lambda: None,
        arrived_ns: Callable[[int], int] | None = None,
    ) -> None:
        self._seconds, self._tell, self._show, self._on_end = seconds, tell, show, on_end
        self._arrived_ns = arrived_ns
        self._begin_ns: int | None = None
        self._step: AcceptanceStep | None = None
        self._frames, self._segment, self._shown_s = 0, -1, -_SHOW_PERIOD_S
        self._imu_first_ns, self._imu_last_ns, self._imu_samples = 0, 0, 0
        self._last_ns = 0
        self._rest_imu: list[ImuBatch] = []
        self._pauses = {REST: _Pause(), BACK: _Pause()}
        self._path_m = 0.0
        self._path_end: F64 | None = None
        self._arrivals: list[tuple[int, int]] = []  # stamp and arrival, ns
        self._pose_ms: list[float] = []  # from arrival
        self.host: list[HostSample] = []

    # ------------------------------------------------------------------ while it runs

    def add(self, step: OfflineFrame) -> None:
        """Add a frame."""
        frame, result = step.frame, step.result
        if self._begin_ns is None:
            self._begin_ns = frame.stamp_ns
        self._last_ns = frame.stamp_ns
        self._frames += 1
        self._segment += result.new_segment
        t_s = (frame.stamp_ns - self._begin_ns) * 1e-9
        if self._arrived_ns is not None:
            self._add_arrival(step, self._arrived_ns(frame.stamp_ns))
        self._count_imu(frame.imu)
        part, left_s, done = self._step_at(t_s)
        self._enter(part)
        if part.name == REST and done > _SETTLE:
            self._rest_imu.append(frame.imu)
        if result.T_odom_body is not None:
            self._add_position(part.name, frame.stamp_ns, result.T_odom_body[:3, 3])
        if not self.host or t_s - self.host[-1].t_s >= _HOST_PERIOD_S:
            self.host.append(_host_sample(t_s))
        if t_s - self._shown_s >= _SHOW_PERIOD_S:
            self._shown_s = t_s
            self._show(AcceptanceLine(part.name, left_s, self._frames, str(result.state), 1e3 * step.track_s))
        if t_s >= self._seconds:
            self._on_end()

    def _add_arrival(self, step: OfflineFrame, arrived_ns: int) -> None:
        self._arrivals.append((step.frame.stamp_ns, arrived_ns))
        after_pose_ms = 1e3 * (step.total_s - step.track_s)
        self._pose_ms.append((time.monotonic_ns() - arrived_ns) * 1e-6 - after_pose_ms)

    def _step_at(self, t_s: float) -> tuple[AcceptanceStep, float, float]:
        """Return the step at a time, what is left of it, s, and the share of it that is done."""
        begin_s = 0.0
        for step in STEPS:
            length_s = step.share * self._seconds
            if t_s < begin_s + length_s or step is STEPS[-1]:
                return step, max(0.0, begin_s + length_s - t_s), (t_s - begin_s) / length_s
            begin_s += length_s
        raise AssertionError("there is always a last step")

    def _enter(self, step: AcceptanceStep) -> None:
        if step is not self._step:
            self._step = step
            number, length_s = STEPS.index(step) + 1, step.share * self._seconds
            self._tell(f"{number} of {len(STEPS)}, {length_s:.0f} s: {step.task}")

    def _count_imu(self, imu: ImuBatch) -> None:
        if len(imu):
            if not self._imu_samples:
                self._imu_first_ns = int(imu.stamps_ns[0])
            self._imu_last_ns = int(imu.stamps_ns[-1])
            self._imu_samples += len(imu)

    def _add_position(self, name: str, stamp_ns: int, position: F64) -> None:
        if name in self._pauses:
            pause = self._pauses[name]
            pause.stamps_ns.append(stamp_ns)
            pause.positions.append(position)
            pause.segment = self._segment
        if name == LOOP:
            if self._path_end is None:
                self._path_end = position
            step_m = float(np.linalg.norm(position - self._path_end))
            if step_m >= _PATH_STEP_M:
                self._path_m, self._path_end = self._path_m + step_m, position

    # ------------------------------------------------------------------ afterwards

    def rest(self) -> RestNoise | None:
        """Return the IMU's noise at rest."""
        return judge.rest_noise(ImuBatch.empty().concatenate(*self._rest_imu))

    def findings(self, report: Mapping[str, Any], profile: Profile) -> list[CheckResult]:
        """Judge the run. report: of `track`."""
        noise, camera = self.rest(), report.get("camera")
        start, end = (self._pauses[name] for name in (REST, BACK))
        a, b = start.mark(), end.mark()
        closing_m = None if a is None or b is None else float(np.linalg.norm(b - a))
        pose = latency(self._pose_ms, []) if self._pose_ms else None
        track_ms = report["track_ms"] if pose is None else pose.track_ms.report()
        over_20ms = report["over_20ms"] if pose is None else pose.over_20ms
        return [
            *self._stream_findings(camera, profile),
            judge.check_rest(noise),
            *judge.check_noise(noise, profile.device.imu),
            judge.check_tracking(report["frames"], report["tracked"], report["lost_s"], report["init_s"]),
            judge.check_loop(self._path_m, closing_m, start.segment == end.segment),
            judge.check_latency(track_ms["p50"], track_ms["p95"], over_20ms),
            *judge.check_host(self.host, facts.core_count()),
        ]

    def _stream_findings(self, camera: Mapping[str, Any] | None, profile: Profile) -> list[CheckResult]:
        """camera: the report of a live one; None of a recording."""
        imu = profile.device.imu
        if camera is None:
            return judge.check_rates(self.rates_hz(), {CAM0: profile.rate_hz, IMU: imu.gyro.rate_hz})
        stated_hz = {
            CAM0: profile.rate_hz,
            CAM1: profile.rate_hz,
            GYRO: imu.gyro.rate_hz,
            ACCEL: imu.accel.rate_hz,
        }
        streams = camera["streams"]
        found_hz = {name: one["samples"] / (one["seconds"] or 1e9) for name, one in streams.items()}
        return [
            *judge.check_rates(found_hz, {name: hz for name, hz in stated_hz.items() if name in streams}),
            _losses(streams),
            judge.check_device_clock(self.clock_drift_ppm()),
        ]

    def rates_hz(self) -> dict[str, float]:
        """Return the rates that came."""
        spans_s = {CAM0: (self._last_ns - (self._begin_ns or 0)) * 1e-9}
        spans_s[IMU] = (self._imu_last_ns - self._imu_first_ns) * 1e-9
        counts = {CAM0: self._frames, IMU: self._imu_samples}
        return {name: (counts[name] - 1) / span if span > 0 else 0.0 for name, span in spans_s.items()}

    def clock_drift_ppm(self) -> float | None:
        """Return how much faster the device's clock is than this computer's: slope of the earliest arrivals.

        In each tenth of the time the least delay counts; those of the others are waiting."""
        if len(self._arrivals) < _LEAST_ARRIVALS:
            return None
        stamps, arrivals = np.array(self._arrivals, np.float64).T
        delay, part = arrivals - stamps, (np.arange(len(stamps)) * 10 // len(stamps))
        least = [int(np.flatnonzero(part == k)[np.argmin(delay[part == k])]) for k in range(10)]
        slope = np.polyfit(arrivals[least] - arrivals[0], stamps[least] - stamps[0], 1)[0]
        return float((slope - 1) * 1e6)

    def measured(self) -> dict[str, Any]:
        """Return the figures behind the findings, as plain data."""
        noise = self.rest()
        rest = None if noise is None else {**asdict(noise), "gyro_bias": noise.gyro_bias.tolist()}
        return {
            "rates_hz": self.rates_hz(),
            "clock_drift_ppm": self.clock_drift_ppm(),
            "rest": rest,
            "loop_m": self._path_m,
            "computer": [asdict(one) for one in self.host],
        }


def _losses(streams: Mapping[str, Mapping[str, Any]]) -> CheckResult:
    samples, missing, dropped = (
        sum(int(one[key]) for one in streams.values()) for key in ("samples", "missing", "dropped")
    )
    return judge.check_losses(samples, missing, dropped)


def _host_sample(t_s: float) -> HostSample:
    free, counts = facts.free_memory_bytes(), facts.throttle_counts()
    return HostSample(
        t_s,
        time.process_time(),
        tcp.resident_bytes() / 1e6,
        None if free is None else free / 1e6,
        sum(counts) if counts else None,
        facts.hottest_celsius(),
    )


def accept_device(
    source: Source,
    settings: Config,
    profile: Profile,
    run: AcceptanceRun,
    notify: Callable[[str], None],
) -> tuple[list[CheckResult], dict[str, Any]]:
    """Track the source until the run's `on_end` has stopped it. Return the findings and the figures behind
    them.

    Raises UsageError where no tracker fits the rig.
    """
    output = track(source, settings, lambda result: None, notify, run.add)
    report = {name: value for name, value in output.report.items() if name != "config"}
    return run.findings(report, profile), {**run.measured(), "tracking": report}
