"""Samples that no body's motion leads to: runs of wrong ones, of any length up to a fifth of a second.

`share.sensors.imu_check` leaves out what is surely a glitch: up to three samples with neighbours on both
sides. Here nothing waits for what comes after, so that what is doubted may be true: a blow looks the same at
first. Who doubts takes the IMU as silent meanwhile, and is as unsure as if either could be.

A sample is held against the one before it. The first of all, and the first after a gap, has none: the samples
that came with it are held against one another, and the longest chain in which each may follow the one before
is believed. Those of the next frames may outvote it: then what was believed is taken back."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

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
_MOST_KEPT = 4096  # an IMU gives fewer in that time
_NONE = np.zeros(6, np.bool_)
_FEW = 3  # samples in a chain: fewer are held against what was before the gap, too
_NOISE = _MORE / _TIMES  # steps up to this may be so, where there were none before
_SURE = 12  # samples in a chain, and
_MOST_OF = 2 / 3  # of all since the beginning: it is over
_YOUNG, _LOOKED_AT = 40, 64  # samples that a beginning has at most, and with those of the next frame
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


@dataclass(eq=False)
class _Beginning:
    """Samples since the first one, or since the first after a gap: their stamps, values (6,), and which are
    believed. before: stamp and value of the last that was believed before the gap, if there was one."""

    before: tuple[int, F64] | None
    stamps: list[int] = field(default_factory=list)
    values: list[F64] = field(default_factory=list)
    believed: list[bool] = field(default_factory=list)

    def copy(self) -> _Beginning:
        return _Beginning(self.before, self.stamps[:], self.values[:], self.believed[:])

    def add(self, stamps_ns: I64, values: F64, believed: NDArray[np.bool_]) -> None:
        self.stamps += stamps_ns.tolist()
        self.values += list(values)
        self.believed += believed.tolist()

    @property
    def over(self) -> bool:
        """Whether what is believed is so for sure, or as sure as it gets."""
        agree = sum(self.believed)
        sure = agree >= _SURE and agree >= _MOST_OF * len(self.stamps)
        return sure or len(self.stamps) >= _YOUNG


class Breaks:
    """Fed with samples in order of time, a frame at a time. `count`: how many were doubted. `taken_back`:
    stamps of those that were believed with earlier frames, and since the last one are not."""

    def __init__(self) -> None:
        self.count = 0
        self.taken_back: list[int] = []
        self._stamp_ns, self._value = 0, np.zeros(6)  # of the last that was believed
        self._steps = np.zeros((0, 6))  # the last few between such
        self._newest: tuple[int, F64] | None = None  # of any
        self._step_ns = 0  # from the one before to that
        self._run: deque[F64] = deque(maxlen=_LATELY)  # steps, of the doubted too, while a run goes on
        self._since_ns: int | None = None  # of its first sample,
        self._until_ns = 0  # and of its last so far
        self._left: deque[_Left] = deque(maxlen=_MOST_KEPT)
        self._beginning: _Beginning | None = None
        self._odd_ns: int | None = None  # the last sample that is believed, but odd

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest sample, believed or not; before there is one, before all."""
        return -(2**62) if self._newest is None else self._newest[0]

    def copy(self) -> Breaks:
        """That goes its own way from here."""
        out = Breaks()
        out.__dict__.update(self.__dict__, _run=self._run.copy(), _left=self._left.copy())
        out._beginning = self._beginning and self._beginning.copy()
        return out

    def believed(self, stamps_ns: I64, values: F64) -> NDArray[np.bool_] | None:
        """Which of samples (N,), (N, 6) gyro and accelerometer, are; None: all. Time is linear in N."""
        self.taken_back = []
        if len(values) == 0:
            return None
        while self._left and stamps_ns[0] - self._left[0].stamp_ns >= _KEPT_NS:
            self._left.popleft()
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
                if len(stamps_ns) > 1:
                    self._hear(int(stamps_ns[-2]), values[-2])
                self._hear(int(stamps_ns[-1]), values[-1])
                self._stamp_ns, self._value = int(stamps_ns[-1]), values[-1]
                if self._beginning is not None:
                    self._go_on(self._beginning, stamps_ns, values, np.ones(len(values), np.bool_))
                return None
        good, k = np.ones(len(values), np.bool_), 0
        while k < len(values):
            stamp_ns = int(stamps_ns[k])
            if self._newest is None:
                self._beginning = _Beginning(None)
            elif stamp_ns - self._newest[0] > _APART_NS:
                is_gap = 0 < self._step_ns <= _APART_NS  # and not as far as they always are
                self._beginning = _Beginning((self._stamp_ns, self._value) if is_gap else None)
            if self._beginning is None:
                good[k] = self._is_good(stamp_ns, self._newest, values[k])
                k += 1
            else:
                past = _until_a_gap(stamps_ns, k, _LOOKED_AT - len(self._beginning.stamps))
                good[k:past] = self._begun(self._beginning, stamps_ns[k:past], values[k:past])
                k = past
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

    def _begun(self, beginning: _Beginning, stamps_ns: I64, values: F64) -> NDArray[np.bool_]:
        """Which of these samples, that go on with a beginning, are believed."""
        old = len(beginning.stamps)
        stamps = np.concatenate([np.array(beginning.stamps, np.int64), stamps_ns])
        window = np.array([*beginning.values, *values])
        chain, steps = self._longest(stamps, window, beginning.before)
        known = [n for n in chain if n < old]
        first = known[-1] if known else chain[0]  # how things are, from here on
        good = np.zeros(len(values), np.bool_)
        before = None if old else beginning.before
        if before and self._is_far(before, int(stamps[first]), window[first], len(chain)):
            self._leave_out(stamps_ns, values, before[1])
            self._hear(int(stamps_ns[-1]), values[-1])
        else:
            if self._stamp_ns not in stamps[known]:
                self._take_back(beginning, chain, window[first], int(stamps_ns[0]))
                self._begin(int(stamps[first]), window[first], steps)
            if first >= old:
                good[first - old] = True
                self._leave_out(stamps_ns[: first - old], values[: first - old], window[first])
                self._hear(int(stamps[first]), window[first])
            for n in range(max(0, first - old + 1), len(values)):
                good[n] = self._is_good(int(stamps_ns[n]), self._newest, values[n])
        self._go_on(beginning, stamps_ns, values, good)
        return good

    def _go_on(self, beginning: _Beginning, stamps_ns: I64, values: F64, believed: NDArray[np.bool_]) -> None:
        beginning.add(stamps_ns, values, believed)
        if beginning.over:
            self._beginning = None

    def _longest(self, stamps: I64, values: F64, before: tuple[int, F64] | None) -> tuple[list[int], F64]:
        """Numbers of the samples in the longest chain, and steps (K, 6) that tell how a body moves."""
        steps = self._steps
        chains = _chains(stamps, values, steps.max(axis=0, initial=0.0))
        if len(steps) == 0 and len(chains[0]) < len(values):  # not even noise is known
            usual = np.median(np.abs(np.diff(values, axis=0)), axis=0).clip(max=_NOISE)
            steps = usual[None]
            chains = _chains(stamps, values, usual)
        if before is not None:
            chains.sort(key=lambda chain: float((np.abs(values[chain[0]] - before[1]) / _MORE).max()))
        return chains[0], steps

    def _is_far(self, before: tuple[int, F64], stamp_ns: int, value: F64, count: int) -> bool:
        """Whether `count` samples after a gap, the first of them this one, cannot be, for what was before
        it. Where they can, and are odd, the filter is unsure of the time of the gap."""
        gap_ns = stamp_ns - before[0]
        far, lately = np.abs(value - before[1]), self._steps.max(axis=0, initial=0.0)
        times = gap_ns / _USUAL_NS if count >= _FEW else max(1.0, gap_ns / _SOFT_NS)
        if (far > times * (_TIMES * lately + _MORE)).any():
            return True
        self._mind(before[0] + 1, far, lately, gap_ns)
        return False

    def _leave_out(self, stamps_ns: I64, values: F64, near: F64) -> None:
        """These (N,), (N, 6), that cannot be neighbours of one with the value `near` (6,)."""
        for stamp_ns, value in zip(stamps_ns.tolist(), values, strict=True):
            far = np.abs(value - near)
            leaps = far / _MORE >= min(1.0, (far / _MORE).max())
            self.count += 1
            self._left.append(_Left(stamp_ns, leaps, np.where(leaps, far, 0.0), _USUAL_NS))

    def _take_back(self, beginning: _Beginning, chain: Iterable[int], near: F64, now_ns: int) -> None:
        """What was believed and is not in the chain: the filter has heard it, and is unsure from now on."""
        for n in {n for n, was in enumerate(beginning.believed) if was}.difference(chain):
            beginning.believed[n] = False
            self.taken_back.append(beginning.stamps[n])
            self.count += 1
            step_ns = _USUAL_NS if n or not beginning.before else beginning.stamps[0] - beginning.before[0]
            self._left.append(_Left(now_ns, _NONE, np.abs(beginning.values[n] - near), step_ns))

    def _is_good(self, stamp_ns: int, newest: tuple[int, F64] | None, value: F64) -> bool:
        assert newest is not None
        self._hear(stamp_ns, value)
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
            self._begin(stamp_ns, value, np.array(self._run))
            return True
        self.count += 1
        self._left.append(_Left(stamp_ns, leaps, np.where(leaps, far, 0.0), step_ns))
        return False

    def _hear(self, stamp_ns: int, value: F64) -> None:
        self._step_ns = 0 if self._newest is None else stamp_ns - self._newest[0]
        self._newest = (stamp_ns, value)

    def _mind(self, stamp_ns: int, step: F64, lately: F64, for_ns: int = _SOFT_NS) -> None:
        """A sample that is believed, whose step (6,) is long beside those before it."""
        if (step > _ODD_TIMES * lately + _ODD_MORE).any():
            self._odd_ns = stamp_ns
            if (soft := step > _TIMES * lately + _SOFT_MORE).any():
                self._left.append(_Left(stamp_ns, _NONE, np.where(soft, step, 0.0), for_ns))

    def _begin(self, stamp_ns: int, value: F64, steps: F64) -> None:
        """As things are from this sample on."""
        self._stamp_ns, self._value, self._steps = stamp_ns, value, steps
        self._since_ns = None
        self._run.clear()

    def _accept(self, stamp_ns: int, value: F64, far: F64) -> None:
        """As expected; but a run of samples of which some lie right by chance goes on."""
        if self._since_ns is None or stamp_ns - self._until_ns > _APART_NS:
            self._begin(stamp_ns, value, np.concatenate([self._steps, far[None]])[-_LATELY:])
        else:
            self._stamp_ns, self._value = stamp_ns, value


