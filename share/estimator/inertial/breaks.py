"""Samples that no body's motion leads to: runs of wrong ones, of any length up to a fifth of a second.

`share.core.imu_check` leaves out what is surely a glitch: up to three samples with neighbours on both sides.
Here nothing waits for what comes after, so that what is doubted may be true: a blow looks the same at first.
Who doubts takes the IMU as silent meanwhile, and is as unsure as if either could be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.types import F64, ImuBatch

_LATELY = 20  # steps that tell how a body moves
_TIMES = 4.0  # as far as the farthest of them, or as many of them as lie between,
_MORE = np.repeat([0.7, 8.0], 3)  # and this, rad/s and m/s^2: no body moves farther from one to the next.
# Of 195,000 samples of seven drones and hand-held recordings (EuRoC, TUM-VI) none has more than 0.35 and 3.9.
_ODD_TIMES, _ODD_MORE = 2.0, np.repeat([0.1, 2.0], 3)  # the same of what may be wrong, if images say so too,
_ODD_NS = 200_000_000  # for so long after
_USUAL_NS = 5_000_000  # 200 Hz; what is added is for samples so far apart, and grows with the distance
_APART_NS = 25_000_000  # samples further apart say nothing of each other
_LONGEST_NS = 200_000_000  # of a run; what lasts longer is how things are now
_KEPT_NS = 5_000_000_000
_MOST_RAD, _MOST_M_S = 0.3, 3.0  # that a body may have turned or gained without anybody knowing


@dataclass(frozen=True, eq=False)
class Doubt:
    """axes (6,): gyro, then accelerometer, that say nothing for a while. turn rad, speed m/s: what the
    samples would add if they were true."""

    axes: NDArray[np.bool_]
    turn: float
    speed: float


@dataclass(frozen=True, eq=False)
class _Left:
    """A sample that is doubted: by how much (6,), over how long."""

    stamp_ns: int
    excess: F64
    step_ns: int


class Breaks:
    """Fed with samples in order of time. `count`: how many were doubted."""

    def __init__(self) -> None:
        self.count = 0
        self._stamp_ns, self._value = 0, np.zeros(6)  # of the last that was believed
        self._steps = np.zeros((0, 6))  # the last few between such
        self._newest: tuple[int, F64] | None = None  # of any
        self._run: list[F64] = []  # steps of samples, the doubted ones too, while a run goes on
        self._since_ns: int | None = None  # of its first sample,
        self._until_ns = 0  # and of its last so far
        self._left: tuple[_Left, ...] = ()
        self._odd_ns: int | None = None  # the last sample that is believed, but odd

    def copy(self) -> Breaks:
        """That goes its own way from here."""
        out = Breaks()
        out.__dict__.update(self.__dict__, _run=list(self._run))
        return out

    def believed(self, imu: ImuBatch) -> ImuBatch:
        """`imu` without what is doubted."""
        if len(imu) == 0:
            return imu
        values = np.hstack([imu.gyro, imu.accel])
        if self._since_ns is None and self._newest is not None:
            steps = np.abs(np.diff(values, axis=0, prepend=self._value[None]))
            if (steps <= _MORE).all():  # as nearly always
                if (steps > _ODD_MORE).any():
                    self._look(imu, steps)
                self._steps = np.concatenate([self._steps, steps])[-_LATELY:]
                self._stamp_ns, self._value = int(imu.stamps_ns[-1]), values[-1]
                self._newest = (self._stamp_ns, self._value)
                return imu
        stamps = imu.stamps_ns.tolist()
        good = np.array([self._is_good(at, value) for at, value in zip(stamps, values, strict=True)], bool)
        return imu if good.all() else imu.take(good)

    def doubt(self, from_ns: int) -> Doubt | None:
        """What of the samples since `from_ns` is doubted, if any is."""
        left = [one for one in self._left if one.stamp_ns >= from_ns]
        if not left:
            return None
        sums = sum((one.excess * (one.step_ns * 1e-9) for one in left), np.zeros(6))
        turn, speed = float(np.linalg.norm(sums[:3])), float(np.linalg.norm(sums[3:]))
        axes = np.any([one.excess > 0 for one in left], axis=0)
        return Doubt(axes, min(turn, _MOST_RAD), min(speed, _MOST_M_S))

    def is_odd(self, now_ns: int) -> bool:
        """Whether one of the last samples that were believed may be wrong all the same."""
        return self._odd_ns is not None and now_ns - self._odd_ns < _ODD_NS

    def _look(self, imu: ImuBatch, steps: F64) -> None:
        """Whether one of these steps (N, 6) is odd."""
        lately = np.concatenate([self._steps, steps])
        for k, step in enumerate(steps, len(self._steps)):
            before = lately[max(0, k - _LATELY) : k].max(axis=0, initial=0.0)
            if (step > _ODD_TIMES * before + _ODD_MORE).any():
                self._odd_ns = int(imu.stamps_ns[k - len(self._steps)])

    def _is_good(self, stamp_ns: int, value: F64) -> bool:
        newest, self._newest = self._newest, (stamp_ns, value)
        if newest is None or stamp_ns - newest[0] > _APART_NS:
            self._begin(stamp_ns, value, np.zeros((0, 6)))
            return True
        step_ns = stamp_ns - newest[0]
        far = np.abs(value - self._value)
        between = max(_TIMES, (stamp_ns - self._stamp_ns) / max(step_ns, 1))
        lately = self._steps.max(axis=0, initial=0.0)
        leaps = far > between * lately + _MORE * max(1.0, step_ns / _USUAL_NS)
        self._run.append(np.abs(value - newest[1]))
        if not leaps.any():
            if (far > _ODD_TIMES * lately + _ODD_MORE).any():
                self._odd_ns = stamp_ns
            self._accept(stamp_ns, value, far)
            return True
        self._since_ns = stamp_ns if self._since_ns is None else self._since_ns
        self._until_ns = stamp_ns
        if stamp_ns - self._since_ns > _LONGEST_NS:
            self._begin(stamp_ns, value, np.array(self._run[-_LATELY:]))
            return True
        self.count += 1
        kept = tuple(one for one in self._left if stamp_ns - one.stamp_ns < _KEPT_NS)
        self._left = (*kept, _Left(stamp_ns, np.where(leaps, far, 0.0), step_ns))
        return False

    def _begin(self, stamp_ns: int, value: F64, steps: F64) -> None:
        """As things are from this sample on."""
        self._stamp_ns, self._value, self._steps = stamp_ns, value, steps
        self._run, self._since_ns = [], None

    def _accept(self, stamp_ns: int, value: F64, far: F64) -> None:
        """As expected; but a run of samples of which some lie right by chance goes on."""
        if self._since_ns is None or stamp_ns - self._until_ns > _APART_NS:
            self._begin(stamp_ns, value, np.concatenate([self._steps, far[None]])[-_LATELY:])
        else:
            self._stamp_ns, self._value = stamp_ns, value
