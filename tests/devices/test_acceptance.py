"""Acceptance of a device: noise at rest from known noise, and each check on both sides of its limit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from share.devices import acceptance as judge
from share.devices.acceptance import STEPS, HostSample
from share.devices.checks import CheckResult
from share.sensors.profile import load_profile
from share.types import ImuBatch

FACTS = load_profile("d435i").device.imu
RATE_HZ, SECONDS = 400, 120


def at_rest(gyro: float, accel: float, seed: int, seconds: float = SECONDS) -> ImuBatch:
    """Samples with white noise of these densities and a bias."""
    rng, n = np.random.default_rng(seed), int(seconds * RATE_HZ)
    stamps = (np.arange(n) * 10**9 // RATE_HZ).astype(np.int64)
    root = math.sqrt(RATE_HZ)
    turns = 0.003 + gyro * root * rng.standard_normal((n, 3))
    force = np.array([0.1, -9.8, 0.2]) + accel * root * rng.standard_normal((n, 3))
    return ImuBatch(stamps, turns, force)


def state(result: CheckResult) -> str:
    return result.state.value


@pytest.mark.parametrize("seed", range(5))
def test_noise_at_rest_is_found_to_some_percent(seed: int) -> None:
    noise = judge.rest_noise(at_rest(2.4e-4, 1.5e-3, seed))
    assert noise is not None
    assert noise.gyro_density == pytest.approx(2.4e-4, rel=0.12)
    assert noise.accel_density == pytest.approx(1.5e-3, rel=0.12)
    assert noise.moved == 0.0
    assert noise.gravity == pytest.approx(np.linalg.norm([0.1, 9.8, 0.2]), abs=0.01)
    assert state(judge.check_rest(noise)) == "OK"
    assert {state(one) for one in judge.check_noise(noise, FACTS)} == {"OK"}


def test_a_push_does_not_count_and_a_walk_fails() -> None:
    imu = at_rest(2.4e-4, 1.5e-3, 1)
    pushed, carried = imu.gyro.copy(), imu.gyro.copy()
    pushed[4000:4200] += 0.5
    carried[20000:30000, 1] += 0.3
    noise = judge.rest_noise(replace(imu, gyro=pushed))
    assert noise is not None and noise.gyro_density == pytest.approx(2.4e-4, rel=0.12)
    assert state(judge.check_rest(noise)) == "OK"
    moved = judge.rest_noise(replace(imu, gyro=carried))
    assert moved is not None and state(judge.check_rest(moved)) == "FAIL"
    assert judge.check_noise(moved, FACTS) == []


def test_too_short_a_rest_fails() -> None:
    assert judge.rest_noise(ImuBatch.empty()) is None
    assert judge.rest_noise(at_rest(1e-4, 1e-3, 0, seconds=1.0)) is None
    assert state(judge.check_rest(None)) == "FAIL"


@pytest.mark.parametrize(("times", "expected"), [(0.1, "WARN"), (1.0, "OK"), (2.5, "WARN"), (8.0, "FAIL")])
def test_noise_is_judged_by_the_profile(times: float, expected: str) -> None:
    noise = judge.rest_noise(at_rest(times * FACTS.gyro.density, FACTS.accel.density, 3))
    gyro, accel, _ = judge.check_noise(noise, FACTS)
    assert (state(gyro), state(accel)) == (expected, "OK")


@pytest.mark.parametrize(("hz", "expected"), [(30.0, "OK"), (29.5, "OK"), (27.0, "FAIL"), (0.0, "FAIL")])
def test_rates(hz: float, expected: str) -> None:
    (result,) = judge.check_rates({"cam0": hz}, {"cam0": 30.0})
    assert state(result) == expected
    assert bool(result.fix) == (expected != "OK")


@pytest.mark.parametrize(("missing", "expected"), [(0, "OK"), (9, "OK"), (50, "WARN"), (500, "FAIL")])
def test_losses(missing: int, expected: str) -> None:
    assert state(judge.check_losses(10_000, missing, 0)) == expected
    assert state(judge.check_losses(10_000, 0, missing)) == expected


@pytest.mark.parametrize(
    ("path_m", "closing_m", "one", "expected"),
    [
        (20.0, 0.05, True, "OK"),
        (20.0, 0.2, True, "WARN"),
        (20.0, 0.9, True, "FAIL"),
        (1.0, 0.0, True, "WARN"),
        (20.0, None, True, "FAIL"),
        (20.0, 0.05, False, "FAIL"),
    ],
)
def test_the_loop_closes(path_m: float, closing_m: float | None, one: bool, expected: str) -> None:
    assert state(judge.check_loop(path_m, closing_m, one)) == expected


@pytest.mark.parametrize(("over", "expected"), [(0.0, "OK"), (0.03, "WARN"), (0.2, "FAIL")])
def test_latency(over: float, expected: str) -> None:
    assert state(judge.check_latency(8.0, 14.0, over)) == expected
    assert state(judge.check_latency(None, None, None)) == "FAIL"


def samples(**changes: float | None) -> list[HostSample]:
    """Two minutes; `changes` of the last sample."""
    same = HostSample(0.0, 0.0, 200.0, 2000.0, 0, 60.0)
    before = [replace(same, t_s=t, cpu_s=0.4 * t) for t in range(0, 120, 5)]
    return [*before, replace(before[-1], t_s=120.0, cpu_s=48.0, **changes)]


@pytest.mark.parametrize(
    ("change", "bad"),
    [
        ({}, {}),
        ({"cpu_s": 400.0}, {"processor": "WARN"}),
        ({"own_mb": 400.0}, {"memory": "WARN"}),
        ({"free_mb": 100.0}, {"memory": "FAIL"}),
        ({"throttled": 3}, {"heat": "FAIL"}),
        ({"hottest_c": 97.0}, {"heat": "WARN"}),
    ],
)
def test_the_computer(change: dict[str, float], bad: dict[str, str]) -> None:
    made = samples(**{name: value for name, value in change.items() if name != "cpu_s"})
    if "cpu_s" in change:
        made[-1] = replace(made[-1], cpu_s=change["cpu_s"])
    found = {one.name: state(one) for one in judge.check_host(made, cores=4)}
    assert found == {"processor": "OK", "memory": "OK", "heat": "OK"} | bad


def test_the_steps_are_all_of_the_time() -> None:
    assert sum(step.share for step in STEPS) == pytest.approx(1.0)