def _until_a_gap(stamps_ns: I64, first: int, most: int) -> int:
    """Past the samples from number `first` on that have no gap between them, and are at most so many."""
    near = np.diff(stamps_ns[first : first + most]) <= _APART_NS
    return first + 1 + (len(near) if near.all() else int(near.argmin()))


def _chains(stamps_ns: I64, values: F64, lately: F64) -> list[list[int]]:
    """Of samples (N,), (N, 6) the longest chains, by numbers, in which each may follow the one before; lately
    (6,): as `Breaks` knows it of the samples before these. Time goes with N^2."""
    count = len(values)
    length, back, most = np.ones(count, np.int64), np.full(count, -1), np.tile(lately, (count, 1))
    for n in range(1, count):
        step_ns = max(int(stamps_ns[n] - stamps_ns[n - 1]), 1)
        far = np.abs(values[n] - values[:n])
        between = np.maximum(_TIMES, (stamps_ns[n] - stamps_ns[:n]) / step_ns)
        may = (far <= between[:, None] * most[:n] + _MORE * max(1.0, step_ns / _USUAL_NS)).all(axis=1)
        if may.any():
            last = n - 1 - int(np.where(may, length[:n], 0)[::-1].argmax())
            length[n], back[n] = length[last] + 1, last
            most[n] = np.maximum(most[last], far[last].clip(max=_NOISE))
    chains = []
    for end in np.flatnonzero(length == length.max()).tolist():
        chain = [end]
        while back[chain[-1]] >= 0:
            chain.append(int(back[chain[-1]]))
        chains.append(chain[::-1])
    return chains
