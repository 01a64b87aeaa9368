"""The IMU's last samples, and what stands in for them where it says nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.odometry.imu_outliers import Breaks, Doubt
from share.odometry.state import State
from share.types import F64, ImuBatch

_KEPT = 600
_REST_S, _FEWEST = 0.5, 20  # samples of so long, and so many, tell rest
_REST_SHAKE, _REST_TURN = 0.12, 0.02  # m/s^2 and rad/s, standard deviations: about twice a D435i's noise
_SHAKEN_S = 0.2  # samples of so long tell how much it is shaken
_REPEATED = 4  # samples at the end of the scale,
_MUCH = np.repeat([0.5, 11.0], 3)  # rad/s and m/s^2, which no scale ends below


class Samples:
    """In order of time, the last few seconds; without those that are doubted (`breaks`)."""

    def __init__(self) -> None:
        self.all = ImuBatch.empty()
        self._most = np.zeros(6)  # of each axis, ever
        self._breaks = Breaks()

    def add(self, imu: ImuBatch) -> None:
        """Samples that are not later than what is there are left out."""
        start = int(np.searchsorted(imu.stamps_ns, self._breaks.newest_ns, side="right"))
        imu = imu.take(slice(start, None)) if start else imu
        values = np.hstack([imu.gyro, imu.accel])
        good = self._breaks.believed(imu.stamps_ns, values)
        if good is not None:
            imu, values = imu.take(good), values[good]
        if self._breaks.taken_back:
            self._take_back(self._breaks.taken_back)
        self._most = np.abs(values).max(axis=0, initial=0.0).clip(self._most)
        self.all = self.all.take(slice(-_KEPT, None)).join(imu)

    def with_more(self, imu: ImuBatch) -> Samples:
        """These and later ones; this one stays as it is."""
        out = Samples()
        out.all, out._most, out._breaks = self.all, self._most, self._breaks.copy()
        out.add(imu)
        return out

    def _take_back(self, stamps_ns: list[int]) -> None:
        self.all = self.all.take(~np.isin(self.all.stamps_ns, stamps_ns))
        self._most = np.abs(np.hstack([self.all.gyro, self.all.accel])).max(axis=0, initial=0.0)

    @property
    def doubted(self) -> int:
        """How many samples were left out."""
        return self._breaks.count

    def odd(self, now_ns: int) -> bool:
        """Whether the last ones may be wrong, though they were believed."""
        return self._breaks.is_odd(now_ns)

    def doubt(self, from_ns: int, to_ns: int) -> Doubt | None:
        """What of the samples in [from_ns, to_ns) is doubted."""
        return self._breaks.doubt(from_ns, to_ns)

    @property
    def last_ns(self) -> int:
        """Of the newest one; 0 where there is none."""
        return int(self.all.stamps_ns[-1]) if len(self.all) else 0

    def between(self, from_ns: int, to_ns: int, silent_ns: int) -> ImuBatch | None:
        """Those inside and one beyond each end, where there is one; None where it says nothing for longer
        than `silent_ns`."""
        stamps = self.all.stamps_ns
        first = max(int(np.searchsorted(stamps, from_ns, side="right")) - 1, 0)
        last = int(np.searchsorted(stamps, to_ns)) + 1
        part = self.all.take(slice(first, last))
        told = part.stamps_ns
        if len(told) == 0 or np.diff(np.r_[told, max(to_ns, int(told[-1]))]).max() > silent_ns:
            return None
        return part

    def latest(self, to_ns: int) -> ImuBatch:
        """Those of the last _SHAKEN_S."""
        stamps = self.all.stamps_ns
        first, last = np.searchsorted(stamps, [to_ns - round(_SHAKEN_S * 1e9), to_ns], side="right")
        return self.all.take(slice(int(first), int(last) + 1))

    def still(self, now_ns: int) -> bool:
        """Whether the IMU shows a body at rest, no motor running, since _REST_S before."""
        last = self.all.stamps_ns > now_ns - round(_REST_S * 1e9)
        if last.sum() < _FEWEST:
            return False
        shake, turn = self.all.accel[last].std(axis=0), self.all.gyro[last].std(axis=0)
        return bool(np.linalg.norm(shake) < _REST_SHAKE and np.linalg.norm(turn) < _REST_TURN)

    def clipped(self, imu: ImuBatch) -> NDArray[np.bool_]:
        """Which axes (6,), gyro then accelerometer, are at the end of their scale: they show the most
        that they ever have several times, and much. Noise does not repeat itself."""
        size = np.abs(np.hstack([imu.gyro, imu.accel]))
        out: NDArray[np.bool_] = ((size == self._most) & (size > _MUCH)).sum(axis=0) >= _REPEATED
        return out


def unclipped(imu: ImuBatch, axes: NDArray[np.bool_], rate: F64) -> ImuBatch:
    """Gyro axes (3,) that are at the end of their scale turn on as they did, rate (3,) rad/s as a gyro says
    it, if that is more."""
    if not axes.any():
        return imu
    more = axes & (np.abs(rate) > np.abs(imu.gyro)) & (rate * imu.gyro > 0)
    return replace(imu, gyro=np.where(more, rate, imu.gyro))


def coasting(state: State, rate: F64, to_ns: int, gravity: float) -> ImuBatch:
    """What an IMU would measure of a body that goes on as it does: rate (3,) rad/s, velocity unchanged."""
    half = se3.so3_exp(rate * (to_ns - state.stamp_ns) * 0.5e-9)
    force = (state.T[:3, :3] @ half).T @ np.array([0.0, 0.0, gravity])
    stamps = np.array([state.stamp_ns, to_ns])
    return ImuBatch(stamps, np.tile(rate + state.bg, (2, 1)), np.tile(force + state.ba, (2, 1)))


def mean_rate(before: F64, after: F64, dt_ns: int) -> F64:
    """rad/s (3,), in the body, by which one pose (4, 4) becomes the other."""
    out: F64 = se3.so3_log(before[:3, :3].T @ after[:3, :3]) / max(dt_ns * 1e-9, 1e-3)
    return out
