"""Acceptance of a device: the steps that a person is led through, and checks of what was measured meanwhile.

Each check judges plain figures, as in `share.devices.checks`; `share.runtime.acceptance` measures them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from share.devices.checks import CheckResult, fail, ok, skipped, warn
from share.sensors.profile_types import ImuFacts
from share.types import F64, I64, ImuBatch


@dataclass(frozen=True)
class AcceptanceStep:
    """A task for the person. share: its part of the whole time."""

    name: str
    share: float
    task: str


REST, LOOP, BACK, WORK = "rest", "loop", "back", "work"
STEPS = (
    AcceptanceStep(REST, 0.3, "place the device on a heavy table, camera facing the room; do not touch it"),
    AcceptanceStep(
        LOOP,
        0.2,
        "mark its place; pick it up, walk a loop of at least 10 m, and put it back on the mark",
    ),
    AcceptanceStep(BACK, 0.05, "leave it on the mark"),
    AcceptanceStep(WORK, 0.45, "use it freely: walk, look around, at near and far things"),
)

_ALLAN_S = 0.25  # at which white noise rules, and the interpolation of two streams is averaged out
_STILL_RAD_S = 0.01  # a mean turn of the body over `_ALLAN_S` beyond this is motion
_MOST_MOVED = 0.05  # of the time at rest
_LEAST_REST_S = 5.0
_GRAVITY, _GRAVITY_OFF = 9.81, 0.35  # m/s^2
_RATE_OFF = 0.02  # relative
_MISSING_OK, _MISSING_FAIL = 0.001, 0.01  # of the samples
_NOISE_OK, _NOISE_FAIL, _NOISE_LOW = 1.6, 4.0, 0.3  # ratio to the profile
_LATE_OK, _LATE_FAIL = 0.01, 0.05  # of the frames later than 20 ms
_LOST_OK_S = 0.0
_LEAST_LOOP_M = 5.0
_LOOP_OK, _LOOP_FAIL, _LOOP_M = 0.005, 0.02, 0.02  # of the path, and how well a mark is met
_GROWTH_OK_MB, _FREE_LEAST_MB = 60.0, 300.0
_HOT_C = 90.0
_DRIFT_OK_PPM = 200.0


@dataclass(frozen=True)
class RestNoise:
    """Statistics of an IMU at rest for `seconds`: white noise, u/sqrt(Hz), gyroscope bias (3,), gravity as
    measured, and the share of the time in which it moved."""

    seconds: float
    gyro_density: float
    accel_density: float
    gyro_bias: F64
    gravity: float
    moved: float


def rest_noise(imu: ImuBatch) -> RestNoise | None:
    """Return the noise of samples at rest; None if they are too few.

    White noise N = sigma(tau) sqrt(tau), the Allan deviation of means over tau = 0.25 s (IEEE Std 952), here
    from medians, so that a push does not count.
    """
    if len(imu) < 2 or (seconds := float(imu.stamps_ns[-1] - imu.stamps_ns[0]) * 1e-9) < _LEAST_REST_S:
        return None
    number = ((imu.stamps_ns - imu.stamps_ns[0]) * 1e-9 / _ALLAN_S).astype(np.int64)
    count = np.bincount(number)
    means = [_means(values, number, count) for values in (imu.gyro, imu.accel)]
    gyro, accel = means
    turn = np.abs(gyro - np.median(gyro, axis=0)).max(axis=1)
    return RestNoise(
        seconds,
        _density(gyro),
        _density(accel),
        np.median(gyro, axis=0),
        float(np.linalg.norm(np.median(accel, axis=0))),
        float((turn > _STILL_RAD_S).mean()),
    )


def _means(values: F64, number: I64, count: I64) -> F64:
    """Return the means (M, 3) of values (N, 3) over the parts that they are in, without nearly empty ones."""
    full = count > 0.5 * np.median(count)
    sums = np.stack([np.bincount(number, axis, len(count)) for axis in values.T], axis=1)
    return np.asarray(sums[full] / count[full, None])


def _density(means: F64) -> float:
    """Return the white noise, rms of the axes, of means over `_ALLAN_S`."""
    steps = np.abs(np.diff(means, axis=0))
    sigma = np.median(steps, axis=0) / 0.6745 / math.sqrt(2)
    return float(np.sqrt((sigma**2).mean() * _ALLAN_S))


# Checks


def check_rest(noise: RestNoise | None) -> CheckResult:
    if noise is None:
        return fail("rest", "too few IMU samples at rest", "look at the IMU in `share doctor`, and repeat")
    what = f"{noise.seconds:.0f} s, gravity {noise.gravity:.2f} m/s^2"
    if noise.moved > _MOST_MOVED:
        where = "put it on something heavy that nobody touches, and repeat"
        return fail("rest", f"it moved for {100 * noise.moved:.0f} % of {noise.seconds:.0f} s", where)
    if abs(noise.gravity - _GRAVITY) > _GRAVITY_OFF:
        return fail(
            "rest", f"{what}, not {_GRAVITY:g}", "the accelerometer's scale or bias is off: another unit"
        )
    return ok("rest", what)


def check_noise(noise: RestNoise | None, stated: ImuFacts) -> list[CheckResult]:
    """Compare noise at rest with the profile's."""
    if noise is None or noise.moved > _MOST_MOVED:
        return []
    both = (
        ("gyroscope noise", noise.gyro_density, stated.gyro.density, "rad/s/sqrt(Hz)"),
        ("accelerometer noise", noise.accel_density, stated.accel.density, "m/s^2/sqrt(Hz)"),
    )
    bias, limit = float(np.abs(noise.gyro_bias).max()), 3 * stated.gyro.start_bias
    text = f"{bias:.4f} rad/s at most"
    advice = "odometry finds it; if it grows, let the device get warm before use"
    return [
        *(_noise_check(*one) for one in both),
        ok("gyroscope bias", text)
        if bias <= limit
        else warn("gyroscope bias", f"{text}, the profile says {limit:.4f} (3 sigma)", advice),
    ]


