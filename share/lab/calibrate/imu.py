"""Characteristics of an IMU from a recording at rest: rate, gaps, biases and noise of each axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.errors import DataError
from share.lab.calibrate.allan import AllanCurve, allan_deviation
from share.lab.calibrate.imu_noise import AxisNoise, NoiseEstimate, combine_axes, fit_noise
from share.types import F64, I64, ImuBatch

# Detection of rest by the sensor's own noise: at rest the means of neighbouring seconds differ by little more
# than white noise explains; a hand, or a step beside the table, moves them far more. No data sheet is needed.

WINDOW_S = 1.0
MIN_REST_S = 60.0
STANDARD_GRAVITY = 9.80665  # m/s^2
_QUIET_QUANTILE = 0.2  # the quietest fifth gives the sensor's noise
_MAX_NOISE_SCALE = 2.0  # times that noise within a second: more is a knock
_MAX_SHIFT_SIGMAS = 6.0  # standard errors of the difference of two means
# Largest scatter of means over that of successive samples: a sensor's filter hides their white noise.
_MAX_SMOOTHING = 6.0
_MARGIN_WINDOWS = 2  # around a disturbance, left out too
_MAX_GYRO_NOISE = 0.05  # rad/s: noisier than any IMU at rest
_MAX_ACCEL_NOISE = 0.5  # m/s^2, likewise


def find_rest(imu: ImuBatch, rate_hz: float) -> slice:
    """Return the longest run of samples at rest, in whole seconds.

    Raises DataError if that is less than a minute.
    """
    n = round(WINDOW_S * rate_hz)
    is_calm = _calm_windows(imu.gyro, n, _MAX_GYRO_NOISE) & _calm_windows(imu.accel, n, _MAX_ACCEL_NOISE)
    start, end = _longest_run(is_calm)
    if end - start < MIN_REST_S:
        raise DataError(
            f"IMU: at rest for {end - start} s of {len(is_calm)} s, at least {MIN_REST_S:.0f} s are needed; "
            "put the device on a stone floor or a heavy table, start recording, and do not touch it"
        )
    return slice(start * n, len(imu) if end == len(is_calm) else end * n)


def _calm_windows(values: F64, n: int, max_noise: float) -> np.ndarray:
    """Return (W,) bool: windows of n samples of values (N, 3) as calm as the quietest, and not near
    disturbed ones."""
    count = len(values) // n
    windows = values[: count * n].reshape(count, n, 3)
    noise = windows.std(axis=1)
    quiet_noise = np.quantile(noise, _QUIET_QUANTILE, axis=0) if count else np.zeros(3)
    is_disturbed = ((noise > _MAX_NOISE_SCALE * quiet_noise) | (noise > max_noise)).any(axis=1)
    step = np.abs(np.diff(windows.mean(axis=1), axis=0))
    is_disturbed[1:] |= (
        step > _MAX_SHIFT_SIGMAS * _step_scale(step, _white_noise(windows, quiet_noise) * np.sqrt(2 / n))
    ).any(axis=1)
    disturbed_around = (
        np.convolve(is_disturbed, np.ones(2 * _MARGIN_WINDOWS + 1))[_MARGIN_WINDOWS : _MARGIN_WINDOWS + count]
        if count
        else is_disturbed
    )
    return np.asarray(disturbed_around < 0.5)


def _step_scale(step: F64, white: F64) -> F64:
    """Return the scale (3,) of the steps (W - 1, 3) between means: their median, if white noise explains
    it."""
    observed = 1.4826 * np.median(step, axis=0) if len(step) else white
    return np.asarray(np.clip(observed, white, _MAX_SMOOTHING * white), np.float64)


def _white_noise(windows: F64, quiet_noise: F64) -> F64:
    """Return the standard deviation (3,) of a sample from differences of successive samples, which slow
    motion does not raise, in the quietest windows; at least a thousandth of the scatter, where
    quantisation hides the noise."""
    difference_noise = np.diff(windows, axis=1).std(axis=1) / np.sqrt(2)
    calm = np.quantile(difference_noise, _QUIET_QUANTILE, axis=0) if len(difference_noise) else quiet_noise
    return np.maximum(calm, quiet_noise / 1000)


def _longest_run(calm: np.ndarray) -> tuple[int, int]:
    """Return start and end of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], calm.astype(int), [0]])))
    runs = edges.reshape(-1, 2)
    if not len(runs):
        return 0, 0
    first, end = runs[(runs[:, 1] - runs[:, 0]).argmax()]
    return int(first), int(end)


