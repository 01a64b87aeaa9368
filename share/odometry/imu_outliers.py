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

_RECENT_STEPS = 20  # steps that tell how a body moves
_STEP_RATIO = 4.0  # as far as the farthest of them, or as many of them as lie between,
_STEP_MARGIN = np.repeat(
    [0.7, 12.0], 3
)  # and this, rad/s and m/s^2: no body moves farther from one to the next.
# Of 195,000 samples of seven drones and hand-held recordings (EuRoC, TUM-VI) none has more than 0.35 and 3.9.
_INFLATION_MARGIN = np.repeat(
    [0.4, 5.0], 3
)  # with this a sample is believed, and the filter unsure by as much
_INFLATION_NS = 50_000_000  # over so long
_SUSPECT_RATIO, _SUSPECT_MARGIN = (
    2.0,
    np.repeat([0.1, 2.0], 3),
)  # the same of what may be wrong, if images say so too,
_SUSPECT_NS = 200_000_000  # for so long after
_NOMINAL_STEP_NS = 5_000_000  # 200 Hz; what is added is for samples so far apart, and grows with the distance
_MAX_GAP_NS = 25_000_000  # samples further apart say nothing of each other
_MAX_RUN_NS = 200_000_000  # of a run; what lasts longer is how things are now
_HISTORY_NS = 5_000_000_000
_MAX_HISTORY = 4096  # an IMU gives fewer in that time
_NO_AXES = np.zeros(6, np.bool_)
_MIN_CHAIN = 3  # samples in a chain: fewer are held against what was before the gap, too
_MAX_NOISE_STEP = _STEP_MARGIN / _STEP_RATIO  # steps up to this may be so, where there were none before
_CERTAIN_CHAIN = 12  # samples in a chain, and
_CERTAIN_SHARE = 2 / 3  # of all since the beginning: it is over
_MAX_RESTART, _MAX_CHAIN_WINDOW = (
    40,
    64,
)  # samples that a beginning has at most, and with those of the next frame
_MAX_TURN_RAD, _MAX_SPEED_M_S = 0.3, 3.0  # that a body may have turned or gained without anybody knowing


@dataclass(frozen=True, eq=False)
class ImuInflation:
    """axes (6,): gyro, then accelerometer, of which samples were left out. turn rad, speed m/s: by how much
    what is believed may be wrong."""

    rejected_axes: NDArray[np.bool_]
    turn_rad: float
    speed_m_s: float


@dataclass(frozen=True, eq=False)
class _RejectedSample:
    """A sample that is doubted: on which axes (6,) it is left out; by how much it is off (6,), how long."""

    stamp_ns: int
    axes: NDArray[np.bool_]
    excess: F64
    duration_ns: int


@dataclass(eq=False)
class _RestartWindow:
    """Samples since the first one, or since the first after a gap: their stamps, values (6,), and which are
    believed. before: stamp and value of the last that was believed before the gap, if there was one."""

    before_gap: tuple[int, F64] | None
    stamps: list[int] = field(default_factory=list)
    values: list[F64] = field(default_factory=list)
    accepted: list[bool] = field(default_factory=list)

    def copy(self) -> _RestartWindow:
        return _RestartWindow(self.before_gap, self.stamps[:], self.values[:], self.accepted[:])

    def add(self, stamps_ns: I64, values: F64, accepted: NDArray[np.bool_]) -> None:
        self.stamps += stamps_ns.tolist()
        self.values += list(values)
        self.accepted += accepted.tolist()

    @property
    def is_over(self) -> bool:
        """Whether what is believed is so for sure, or as sure as it gets."""
        count = sum(self.accepted)
        sure = count >= _CERTAIN_CHAIN and count >= _CERTAIN_SHARE * len(self.stamps)
        return sure or len(self.stamps) >= _MAX_RESTART