def _noise_check(name: str, found: float, stated: float, unit: str) -> CheckResult:
    ratio = found / stated
    what = f"{found:.2g} {unit}, {ratio:.2f} of the profile's"
    if ratio < _NOISE_LOW:
        return warn(name, what, "smoother than its sensor: are samples repeated or filtered?")
    if ratio <= _NOISE_OK:
        return ok(name, what)
    measure = (
        "share capture --imu-only --seconds 600 --out rest.mcap",
        "share calibrate imu rest.mcap --out DIR  # and track with --calib DIR",
    )
    return fail(name, what, *measure) if ratio > _NOISE_FAIL else warn(name, what, *measure)


def check_rates(found_hz: Mapping[str, float], stated_hz: Mapping[str, float]) -> list[CheckResult]:
    """Compare the rate of each stream with that asked for."""
    results = []
    for name, stated in stated_hz.items():
        found = found_hz.get(name, 0.0)
        what = f"{found:.1f} Hz of {stated:g} Hz"
        if found and abs(found / stated - 1) <= _RATE_OFF:
            results.append(ok(f"{name} rate", what))
        else:
            results.append(
                fail(
                    f"{name} rate",
                    what,
                    "another USB 3 port or cable; in dim light set the exposure shorter (docs/do/record.md)",
                )
            )
    return results


def check_losses(samples: int, missing: int, dropped: int) -> CheckResult:
    """missing: that the device numbered but did not deliver. dropped: that came too fast to be used."""
    share = (missing + dropped) / max(1, samples + missing)
    what = f"{missing} missing, {dropped} dropped of {samples + missing} ({100 * share:.3g} %)"
    mend = (
        "missing: USB cable, port, usbfs_memory_mb (`share doctor`)",
        "dropped: this computer is too slow or busy: a lower --mode, or fewer programs",
    )
    if share <= _MISSING_OK:
        return ok("samples lost", what)
    return (fail if share > _MISSING_FAIL else warn)("samples lost", what, *mend)


def check_device_clock(drift_ppm: float | None) -> CheckResult:
    """drift_ppm: of the device's clock against this computer's."""
    if drift_ppm is None:
        return warn("device clock", "too few images came to compare it with this computer's", "repeat")
    what = f"{drift_ppm:+.1f} ppm from this computer's"
    if abs(drift_ppm) <= _DRIFT_OK_PPM:
        return ok("device clock", what)
    return warn("device clock", what, "latencies and the truth of field recordings suffer: share sync check")


def check_tracking(frames: int, tracked: int, lost_s: float, first_pose_s: float | None) -> CheckResult:
    what = f"{tracked} of {frames} frames with a pose, lost for {lost_s:.1f} s"
    if first_pose_s is None:
        return fail(
            "tracking", f"no pose in {frames} frames", "light, texture, calibration: share track --view"
        )
    what += f", the first after {first_pose_s:.1f} s"
    if lost_s > _LOST_OK_S:
        mend = "more light and texture, slower turns; check --calib: share track realsense --view"
        return (fail if lost_s > 1.0 else warn)("tracking", what, mend)
    return ok("tracking", what)


