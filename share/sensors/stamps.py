"""Repair a device's stamps: counter wraps, jumps, stray stamps, restarts and gaps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from share.sensors.measurement import Measurement
from share.types import I64

WRAP_NS = 2**32 * 1000  # 4294.967296 s
MAX_JUMP_S = 10.0  # a longer step is accepted after three consistent samples; a backward one never
GAP_FACTOR = 2.5  # a step longer than this many frame intervals is a gap of the frames
MAX_JUMP_NS = int(MAX_JUMP_S * 1e9)
_MIN_AGREEING = 3  # measurements that must agree before a jump is accepted
_MAX_CONTRADICTING = 100  # measurements from before a jump, after which the jump is taken for stray stamps


def unwrap_stamps(stamps_ns: I64, period_ns: int = WRAP_NS) -> I64:
    """Return ordered stamps (N,) of one stream without the wraps of its counter; period_ns 0: it has none."""
    if not period_ns:
        return stamps_ns
    wraps = np.cumsum(np.diff(stamps_ns, prepend=stamps_ns[:1]) < -period_ns // 2)
    return np.asarray(stamps_ns + period_ns * wraps, np.int64)


class StampRepair:
    """Unwraps stamps into one time that only goes forward. All streams share one clock.

    Repairs the wrap of the D4xx's 32-bit microsecond counter, accepts a jump forward once several
    measurements agree on it, and drops single stamps that are far off. Counts `wraps`, `jumps`, `strays`
    (single stamps far off) and `past` (stamps more than `MAX_JUMP_S` back that no wrap explains).
    """

    def __init__(self) -> None:
        self.wraps = self.jumps = self.strays = self.past = 0
        self._latest_ns: int | None = None
        self._jump_candidates: list[tuple[int, Measurement]] = []
        self._contradictions_left = 0

    def feed(self, measurement: Measurement) -> Iterator[tuple[int, Measurement]]:
        """Add a measurement; yield (repaired stamp, measurement) of those now accepted.

        That is none, this one, or all that agree on a jump.
        """
        if self._latest_ns is None:
            self._latest_ns = measurement.stamp_ns
        stamp = self._unwrap(measurement.stamp_ns, self._latest_ns)
        step = stamp - self._latest_ns
        if step < -MAX_JUMP_NS:
            self.past += 1
        elif step > MAX_JUMP_NS:
            yield from self._add_jump_candidate(stamp, measurement)
        else:
            self._latest_ns = max(self._latest_ns, stamp)
            if self._jump_candidates:
                self._contradict_jump()
            yield stamp, measurement

    def flush(self) -> Iterator[tuple[int, Measurement]]:
        """At the end of the stream, accept a jump that is still pending."""
        if self._jump_candidates:
            yield from self._accept_jump()

    def _unwrap(self, raw: int, latest: int) -> int:
        """Return `raw` plus the number of wraps that brings it near `latest`; unchanged if none does."""
        stamp = raw + self.wraps * WRAP_NS
        if abs(stamp - latest) <= MAX_JUMP_NS:
            return stamp
        if abs(stamp + WRAP_NS - latest) <= MAX_JUMP_NS:
            self.wraps += 1
            return stamp + WRAP_NS
        if self.wraps and abs(stamp - WRAP_NS - latest) <= MAX_JUMP_NS:
            return stamp - WRAP_NS  # a straggler from before the wrap
        return stamp

    def _add_jump_candidate(self, stamp: int, measurement: Measurement) -> Iterator[tuple[int, Measurement]]:
        if self._jump_candidates and abs(stamp - self._jump_candidates[0][0]) > MAX_JUMP_NS:
            self.strays += len(self._jump_candidates)
            self._jump_candidates = []
        self._jump_candidates.append((stamp, measurement))
        self._contradictions_left = _MAX_CONTRADICTING
        if len(self._jump_candidates) >= _MIN_AGREEING:
            yield from self._accept_jump()

    def _contradict_jump(self) -> None:
        self._contradictions_left -= 1
        if self._contradictions_left <= 0:
            self.strays += len(self._jump_candidates)
            self._jump_candidates = []

    def _accept_jump(self) -> Iterator[tuple[int, Measurement]]:
        self.jumps += 1
        self._latest_ns = max(stamp for stamp, _ in self._jump_candidates)
        yield from self._jump_candidates
        self._jump_candidates = []


# ---- Gaps of a stream

_STREAM_GAP_FACTOR = 1.5  # a longer step, in expected steps, is a gap of one stream


class GapCounter:
    """Counts the samples of one stream, and what is missing.

    `samples`: in order. `gaps`: steps longer than expected. `missing`: by frame number if known, else as many
    as fit into the gap. `backward`: not later than the previous one; these must be dropped.
    """

    def __init__(self, rate_hz: float) -> None:
        """Raises ValueError for a rate that is not positive."""
        if not rate_hz > 0:
            raise ValueError(f"rate_hz: {rate_hz} must be positive")
        self.samples = self.gaps = self.missing = self.backward = 0
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self._step_ns = 1e9 / rate_hz
        self._number: int | None = None

    @property
    def seconds(self) -> float:
        """From the first sample to the last."""
        if self.first_ns is None or self.last_ns is None:
            return 0.0
        return (self.last_ns - self.first_ns) * 1e-9

    def feed(self, stamp_ns: int, number: int | None = None) -> bool:
        """Count a sample; return whether it is in order. number: the frame number if the device has one."""
        if self.last_ns is not None:
            step = stamp_ns - self.last_ns
            if step <= 0:
                self.backward += 1
                return False
            self._count_missing(step, number)
        self.first_ns = stamp_ns if self.first_ns is None else self.first_ns
        self.last_ns, self._number = stamp_ns, number
        self.samples += 1
        return True

    def _count_missing(self, step: int, number: int | None) -> None:
        is_gap = step > _STREAM_GAP_FACTOR * self._step_ns
        missing = round(step / self._step_ns) - 1 if is_gap else 0
        if number is not None and self._number is not None and number > self._number:
            missing = number - self._number - 1
        self.missing += missing
        self.gaps += is_gap or missing > 0


# ---- Restart of a device's clock

_MIN_RESTART_NS = 250_000_000  # of past stamps only; bursts of late or repeated samples are shorter


class ClockRestartDetector:
    """Detects an unannounced restart of a device's clock: past stamps only, in order, for a while.

    Call `accept` or `reject` for every sample. Pure: no clock but the samples' own.
    """

    def __init__(self) -> None:
        self._first_ns: dict[str, int] = {}  # of the rejected stamps in order, by stream
        self._last_ns: dict[str, int] = {}

    def accept(self) -> None:
        """Record a usable stamp: the clock has not restarted."""
        self._first_ns.clear()
        self._last_ns.clear()

    def reject(self, stream: str, stamp_ns: int) -> bool:
        """Record a stamp before its stream's latest; return whether the clock has restarted."""
        if stamp_ns <= self._last_ns.get(stream, stamp_ns - 1):
            self._first_ns[stream] = stamp_ns  # back once more: count from here
        self._last_ns[stream] = stamp_ns
        return stamp_ns - self._first_ns.setdefault(stream, stamp_ns) >= _MIN_RESTART_NS
