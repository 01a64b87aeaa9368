"""Reject IMU samples that no motion of a body explains, in runs of up to a fifth of a second.

`share.sensors.imu_check` removes certain glitches: up to three samples with neighbours on both sides. This
detector does not wait for later samples, so a rejected sample may be true: a knock looks the same at first.
Therefore the filter treats the IMU as missing meanwhile, and inflates its covariance for either case.

A sample is compared with the accepted one before it. The first sample of all, and the first after a gap, has
none: the samples that came with it are compared with one another, and the longest chain in which each may
follow the one before is accepted. Samples of the next frames may form a longer chain: then accepted samples
are retracted.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from share.types import F64, I64

_RECENT_STEPS = 20  # steps between accepted samples that describe the present motion
# A sample is rejected if its step exceeds ratio * (largest recent step) + margin (rad/s, m/s^2). Of 195,000
# samples of seven drones and hand-held recordings (EuRoC, TUM-VI) none exceeds margins of 0.35 and 3.9.
_STEP_RATIO = 4.0  # or the number of sample periods since the last accepted sample, if that is more
_STEP_MARGIN = np.repeat([0.7, 12.0], 3)
# An accepted sample whose step exceeds ratio * (largest recent step) + this margin inflates the covariance
# by its step over `_INFLATION_NS`.
_INFLATION_MARGIN = np.repeat([0.4, 5.0], 3)  # rad/s, m/s^2
_INFLATION_NS = 50_000_000
# An accepted sample beyond these is suspect: images may still show it to be wrong.
_SUSPECT_RATIO = 2.0
_SUSPECT_MARGIN = np.repeat([0.1, 2.0], 3)  # rad/s, m/s^2
_SUSPECT_NS = 200_000_000  # for which a sample stays suspect
_NOMINAL_STEP_NS = 5_000_000  # 200 Hz: the margins are for this sample period, and grow with the period
_MAX_GAP_NS = 25_000_000  # samples further apart cannot be compared
_MAX_RUN_NS = 200_000_000  # a longer run of outliers is the new state of the IMU
_HISTORY_NS = 5_000_000_000
_MAX_HISTORY = 4096  # rejected samples; an IMU gives fewer in that time
_NO_AXES = np.zeros(6, np.bool_)
_MIN_CHAIN = 3  # a shorter chain is also compared with the last sample before the gap
_MAX_NOISE_STEP = _STEP_MARGIN / _STEP_RATIO  # the largest recent step assumed where none is known
# A restart ends once so many samples are accepted, and they are this share of all its samples.
_CERTAIN_CHAIN, _CERTAIN_SHARE = 12, 2 / 3
_MAX_RESTART = 40  # samples of a restart
_MAX_CHAIN_WINDOW = 64  # samples of a restart, with those of the newest frame
_MAX_TURN_RAD = 0.3  # bound of the inflation of attitude
_MAX_SPEED_M_S = 3.0  # bound of the inflation of velocity


@dataclass(frozen=True, eq=False)
class ImuInflation:
    """Inflation for an interval with rejected or suspect samples.

    rejected_axes (6,): gyro, then accelerometer, with rejected samples. turn_rad, speed_m_s: by how much
    attitude and velocity may be wrong.
    """

    rejected_axes: NDArray[np.bool_]
    turn_rad: float
    speed_m_s: float


@dataclass(frozen=True, eq=False)
class _RejectedSample:
    """A rejected, suspect or retracted sample.

    axes (6,): to ignore. excess (6,): its deviation, rad/s and m/s^2. duration_ns: how long that may last.
    """

    stamp_ns: int
    axes: NDArray[np.bool_]
    excess: F64
    duration_ns: int


@dataclass(eq=False)
class _RestartWindow:
    """Samples since the first, or the first after a gap: stamps, values (6,), and which are accepted.

    before_gap: stamp and value of the last accepted sample before the gap, if there was one.
    """

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
        """Whether enough samples are accepted, or the window is full."""
        count = sum(self.accepted)
        is_certain = count >= _CERTAIN_CHAIN and count >= _CERTAIN_SHARE * len(self.stamps)
        return is_certain or len(self.stamps) >= _MAX_RESTART


class ImuOutlierDetector:
    """Takes samples in order of time, frame by frame.

    rejected_count: samples rejected so far. retracted_ns: stamps of samples accepted with earlier frames and
    rejected by the last call.
    """

    def __init__(self) -> None:
        self.rejected_count = 0
        self.retracted_ns: list[int] = []
        self._accepted_ns = 0  # of the last accepted sample
        self._accepted_value = np.zeros(6)
        self._recent_steps = np.zeros((0, 6))  # between the last accepted samples
        self._newest: tuple[int, F64] | None = None  # accepted or not
        self._step_ns = 0  # between the newest sample and the one before
        self._run_steps: deque[F64] = deque(maxlen=_RECENT_STEPS)  # of all samples, during a run of outliers
        self._run_start_ns: int | None = None
        self._run_end_ns = 0
        self._rejected: deque[_RejectedSample] = deque(maxlen=_MAX_HISTORY)
        self._restart_window: _RestartWindow | None = None
        self._suspect_ns: int | None = None  # of the last suspect sample

    @property
    def newest_ns(self) -> int:
        """The stamp of the newest sample, accepted or not; before all stamps without samples."""
        return -(2**62) if self._newest is None else self._newest[0]

    def copy(self) -> ImuOutlierDetector:
        """Return an independent copy."""
        out = copy.copy(self)
        out._run_steps, out._rejected = self._run_steps.copy(), self._rejected.copy()
        out._restart_window = self._restart_window and self._restart_window.copy()
        return out

    def accepted_mask(self, stamps_ns: I64, values: F64) -> NDArray[np.bool_] | None:
        """Return which of the samples (N,), (N, 6) gyro and accelerometer, are accepted; None if all are.
        Linear time."""
        self.retracted_ns = []
        if len(values) == 0:
            return None
        while self._rejected and stamps_ns[0] - self._rejected[0].stamp_ns >= _HISTORY_NS:
            self._rejected.popleft()
        if self._accept_all(stamps_ns, values):
            return None
        accepted, k = np.ones(len(values), np.bool_), 0
        while k < len(values):
            stamp_ns = int(stamps_ns[k])
            self._restart_after_gap(stamp_ns)
            if self._restart_window is None:
                accepted[k] = self._check_sample(stamp_ns, values[k])
                k += 1
            else:
                end = _end_before_gap(stamps_ns, k, _MAX_CHAIN_WINDOW - len(self._restart_window.stamps))
                accepted[k:end] = self._check_restart(self._restart_window, stamps_ns[k:end], values[k:end])
                k = end
        return None if accepted.all() else accepted

    def _accept_all(self, stamps_ns: I64, values: F64) -> bool:
        """Accept the samples if no step is too large, which is the common case. Return whether they are."""
        if self._run_start_ns is not None or self._newest is None:
            return False
        steps = np.empty_like(values)
        np.subtract(values[1:], values[:-1], out=steps[1:])
        steps[0] = values[0] - self._accepted_value
        np.abs(steps, out=steps)
        suspect = (steps > _SUSPECT_MARGIN).any()
        if suspect and not (steps <= _STEP_MARGIN).all():
            return False
        if suspect:
            self._flag_suspects(stamps_ns, steps)
        self._recent_steps = np.concatenate([self._recent_steps, steps])[-_RECENT_STEPS:]
        if len(stamps_ns) > 1:
            self._note_newest(int(stamps_ns[-2]), values[-2])
        self._note_newest(int(stamps_ns[-1]), values[-1])
        self._accepted_ns, self._accepted_value = int(stamps_ns[-1]), values[-1]
        if self._restart_window is not None:
            self._extend_restart(self._restart_window, stamps_ns, values, np.ones(len(values), np.bool_))
        return True

    def _restart_after_gap(self, stamp_ns: int) -> None:
        """Begin a restart at the first sample, and at one after a gap."""
        if self._newest is None:
            self._restart_window = _RestartWindow(None)
        elif stamp_ns - self._newest[0] > _MAX_GAP_NS:
            is_gap = 0 < self._step_ns <= _MAX_GAP_NS  # else samples are always this far apart
            before = (self._accepted_ns, self._accepted_value) if is_gap else None
            self._restart_window = _RestartWindow(before)

    def inflation(self, from_ns: int, to_ns: int) -> ImuInflation | None:
        """Return the inflation for rejected or suspect samples in [from_ns, to_ns); None without any."""
        rejected = [sample for sample in self._rejected if from_ns <= sample.stamp_ns < to_ns]
        if not rejected:
            return None
        sums = sum((sample.excess * (sample.duration_ns * 1e-9) for sample in rejected), np.zeros(6))
        turn, speed = float(np.linalg.norm(sums[:3])), float(np.linalg.norm(sums[3:]))
        axes = np.any([sample.axes for sample in rejected], axis=0)
        return ImuInflation(axes, min(turn, _MAX_TURN_RAD), min(speed, _MAX_SPEED_M_S))

    def is_suspect(self, now_ns: int) -> bool:
        """Return whether a recent accepted sample may be wrong."""
        return self._suspect_ns is not None and now_ns - self._suspect_ns < _SUSPECT_NS

    def _flag_suspects(self, stamps_ns: I64, steps: F64) -> None:
        """Flag each of these samples, with steps (N, 6), that is suspect."""
        recent = np.concatenate([self._recent_steps, steps])
        for n in np.flatnonzero((steps > _SUSPECT_MARGIN).any(axis=1)).tolist():
            before = recent[: len(self._recent_steps) + n][-_RECENT_STEPS:]
            self._flag_if_suspect(int(stamps_ns[n]), steps[n], before.max(axis=0, initial=0.0))

    def _check_restart(self, window: _RestartWindow, stamps_ns: I64, values: F64) -> NDArray[np.bool_]:
        """Return which of these samples, which continue a restart, are accepted."""
        known_count = len(window.stamps)
        stamps = np.concatenate([np.array(window.stamps, np.int64), stamps_ns])
        all_values = np.array([*window.values, *values])
        chain, steps = self._longest_chain(stamps, all_values, window.before_gap)
        in_chain = [n for n in chain if n < known_count]
        first = in_chain[-1] if in_chain else chain[0]  # the samples after this one are compared with it
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
                accepted[n] = self._check_sample(int(stamps_ns[n]), values[n])
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
        """Return the indices of the samples in the longest chain, and the recent steps (K, 6) by which it
        was found."""
        steps = self._recent_steps
        chains = _longest_chains(stamps, values, steps.max(axis=0, initial=0.0))
        if len(steps) == 0 and len(chains[0]) < len(values):  # no recent steps: use the median step
            typical_step = np.median(np.abs(np.diff(values, axis=0)), axis=0).clip(max=_MAX_NOISE_STEP)
            steps = typical_step[None]
            chains = _longest_chains(stamps, values, typical_step)
        if before_gap is not None:
            chains.sort(
                key=lambda chain: float((np.abs(values[chain[0]] - before_gap[1]) / _STEP_MARGIN).max())
            )
        return chains[0], steps

    def _contradicts_gap(self, before_gap: tuple[int, F64], stamp_ns: int, value: F64, count: int) -> bool:
        """Return whether a chain of `count` samples, the first with this value, is impossible after the
        sample before the gap.

        If it is possible but suspect, the covariance is inflated for the duration of the gap.
        """
        gap_ns = stamp_ns - before_gap[0]
        step, recent_max = np.abs(value - before_gap[1]), self._recent_steps.max(axis=0, initial=0.0)
        scale = gap_ns / _NOMINAL_STEP_NS if count >= _MIN_CHAIN else max(1.0, gap_ns / _INFLATION_NS)
        if (step > scale * (_STEP_RATIO * recent_max + _STEP_MARGIN)).any():
            return True
        self._flag_if_suspect(before_gap[0] + 1, step, recent_max, gap_ns)
        return False

    def _reject(self, stamps_ns: I64, values: F64, reference: F64) -> None:
        """Reject samples (N,), (N, 6) that cannot be neighbours of a sample with the value `reference`
        (6,)."""
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
        """Retract the accepted samples that are not in the chain. The filter has used them, so its
        covariance is inflated from `now_ns` on."""
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

    def _check_sample(self, stamp_ns: int, value: F64) -> bool:
        """Return whether the sample, not the first of all, is accepted."""
        assert self._newest is not None
        newest = self._newest
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
        """Flag an accepted sample with a step (6,) that is long beside the recent ones, and inflate if it
        is very long."""
        if (step > _SUSPECT_RATIO * recent_max + _SUSPECT_MARGIN).any():
            self._suspect_ns = stamp_ns
            if (inflated_axes := step > _STEP_RATIO * recent_max + _INFLATION_MARGIN).any():
                self._rejected.append(
                    _RejectedSample(stamp_ns, _NO_AXES, np.where(inflated_axes, step, 0.0), duration_ns)
                )

    def _restart_from(self, stamp_ns: int, value: F64, steps: F64) -> None:
        """Accept this sample, with `steps` as the recent ones; a run of outliers ends."""
        self._accepted_ns, self._accepted_value, self._recent_steps = stamp_ns, value, steps
        self._run_start_ns = None
        self._run_steps.clear()

    def _extend_run(self, stamp_ns: int, value: F64, step: F64) -> None:
        """Accept this sample. A run of outliers that has just paused goes on: some of them fit by chance."""
        if self._run_start_ns is None or stamp_ns - self._run_end_ns > _MAX_GAP_NS:
            self._restart_from(
                stamp_ns, value, np.concatenate([self._recent_steps, step[None]])[-_RECENT_STEPS:]
            )
        else:
            self._accepted_ns, self._accepted_value = stamp_ns, value


def _end_before_gap(stamps_ns: I64, first: int, max_count: int) -> int:
    """Return the end of the samples from index `first` on without a gap, of at most `max_count` of them."""
    near = np.diff(stamps_ns[first : first + max_count]) <= _MAX_GAP_NS
    return first + 1 + (len(near) if near.all() else int(near.argmin()))


def _longest_chains(stamps_ns: I64, values: F64, recent_max: F64) -> list[list[int]]:
    """Return the longest chains of samples (N,), (N, 6), by index, in which each may follow the one before.

    recent_max (6,): the largest recent step before these samples. Time grows with N^2.
    """
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