def check_latency(p50_ms: float | None, p95_ms: float | None, over_20ms: float | None) -> CheckResult:
    """over_20ms: share of the frames with a pose later than that."""
    if p50_ms is None or p95_ms is None or over_20ms is None:
        return fail("pose latency", "no frame came")
    what = f"p50 {p50_ms:.1f} ms, p95 {p95_ms:.1f} ms, {100 * over_20ms:.3g} % over 20 ms"
    if over_20ms <= _LATE_OK:
        return ok("pose latency", what)
    mend = "CPU governor, heat and other programs (`share doctor`); else a lower --mode"
    return (fail if over_20ms > _LATE_FAIL else warn)("pose latency", what, mend)


def check_loop(path_m: float, closing_m: float | None, is_one_segment: bool) -> CheckResult:
    """path_m: length of the loop. closing_m: from its start to its end, which are one place; None if either
    is not known."""
    if closing_m is None:
        return fail("loop", "no pose at its start or end", "see `tracking`")
    if not is_one_segment:
        return fail("loop", "tracking began anew on the way", "see `tracking`")
    what = f"{100 * closing_m:.1f} cm from its start after {path_m:.1f} m"
    if path_m < _LEAST_LOOP_M:
        return warn("loop", what, f"walk {_LEAST_LOOP_M:g} m or more, and set it back on its mark")
    calibrate = (
        "was it set back on its mark?",
        "share calibrate camera, imu, camera-imu; give the folder with --calib",
    )
    if closing_m <= _LOOP_OK * path_m + _LOOP_M:
        return ok("loop", what)
    return (fail if closing_m > _LOOP_FAIL * path_m + _LOOP_M else warn)("loop", what, *calibrate)


# This computer


@dataclass(frozen=True)
class HostSample:
    """This computer at a time. cpu_s: of this process. own_mb: its memory. free_mb: that it could still take.
    throttled: how often heat slowed a core since the start. hottest_c: of all sensors. None: not shown."""

    t_s: float
    cpu_s: float
    own_mb: float
    free_mb: float | None
    throttled: int | None
    hottest_c: float | None


def check_host(samples: Sequence[HostSample], cores: int) -> list[CheckResult]:
    """Judge samples in order of time."""
    if len(samples) < 2:
        return [fail("computer", "too short a time to judge it", "repeat, with more --minutes")]
    first, last = samples[0], samples[-1]
    busy = (last.cpu_s - first.cpu_s) / max(1e-9, last.t_s - first.t_s)
    cpu = f"{100 * busy:.0f} % of a core, of {cores}"
    settled = samples[len(samples) // 4]  # after what is loaded once
    grown_mb = last.own_mb - settled.own_mb
    memory = f"{last.own_mb:.0f} MB, {grown_mb:+.0f} MB since {settled.t_s - first.t_s:.0f} s"
    free_mb = min((one.free_mb for one in samples if one.free_mb is not None), default=None)
    if free_mb is not None:
        memory += f", {free_mb:.0f} MB free"
    is_short = free_mb is not None and free_mb < _FREE_LEAST_MB
    return [
        ok("processor", cpu)
        if busy < 0.5 * cores
        else warn("processor", cpu, "an edge or an app beside it will not fit"),
        fail("memory", memory, "end other programs")
        if is_short
        else ok("memory", memory)
        if grown_mb <= _GROWTH_OK_MB
        else warn("memory", memory, "it grew: report this file"),
        _check_heat(samples),
    ]


def _check_heat(samples: Sequence[HostSample]) -> CheckResult:
    counts = [one.throttled for one in samples if one.throttled is not None]
    hottest_c = max((one.hottest_c for one in samples if one.hottest_c is not None), default=None)
    temperature = "" if hottest_c is None else f", {hottest_c:.0f} °C at most"
    cool = "cool it better: fan, dust, air; or a lower --mode"
    if counts and counts[-1] > counts[0]:
        return fail("heat", f"slowed {counts[-1] - counts[0]} times{temperature}", cool)
    if hottest_c is not None and hottest_c > _HOT_C:
        return warn("heat", f"never slowed{temperature}", cool)
    if not counts and hottest_c is None:
        return skipped("heat", "this computer shows neither its heat nor throttling")
    return ok("heat", ("never slowed" if counts else "throttling is not shown") + temperature)