_MAX_BRIDGED_GAP = 5  # missing samples in a row that are interpolated
_MAX_BRIDGED_SHARE = 0.01  # of all samples: more would lower the noise
_MIN_HZ = 10.0


@dataclass(frozen=True, eq=False)
class SensorNoise:
    """Gyroscope or accelerometer: mean (3,) at rest, in its unit; Allan curve; noise of each axis."""

    mean: F64
    curve: AllanCurve
    axes: tuple[AxisNoise, ...]

    def combined(self, name: str) -> NoiseEstimate:
        """Return density, instability or walk of the three axes combined, as a filter uses them."""
        return combine_axes(self.axes, name)


@dataclass(frozen=True, eq=False)
class ImuCharacteristics:
    """start_s, rest_s: start and duration of the rest in a recording of total_s. missing: samples lost in
    it, in `gaps` places, of which `unbridged_gaps` were too long to interpolate."""

    rate_hz: float
    start_s: float
    rest_s: float
    total_s: float
    samples: int
    missing: int
    gaps: int
    unbridged_gaps: int
    gyro: SensorNoise
    accel: SensorNoise


def characterise(imu: ImuBatch) -> ImuCharacteristics:
    """Characterise an IMU by samples in order of time. Raises DataError where they are not at rest, or too
    few."""
    rate_hz = _measured_rate_hz(imu.stamps_ns)
    at_rest = imu.take(find_rest(imu, rate_hz))
    steps = np.rint(np.diff(at_rest.stamps_ns) * 1e-9 * rate_hz).astype(np.int64)
    missing = np.maximum(steps - 1, 0)
    bridged = (missing > 0) & (missing <= _MAX_BRIDGED_GAP)
    if missing[bridged].sum() > _MAX_BRIDGED_SHARE * len(at_rest):
        bridged[:] = False
    cut_rows = np.flatnonzero((missing > 0) & ~bridged) + 1

    def sensor(values: F64) -> SensorNoise:
        parts = zip(np.split(values, cut_rows), np.split(np.append(missing, 0), cut_rows), strict=True)
        curve = allan_deviation([_fill_gaps(part, gap) for part, gap in parts], rate_hz)
        return SensorNoise(values.mean(axis=0), curve, fit_noise(curve))

    seconds = np.ptp(imu.stamps_ns) * 1e-9, np.ptp(at_rest.stamps_ns) * 1e-9
    return ImuCharacteristics(
        rate_hz=rate_hz,
        start_s=float((at_rest.stamps_ns[0] - imu.stamps_ns[0]) * 1e-9),
        rest_s=float(seconds[1]),
        total_s=float(seconds[0]),
        samples=len(at_rest),
        missing=int(missing.sum()),
        gaps=int(np.count_nonzero(missing)),
        unbridged_gaps=len(cut_rows),
        gyro=sensor(at_rest.gyro),
        accel=sensor(at_rest.accel),
    )


def _measured_rate_hz(stamps_ns: I64) -> float:
    """Return the rate by the mean of the steps that are no gaps; jitter does not change it."""
    if len(stamps_ns) < 100:
        raise DataError(f"IMU: {len(stamps_ns)} samples; record an hour at rest")
    steps = np.diff(stamps_ns)
    rate_hz = float(1e9 / steps[steps < 1.5 * np.median(steps)].mean())
    if rate_hz < _MIN_HZ:
        raise DataError(f"IMU: {rate_hz:.3g} samples a second, at least {_MIN_HZ:.0f} are needed")
    return rate_hz


def _fill_gaps(values: F64, missing_after: I64) -> F64:
    """Return values (N, 3) with `missing_after` (N,) samples after each but the last interpolated
    linearly."""
    missing_after = np.append(missing_after[:-1], 0)
    if not missing_after.any():
        return values
    positions = np.arange(len(values)) + np.concatenate([[0], np.cumsum(missing_after[:-1])])
    return np.stack(
        [np.interp(np.arange(positions[-1] + 1), positions, column) for column in values.T], axis=1
    )
