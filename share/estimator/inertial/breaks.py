"""Samples that no body's motion leads to: runs of wrong ones, of any length up to a fifth of a second.

`share.core.imu_check` leaves out what is surely a glitch: up to three samples with neighbours on both sides.
Here nothing waits for what comes after, so that what is doubted may be true: a blow looks the same at first.
Who doubts takes the IMU as silent meanwhile, and is as unsure as if either could be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.types import F64, I64

_LATELY = 20  # steps that tell how a body moves
_TIMES = 4.0  # as far as the farthest of them, or as many of them as lie between,
_MORE = np.repeat([0.7, 12.0], 3)  # and this, rad/s and m/s^2: no body moves farther from one to the next.
# Of 195,000 samples of seven drones and hand-held recordings (EuRoC, TUM-VI) none has more than 0.35 and 3.9.
_SOFT_MORE = np.repeat([0.4, 5.0], 3)  # with this a sample is believed, and the filter unsure by as much
_SOFT_NS = 50_000_000  # over so long
_ODD_TIMES, _ODD_MORE = 2.0, np.repeat([0.1, 2.0], 3)  # the same of what may be wrong, if images say so too,
_ODD_NS = 200_000_000  # for so long after
_USUAL_NS = 5_000_000  # 200 Hz; what is added is for samples so far apart, and grows with the distance
_APART_NS = 25_000_000  # samples further apart say nothing of each other
_LONGEST_NS = 200_000_000  # of a run; what lasts longer is how things are now
_KEPT_NS = 5_000_000_000
_NONE = np.zeros(6, np.bool_)
_MOST_RAD, _MOST_M_S = 0.3, 3.0  # that a body may have turned or gained without anybody knowing


@dataclass(frozen=True, eq=False)
class Doubt:
    """axes (6,): gyro, then accelerometer, of which samples were left out. turn rad, speed m/s: by how much
    what is believed may be wrong."""

    axes: NDArray[np.bool_]
    turn: float
    speed: float


@dataclass(frozen=True, eq=False)
class _Left:
    """A sample that is doubted: on which axes (6,) it is left out; by how much it is off (6,), how long."""

    stamp_ns: int
    axes: NDArray[np.bool_]
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

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest sample, believed or not; before there is one, before all."""
        return -(2**62) if self._newest is None else self._newest[0]

    def copy(self) -> Breaks:
        """That goes its own way from here."""
        out = Breaks()
        out.__dict__.update(self.__dict__, _run=list(self._run))
        return out

    def believed(self, stamps_ns: I64, values: F64) -> NDArray[np.bool_] | None:
        """Which of samples (N,), (N, 6) gyro and accelerometer, are; None: all."""
        if len(values) == 0:
            return None
        if self._since_ns is None and self._newest is not None:
            steps = np.empty_like(values)
            np.subtract(values[1:], values[:-1], out=steps[1:])
            steps[0] = values[0] - self._value
            np.abs(steps, out=steps)
            odd = (steps > _ODD_MORE).any()
            if not odd or (steps <= _MORE).all():  # as nearly always
                if odd:
                    self._look(stamps_ns, steps)
                self._steps = np.concatenate([self._steps, steps])[-_LATELY:]
                self._stamp_ns, self._value = int(stamps_ns[-1]), values[-1]
                self._newest = (self._stamp_ns, self._value)
                return None
        each = zip(stamps_ns.tolist(), values, strict=True)
        good = np.array([self._is_good(at, value) for at, value in each], np.bool_)
        return None if good.all() else good

    def doubt(self, from_ns: int, to_ns: int) -> Doubt | None:
        """What of the samples in [from_ns, to_ns) is doubted, if any is."""
        left = [one for one in self._left if from_ns <= one.stamp_ns < to_ns]
        if not left:
            return None
        sums = sum((one.excess * (one.step_ns * 1e-9) for one in left), np.zeros(6))
        turn, speed = float(np.linalg.norm(sums[:3])), float(np.linalg.norm(sums[3:]))
        axes = np.any([one.axes for one in left], axis=0)
        return Doubt(axes, min(turn, _MOST_RAD), min(speed, _MOST_M_S))

    def is_odd(self, now_ns: int) -> bool:
        """Whether one of the last samples that were believed may be wrong all the same."""
        return self._odd_ns is not None and now_ns - self._odd_ns < _ODD_NS

    def _look(self, stamps_ns: I64, steps: F64) -> None:
        """Whether one of these steps (N, 6) is odd."""
        lately = np.concatenate([self._steps, steps])
        for k, step in enumerate(steps, len(self._steps)):
            before = lately[max(0, k - _LATELY) : k].max(axis=0, initial=0.0)
            self._mind(int(stamps_ns[k - len(self._steps)]), step, before)

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
            self._mind(stamp_ns, far, lately)
            self._accept(stamp_ns, value, far)
            return True
        self._since_ns = stamp_ns if self._since_ns is None else self._since_ns
        self._until_ns = stamp_ns
        if stamp_ns - self._since_ns > _LONGEST_NS:
            self._begin(stamp_ns, value, np.array(self._run[-_LATELY:]))
            return True
        self.count += 1
        self._note(_Left(stamp_ns, leaps, np.where(leaps, far, 0.0), step_ns))
        return False

    def _note(self, left: _Left) -> None:
        kept = tuple(one for one in self._left if left.stamp_ns - one.stamp_ns < _KEPT_NS)
        self._left = (*kept, left)

    def _mind(self, stamp_ns: int, step: F64, lately: F64) -> None:
        """A sample that is believed, whose step (6,) is long beside those before it."""
        if (step > _ODD_TIMES * lately + _ODD_MORE).any():
            self._odd_ns = stamp_ns
            if (soft := step > _TIMES * lately + _SOFT_MORE).any():
                self._note(_Left(stamp_ns, _NONE, np.where(soft, step, 0.0), _SOFT_NS))

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
