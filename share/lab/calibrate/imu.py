"""What an IMU is like, from a recording at rest: rate, gaps, biases and noise of each axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.errors import DataError
from share.lab.calibrate.allan import AllanCurve, allan_deviation
from share.lab.calibrate.imu_noise import AxisNoise, Figure, fit, together
from share.types import F64, I64, ImuBatch

# ---- Which part of an IMU's recording is at rest, judged by the sensor's own noise.
#
# At rest the means of neighbouring seconds differ by little more than white noise makes them differ; a hand,
# or a step beside the table, moves them by far more. No figure of the device is needed.

WINDOW_S = 1.0
LEAST_S = 60.0
_CALM = 0.2  # the quietest fifth tells how noisy the sensor is
_LOUDER = 2.0  # times that noise within a second: a knock
_SHIFT = 6.0  # standard errors of the difference of two means
_SMOOTHED = (
    6.0  # times more than successive samples tell may they differ: a sensor's filter hides white noise
)
_MARGIN = 2  # seconds about a disturbance that are left out too
_SPIN, _SHAKE = 0.05, 0.5  # rad/s, m/s^2: noisier than any IMU at rest


def rest(imu: ImuBatch, rate_hz: float) -> slice:
    """The longest stretch of samples at rest, in whole seconds.

    Raises DataError if that is less than a minute, and says why.
    """
    n = round(WINDOW_S * rate_hz)
    calm = _calm(imu.gyro, n, _SPIN) & _calm(imu.accel, n, _SHAKE)
    start, end = _longest(calm)
    if end - start < LEAST_S:
        raise DataError(
            f"IMU: at rest for {end - start} s of {len(calm)} s, at least {LEAST_S:.0f} s are needed; "
            "put the device on a stone floor or a heavy table, start recording, and leave it alone"
        )
    return slice(start * n, len(imu) if end == len(calm) else end * n)


def _calm(values: F64, n: int, most: float) -> np.ndarray:
    """(W,) bool: windows of n samples of values (N, 3) that are like the quietest, and not near others."""
    count = len(values) // n
    windows = values[: count * n].reshape(count, n, 3)
    noise = windows.std(axis=1)
    own = np.quantile(noise, _CALM, axis=0) if count else np.zeros(3)
    loud = ((noise > _LOUDER * own) | (noise > most)).any(axis=1)
    step = np.abs(np.diff(windows.mean(axis=1), axis=0))
    loud[1:] |= (step > _SHIFT * _usual(step, _white(windows, own) * np.sqrt(2 / n))).any(axis=1)
    spread = np.convolve(loud, np.ones(2 * _MARGIN + 1))[_MARGIN : _MARGIN + count] if count else loud
    return np.asarray(spread < 0.5)


def _usual(step: F64, white: F64) -> F64:
    """(3,) scale of the steps (W - 1, 3) between means: their median, if white noise explains it."""
    seen = 1.4826 * np.median(step, axis=0) if len(step) else white
    return np.asarray(np.clip(seen, white, _SMOOTHED * white), np.float64)


def _white(windows: F64, own: F64) -> F64:
    """(3,) standard deviation of a sample by the differences of successive ones, which slow motion does not
    raise, in the quietest windows; at least a thousandth of the scatter, where digits hide the noise."""
    quick = np.diff(windows, axis=1).std(axis=1) / np.sqrt(2)
    calm = np.quantile(quick, _CALM, axis=0) if len(quick) else own
    return np.maximum(calm, own / 1000)


def _longest(calm: np.ndarray) -> tuple[int, int]:
    """First and end of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], calm.astype(int), [0]])))
    runs = edges.reshape(-1, 2)
    if not len(runs):
        return 0, 0
    first, end = runs[(runs[:, 1] - runs[:, 0]).argmax()]
    return int(first), int(end)


_BRIDGED = 5  # samples that may be missing in a row; a straight line takes their place
_MOST_BRIDGED = 0.01  # of all: more, and the lines would lower the noise
_LEAST_HZ = 10.0


@dataclass(frozen=True, eq=False)
class SensorNoise:
    """Gyroscope or accelerometer. mean (3,): over the rest, u; curve, and a fit of each of its axes."""

    mean: F64
    curve: AllanCurve
    axes: tuple[AxisNoise, ...]

    def typical(self, name: str) -> Figure:
        """density, instability or walk of the three axes as one, as a filter takes them."""
        return together(self.axes, name)


@dataclass(frozen=True, eq=False)
class ImuNature:
    """start_s, rest_s: where the rest begins in the recording, and how long it is, of total_s. missing:
    samples lost in it, in `gaps` places, of which `cuts` were too long to be bridged."""

    rate_hz: float
    start_s: float
    rest_s: float
    total_s: float
    samples: int
    missing: int
    gaps: int
    cuts: int
    gyro: SensorNoise
    accel: SensorNoise


def characterise(imu: ImuBatch, model_error: float = 0.02) -> ImuNature:
    """From samples in order of time. Raises DataError where they do not rest, or are too few."""
    rate_hz = _rate(imu.stamps_ns)
    still = imu.take(rest(imu, rate_hz))
    steps = np.rint(np.diff(still.stamps_ns) * 1e-9 * rate_hz).astype(np.int64)
    lost = np.maximum(steps - 1, 0)
    bridged = (lost > 0) & (lost <= _BRIDGED)
    if lost[bridged].sum() > _MOST_BRIDGED * len(still):
        bridged[:] = False
    cuts = np.flatnonzero((lost > 0) & ~bridged) + 1

    def sensor(values: F64) -> SensorNoise:
        parts = zip(np.split(values, cuts), np.split(np.append(lost, 0), cuts), strict=True)
        curve = allan_deviation([_bridge(part, gap) for part, gap in parts], rate_hz)
        return SensorNoise(values.mean(axis=0), curve, fit(curve, model_error))

    seconds = np.ptp(imu.stamps_ns) * 1e-9, np.ptp(still.stamps_ns) * 1e-9
    return ImuNature(
        rate_hz=rate_hz,
        start_s=float((still.stamps_ns[0] - imu.stamps_ns[0]) * 1e-9),
        rest_s=float(seconds[1]),
        total_s=float(seconds[0]),
        samples=len(still),
        missing=int(lost.sum()),
        gaps=int(np.count_nonzero(lost)),
        cuts=len(cuts),
        gyro=sensor(still.gyro),
        accel=sensor(still.accel),
    )


def _rate(stamps_ns: I64) -> float:
    """Hz: of the steps that are no gaps, their mean, which jitter does not move."""
    if len(stamps_ns) < 100:
        raise DataError(f"IMU: {len(stamps_ns)} samples; record an hour at rest")
    steps = np.diff(stamps_ns)
    rate_hz = float(1e9 / steps[steps < 1.5 * np.median(steps)].mean())
    if rate_hz < _LEAST_HZ:
        raise DataError(f"IMU: {rate_hz:.3g} samples a second, at least {_LEAST_HZ:.0f} are needed")
    return rate_hz


def _bridge(values: F64, lost: I64) -> F64:
    """values (N, 3) with `lost` (N,) samples after each, but the last, filled in on a straight line."""
    lost = np.append(lost[:-1], 0)
    if not lost.any():
        return values
    at = np.arange(len(values)) + np.concatenate([[0], np.cumsum(lost[:-1])])
    return np.stack([np.interp(np.arange(at[-1] + 1), at, column) for column in values.T], axis=1)
