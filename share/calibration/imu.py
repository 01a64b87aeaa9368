"""What an IMU is like, from a recording at rest: rate, gaps, biases and noise of each axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.calibration.allan import AllanCurve, allan_deviation
from share.calibration.noise import AxisNoise, Figure, fit, together
from share.calibration.rest import rest
from share.errors import DataError
from share.types import F64, I64, ImuBatch

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
