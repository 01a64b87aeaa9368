"""The IMU's last samples, and what stands in for them where it says nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.odometry.imu_outliers import ImuInflation, ImuOutlierDetector
from share.odometry.state import FilterState
from share.types import F64, ImuBatch

_MAX_SAMPLES = 600
_REST_S, _MIN_REST_SAMPLES = 0.5, 20  # samples of so long, and so many, tell rest
_MAX_REST_ACCEL_STD, _MAX_REST_GYRO_STD = (
    0.12,
    0.02,
)  # m/s^2 and rad/s, standard deviations: about twice a D435i's noise
_VIBRATION_WINDOW_S = 0.2  # samples of so long tell how much it is shaken
_MIN_CLIPPED = 4  # samples at the end of the scale,
_MIN_FULL_SCALE = np.repeat([0.5, 11.0], 3)  # rad/s and m/s^2, which no scale ends below


class ImuBuffer:
    """In order of time, the last few seconds; without those that are doubted (`breaks`)."""

    def __init__(self) -> None:
        self.samples = ImuBatch.empty()
        self._max_abs = np.zeros(6)  # of each axis, ever
        self._outliers = ImuOutlierDetector()

    def add(self, imu: ImuBatch) -> None:
        """Samples that are not later than what is there are left out."""
        start = int(np.searchsorted(imu.stamps_ns, self._outliers.newest_ns, side="right"))
        imu = imu.take(slice(start, None)) if start else imu
        values = np.hstack([imu.gyro, imu.accel])
        accepted = self._outliers.accepted_mask(imu.stamps_ns, values)
        if accepted is not None:
            imu, values = imu.take(accepted), values[accepted]
        if self._outliers.retracted_ns:
            self._remove(self._outliers.retracted_ns)
        self._max_abs = np.abs(values).max(axis=0, initial=0.0).clip(self._max_abs)
        self.samples = self.samples.take(slice(-_MAX_SAMPLES, None)).concatenate(imu)

    def extended(self, imu: ImuBatch) -> ImuBuffer:
        """These and later ones; this one stays as it is."""
        out = ImuBuffer()
        out.samples, out._max_abs, out._outliers = self.samples, self._max_abs, self._outliers.copy()
        out.add(imu)
        return out

    def _remove(self, stamps_ns: list[int]) -> None:
        self.samples = self.samples.take(~np.isin(self.samples.stamps_ns, stamps_ns))
        self._max_abs = np.abs(np.hstack([self.samples.gyro, self.samples.accel])).max(axis=0, initial=0.0)

    @property
    def rejected_count(self) -> int:
        """How many samples were left out."""
        return self._outliers.rejected_count

    def is_suspect(self, now_ns: int) -> bool:
        """Whether the last ones may be wrong, though they were believed."""
        return self._outliers.is_suspect(now_ns)

    def inflation(self, from_ns: int, to_ns: int) -> ImuInflation | None:
        """What of the samples in [from_ns, to_ns) is doubted."""
        return self._outliers.inflation(from_ns, to_ns)

    @property
    def last_ns(self) -> int:
        """Of the newest one; 0 where there is none."""
        return int(self.samples.stamps_ns[-1]) if len(self.samples) else 0

    def between(self, from_ns: int, to_ns: int, silent_ns: int) -> ImuBatch | None:
        """Those inside and one beyond each end, where there is one; None where it says nothing for longer
        than `silent_ns`."""
        stamps = self.samples.stamps_ns
        first = max(int(np.searchsorted(stamps, from_ns, side="right")) - 1, 0)
        last = int(np.searchsorted(stamps, to_ns)) + 1
        part = self.samples.take(slice(first, last))
        stamps_inside = part.stamps_ns
        if (
            len(stamps_inside) == 0
            or np.diff(np.r_[stamps_inside, max(to_ns, int(stamps_inside[-1]))]).max() > silent_ns
        ):
            return None
        return part

    def latest(self, to_ns: int) -> ImuBatch:
        """Those of the last _SHAKEN_S."""
        stamps = self.samples.stamps_ns
        first, last = np.searchsorted(stamps, [to_ns - round(_VIBRATION_WINDOW_S * 1e9), to_ns], side="right")
        return self.samples.take(slice(int(first), int(last) + 1))

    def is_still(self, now_ns: int) -> bool:
        """Whether the IMU shows a body at rest, no motor running, since _REST_S before."""
        last = self.samples.stamps_ns > now_ns - round(_REST_S * 1e9)
        if last.sum() < _MIN_REST_SAMPLES:
            return False
        accel_std, gyro_std = self.samples.accel[last].std(axis=0), self.samples.gyro[last].std(axis=0)
        return bool(
            np.linalg.norm(accel_std) < _MAX_REST_ACCEL_STD and np.linalg.norm(gyro_std) < _MAX_REST_GYRO_STD
        )

    def is_clipped(self, imu: ImuBatch) -> NDArray[np.bool_]:
        """Which axes (6,), gyro then accelerometer, are at the end of their scale: they show the most
        that they ever have several times, and much. Noise does not repeat itself."""
        magnitude = np.abs(np.hstack([imu.gyro, imu.accel]))
        out: NDArray[np.bool_] = ((magnitude == self._max_abs) & (magnitude > _MIN_FULL_SCALE)).sum(
            axis=0
        ) >= _MIN_CLIPPED
        return out


def fill_clipped(imu: ImuBatch, axes: NDArray[np.bool_], rate: F64) -> ImuBatch:
    """Gyro axes (3,) that are at the end of their scale turn on as they did, rate (3,) rad/s as a gyro says
    it, if that is more."""
    if not axes.any():
        return imu
    is_faster = axes & (np.abs(rate) > np.abs(imu.gyro)) & (rate * imu.gyro > 0)
    return replace(imu, gyro=np.where(is_faster, rate, imu.gyro))


def constant_velocity_samples(state: FilterState, rate: F64, to_ns: int, gravity: float) -> ImuBatch:
    """What an IMU would measure of a body that goes on as it does: rate (3,) rad/s, velocity unchanged."""
    half_turn = se3.so3_exp(rate * (to_ns - state.stamp_ns) * 0.5e-9)
    force = (state.T[:3, :3] @ half_turn).T @ np.array([0.0, 0.0, gravity])
    stamps = np.array([state.stamp_ns, to_ns])
    return ImuBatch(stamps, np.tile(rate + state.bg, (2, 1)), np.tile(force + state.ba, (2, 1)))


def mean_angular_rate(before: F64, after: F64, dt_ns: int) -> F64:
    """rad/s (3,), in the body, by which one pose (4, 4) becomes the other."""
    out: F64 = se3.so3_log(before[:3, :3].T @ after[:3, :3]) / max(dt_ns * 1e-9, 1e-3)
    return out