class ImuOutlierDetector:
    """Fed with samples in order of time, a frame at a time. `rejected_count`: how many were doubted.
    `retracted_ns`:
    stamps of those that were believed with earlier frames, and since the last one are not."""

    def __init__(self) -> None:
        self.rejected_count = 0
        self.retracted_ns: list[int] = []
        self._accepted_ns, self._accepted_value = 0, np.zeros(6)  # of the last that was believed
        self._recent_steps = np.zeros((0, 6))  # the last few between such
        self._newest: tuple[int, F64] | None = None  # of any
        self._step_ns = 0  # from the one before to that
        self._run_steps: deque[F64] = deque(
            maxlen=_RECENT_STEPS
        )  # steps, of the doubted too, while a run goes on
        self._run_start_ns: int | None = None  # of its first sample,
        self._run_end_ns = 0  # and of its last so far
        self._rejected: deque[_RejectedSample] = deque(maxlen=_MAX_HISTORY)
        self._restart_window: _RestartWindow | None = None
        self._suspect_ns: int | None = None  # the last sample that is believed, but odd

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest sample, believed or not; before there is one, before all."""
        return -(2**62) if self._newest is None else self._newest[0]

    def copy(self) -> ImuOutlierDetector:
        """That goes its own way from here."""
        out = ImuOutlierDetector()
        out.__dict__.update(self.__dict__, _run=self._run_steps.copy(), _left=self._rejected.copy())
        out._restart_window = self._restart_window and self._restart_window.copy()
        return out

    def accepted_mask(self, stamps_ns: I64, values: F64) -> NDArray[np.bool_] | None:
        """Which of samples (N,), (N, 6) gyro and accelerometer, are; None: all. Time is linear in N."""
        self.retracted_ns = []
        if len(values) == 0:
            return None
        while self._rejected and stamps_ns[0] - self._rejected[0].stamp_ns >= _HISTORY_NS:
            self._rejected.popleft()
        if self._run_start_ns is None and self._newest is not None:
            steps = np.empty_like(values)
            np.subtract(values[1:], values[:-1], out=steps[1:])
            steps[0] = values[0] - self._accepted_value
            np.abs(steps, out=steps)
            suspect = (steps > _SUSPECT_MARGIN).any()
            if not suspect or (steps <= _STEP_MARGIN).all():  # as nearly always
                if suspect:
                    self._flag_suspects(stamps_ns, steps)
                self._recent_steps = np.concatenate([self._recent_steps, steps])[-_RECENT_STEPS:]
                if len(stamps_ns) > 1:
                    self._note_newest(int(stamps_ns[-2]), values[-2])
                self._note_newest(int(stamps_ns[-1]), values[-1])
                self._accepted_ns, self._accepted_value = int(stamps_ns[-1]), values[-1]
                if self._restart_window is not None:
                    self._extend_restart(
                        self._restart_window, stamps_ns, values, np.ones(len(values), np.bool_)
                    )
                return None
        accepted, k = np.ones(len(values), np.bool_), 0
        while k < len(values):
            stamp_ns = int(stamps_ns[k])
            if self._newest is None:
                self._restart_window = _RestartWindow(None)
            elif stamp_ns - self._newest[0] > _MAX_GAP_NS:
                is_gap = 0 < self._step_ns <= _MAX_GAP_NS  # and not as far as they always are
                self._restart_window = _RestartWindow(
                    (self._accepted_ns, self._accepted_value) if is_gap else None
                )
            if self._restart_window is None:
                accepted[k] = self._check_sample(stamp_ns, self._newest, values[k])
                k += 1
            else:
                end = _end_before_gap(stamps_ns, k, _MAX_CHAIN_WINDOW - len(self._restart_window.stamps))
                accepted[k:end] = self._check_restart(self._restart_window, stamps_ns[k:end], values[k:end])
                k = end
        return None if accepted.all() else accepted

    def inflation(self, from_ns: int, to_ns: int) -> ImuInflation | None:
        """What of the samples in [from_ns, to_ns) is doubted, if any is."""
        rejected = [sample for sample in self._rejected if from_ns <= sample.stamp_ns < to_ns]
        if not rejected:
            return None
        sums = sum((sample.excess * (sample.duration_ns * 1e-9) for sample in rejected), np.zeros(6))
        turn, speed = float(np.linalg.norm(sums[:3])), float(np.linalg.norm(sums[3:]))
        axes = np.any([sample.axes for sample in rejected], axis=0)
        return ImuInflation(axes, min(turn, _MAX_TURN_RAD), min(speed, _MAX_SPEED_M_S))

    def is_suspect(self, now_ns: int) -> bool:
        """Whether one of the last samples that were believed may be wrong all the same."""
        return self._suspect_ns is not None and now_ns - self._suspect_ns < _SUSPECT_NS

    def _flag_suspects(self, stamps_ns: I64, steps: F64) -> None:
        """Whether one of these steps (N, 6) is odd."""
        recent = np.concatenate([self._recent_steps, steps])
        for k, step in enumerate(steps, len(self._recent_steps)):
            recent_max = recent[max(0, k - _RECENT_STEPS) : k].max(axis=0, initial=0.0)
            self._flag_if_suspect(int(stamps_ns[k - len(self._recent_steps)]), step, recent_max)

    def _check_restart(self, window: _RestartWindow, stamps_ns: I64, values: F64) -> NDArray[np.bool_]:
        """Which of these samples, that go on with a beginning, are believed."""
        known_count = len(window.stamps)
        stamps = np.concatenate([np.array(window.stamps, np.int64), stamps_ns])
        all_values = np.array([*window.values, *values])
        chain, steps = self._longest_chain(stamps, all_values, window.before_gap)
        in_chain = [n for n in chain if n < known_count]
        first = in_chain[-1] if in_chain else chain[0]  # how things are, from here on
        accepted = np.zeros(len(values), np.bool_)
        before_gap = None if known_count else window.before_gap
        if before_gap and self._contradicts_gap(
            before_gap, int(stamps[first]), all_values[first], len(chain)
        ):
            self._reject(stamps_ns, values, before_gap[1])
            self._note_newest(int(stamps_ns[-1]), values[-1])
        else:
            if self._accepted_ns not in stamps[in_chain]:
                self._retract(window, chain, all_values[first], int(stamps_ns[0]))
                self._restart_from(int(stamps[first]), all_values[first], steps)
            if first >= known_count:
                accepted[first - known_count] = True
                self._reject(
                    stamps_ns[: first - known_count], values[: first - known_count], all_values[first]
                )
                self._note_newest(int(stamps[first]), all_values[first])
            for n in range(max(0, first - known_count + 1), len(values)):
                accepted[n] = self._check_sample(int(stamps_ns[n]), self._newest, values[n])
        self._extend_restart(window, stamps_ns, values, accepted)
        return accepted

    def _extend_restart(
        self, window: _RestartWindow, stamps_ns: I64, values: F64, accepted: NDArray[np.bool_]
    ) -> None:
        window.add(stamps_ns, values, accepted)
        if window.is_over:
            self._restart_window = None

    def _longest_chain(
        self, stamps: I64, values: F64, before_gap: tuple[int, F64] | None
    ) -> tuple[list[int], F64]:
        """Numbers of the samples in the longest chain, and steps (K, 6) that tell how a body moves."""
        steps = self._recent_steps
        chains = _longest_chains(stamps, values, steps.max(axis=0, initial=0.0))
        if len(steps) == 0 and len(chains[0]) < len(values):  # not even noise is known
            typical_step = np.median(np.abs(np.diff(values, axis=0)), axis=0).clip(max=_MAX_NOISE_STEP)
            steps = typical_step[None]
            chains = _longest_chains(stamps, values, typical_step)
        if before_gap is not None:
            chains.sort(
                key=lambda chain: float((np.abs(values[chain[0]] - before_gap[1]) / _STEP_MARGIN).max())
            )
        return chains[0], steps

    def _contradicts_gap(self, before_gap: tuple[int, F64], stamp_ns: int, value: F64, count: int) -> bool:
        """Whether `rejected_count` samples after a gap, the first of them this one, cannot be, for what was
        before it. Where they can, and are odd, the filter is unsure of the time of the gap."""
        gap_ns = stamp_ns - before_gap[0]
        step, recent_max = np.abs(value - before_gap[1]), self._recent_steps.max(axis=0, initial=0.0)
        scale = gap_ns / _NOMINAL_STEP_NS if count >= _MIN_CHAIN else max(1.0, gap_ns / _INFLATION_NS)
        if (step > scale * (_STEP_RATIO * recent_max + _STEP_MARGIN)).any():
            return True
        self._flag_if_suspect(before_gap[0] + 1, step, recent_max, gap_ns)
        return False

    def _reject(self, stamps_ns: I64, values: F64, reference: F64) -> None:
        """These (N,), (N, 6), that cannot be neighbours of one with the value `reference` (6,)."""
        for stamp_ns, value in zip(stamps_ns.tolist(), values, strict=True):
            deviation = np.abs(value - reference)
            outlier_axes = deviation / _STEP_MARGIN >= min(1.0, (deviation / _STEP_MARGIN).max())
            self.rejected_count += 1
            self._rejected.append(
                _RejectedSample(
                    stamp_ns, outlier_axes, np.where(outlier_axes, deviation, 0.0), _NOMINAL_STEP_NS
                )
            )

    def _retract(self, window: _RestartWindow, chain: Iterable[int], reference: F64, now_ns: int) -> None:
        """What was believed and is not in the chain: the filter has heard it, and is unsure from now on."""
        for n in {n for n, accepted in enumerate(window.accepted) if accepted}.difference(chain):
            window.accepted[n] = False
            self.retracted_ns.append(window.stamps[n])
            self.rejected_count += 1
            step_ns = (
                _NOMINAL_STEP_NS if n or not window.before_gap else window.stamps[0] - window.before_gap[0]
            )
            self._rejected.append(
                _RejectedSample(now_ns, _NO_AXES, np.abs(window.values[n] - reference), step_ns)
            )

    def _check_sample(self, stamp_ns: int, newest: tuple[int, F64] | None, value: F64) -> bool:
        assert newest is not None
        self._note_newest(stamp_ns, value)
        step_ns = stamp_ns - newest[0]
        step = np.abs(value - self._accepted_value)
        scale = max(_STEP_RATIO, (stamp_ns - self._accepted_ns) / max(step_ns, 1))
        recent_max = self._recent_steps.max(axis=0, initial=0.0)
        outlier_axes = step > scale * recent_max + _STEP_MARGIN * max(1.0, step_ns / _NOMINAL_STEP_NS)
        self._run_steps.append(np.abs(value - newest[1]))
        if not outlier_axes.any():
            self._flag_if_suspect(stamp_ns, step, recent_max)
            self._extend_run(stamp_ns, value, step)
            return True
        self._run_start_ns = stamp_ns if self._run_start_ns is None else self._run_start_ns
        self._run_end_ns = stamp_ns
        if stamp_ns - self._run_start_ns > _MAX_RUN_NS:
            self._restart_from(stamp_ns, value, np.array(self._run_steps))
            return True
        self.rejected_count += 1
        self._rejected.append(
            _RejectedSample(stamp_ns, outlier_axes, np.where(outlier_axes, step, 0.0), step_ns)
        )
        return False

    def _note_newest(self, stamp_ns: int, value: F64) -> None:
        self._step_ns = 0 if self._newest is None else stamp_ns - self._newest[0]
        self._newest = (stamp_ns, value)

    def _flag_if_suspect(
        self, stamp_ns: int, step: F64, recent_max: F64, duration_ns: int = _INFLATION_NS
    ) -> None:
        """A sample that is believed, whose step (6,) is long beside those before it."""
        if (step > _SUSPECT_RATIO * recent_max + _SUSPECT_MARGIN).any():
            self._suspect_ns = stamp_ns
            if (inflated_axes := step > _STEP_RATIO * recent_max + _INFLATION_MARGIN).any():
                self._rejected.append(
                    _RejectedSample(stamp_ns, _NO_AXES, np.where(inflated_axes, step, 0.0), duration_ns)
                )

    def _restart_from(self, stamp_ns: int, value: F64, steps: F64) -> None:
        """As things are from this sample on."""
        self._accepted_ns, self._accepted_value, self._recent_steps = stamp_ns, value, steps
        self._run_start_ns = None
        self._run_steps.clear()

    def _extend_run(self, stamp_ns: int, value: F64, step: F64) -> None:
        """As expected; but a run of samples of which some lie right by chance goes on."""
        if self._run_start_ns is None or stamp_ns - self._run_end_ns > _MAX_GAP_NS:
            self._restart_from(
                stamp_ns, value, np.concatenate([self._recent_steps, step[None]])[-_RECENT_STEPS:]
            )
        else:
            self._accepted_ns, self._accepted_value = stamp_ns, value


def _end_before_gap(stamps_ns: I64, first: int, max_count: int) -> int:
    """Past the samples from number `first` on that have no gap between them, and are at most so many."""
    near = np.diff(stamps_ns[first : first + max_count]) <= _MAX_GAP_NS
    return first + 1 + (len(near) if near.all() else int(near.argmin()))


def _longest_chains(stamps_ns: I64, values: F64, recent_max: F64) -> list[list[int]]:
    """Of samples (N,), (N, 6) the longest chains, by numbers, in which each may follow the one before; lately
    (6,): as `ImuOutlierDetector` knows it of the samples before these. Time goes with N^2."""
    count = len(values)
    length, previous, max_step = np.ones(count, np.int64), np.full(count, -1), np.tile(recent_max, (count, 1))
    for n in range(1, count):
        step_ns = max(int(stamps_ns[n] - stamps_ns[n - 1]), 1)
        steps = np.abs(values[n] - values[:n])
        scale = np.maximum(_STEP_RATIO, (stamps_ns[n] - stamps_ns[:n]) / step_ns)
        is_possible = (
            steps <= scale[:, None] * max_step[:n] + _STEP_MARGIN * max(1.0, step_ns / _NOMINAL_STEP_NS)
        ).all(axis=1)
        if is_possible.any():
            last = n - 1 - int(np.where(is_possible, length[:n], 0)[::-1].argmax())
            length[n], previous[n] = length[last] + 1, last
            max_step[n] = np.maximum(max_step[last], steps[last].clip(max=_MAX_NOISE_STEP))
    chains = []
    for end in np.flatnonzero(length == length.max()).tolist():
        chain = [end]
        while previous[chain[-1]] >= 0:
            chain.append(int(previous[chain[-1]]))
        chains.append(chain[::-1])
    return chains
