"""Which part of an IMU's recording is at rest, judged by the sensor's own noise.

At rest the means of neighbouring seconds differ by little more than white noise makes them differ; a hand, or
a step beside the table, moves them by far more. No figure of the device is needed.
"""

from __future__ import annotations

import numpy as np

from share.errors import DataError
from share.types import F64, ImuBatch

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
