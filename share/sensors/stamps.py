"""Stamps as a device gives them to one time that only goes forward.

Repairs the wrap of the D4xx's 32-bit microsecond counter; believes a jump forward once several
measurements agree on it; drops single stamps that are far off. All streams share one clock.
"""

from __future__ import annotations

from collections.abc import Iterator

from share.sensors.measurement import Measurement

WRAP_NS = 2**32 * 1000  # 4294.967296 s
_MIN_AGREEING = 3  # measurements that must agree before a jump is believed
_MAX_CONTRADICTING = 100  # measurements from before it, after which a jump without witnesses is a stray stamp


class StampRepair:
    """Pure state: feed measurements, get (stamp_ns, measurement) with `stamp_ns` unwrapped.

    `wraps`, `jumps`, `strays` (single stamps far off) and `past` (stamps further back than
    max_jump_s that no wrap explains) count what was done.
    """

    def __init__(self, max_jump_s: float) -> None:
        self.wraps = self.jumps = self.strays = self.past = 0
        self._max_jump_ns = int(max_jump_s * 1e9)
        self._latest_ns: int | None = None
        self._jump_candidates: list[tuple[int, Measurement]] = []
        self._contradictions_left = 0

    def feed(self, measurement: Measurement) -> Iterator[tuple[int, Measurement]]:
        """What may now be used: nothing, this measurement, or a jump's witnesses with it."""
        if self._latest_ns is None:
            self._latest_ns = measurement.stamp_ns
        stamp = self._unwrap(measurement.stamp_ns, self._latest_ns)
        step = stamp - self._latest_ns
        if step < -self._max_jump_ns:
            self.past += 1
        elif step > self._max_jump_ns:
            yield from self._add_jump_candidate(stamp, measurement)
        else:
            self._latest_ns = max(self._latest_ns, stamp)
            if self._jump_candidates:
                self._contradict_jump()
            yield stamp, measurement

    def flush(self) -> Iterator[tuple[int, Measurement]]:
        """At the end of the stream nothing can contradict the suspects any more: a last jump."""
        if self._jump_candidates:
            yield from self._accept_jump()

    def _unwrap(self, raw: int, latest: int) -> int:
        """`raw` plus as many wraps as bring it near; unchanged in the epoch if none does."""
        stamp = raw + self.wraps * WRAP_NS
        if abs(stamp - latest) <= self._max_jump_ns:
            return stamp
        if abs(stamp + WRAP_NS - latest) <= self._max_jump_ns:
            self.wraps += 1
            return stamp + WRAP_NS
        if self.wraps and abs(stamp - WRAP_NS - latest) <= self._max_jump_ns:
            return stamp - WRAP_NS  # a straggler from before the wrap
        return stamp

    def _add_jump_candidate(self, stamp: int, measurement: Measurement) -> Iterator[tuple[int, Measurement]]:
        if self._jump_candidates and abs(stamp - self._jump_candidates[0][0]) > self._max_jump_ns:
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


# ---- Of one stream: what is missing, and what comes in the wrong order.

_GAP_FACTOR = 1.5  # times the expected step: something is missing


class GapCounter:
    """Feed stamps, and frame numbers where the device gives them.

    Counts `samples` (in order), `gaps` (steps longer than expected), `missing` (by frame number where
    given, else as many as fit into the gap), `backward` (not later than the last; to be left out).
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
        """Whether the sample is in order and may be used."""
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
        is_gap = step > _GAP_FACTOR * self._step_ns
        missing = round(step / self._step_ns) - 1 if is_gap else 0
        if number is not None and self._number is not None and number > self._number:
            missing = number - self._number - 1
        self.missing += missing
        self.gaps += is_gap or missing > 0


# ---- A device's clock that began anew without a word: nothing but stamps from the past, in order.

_MIN_RESTART_NS = 250_000_000  # of nothing but the past; a burst of late or doubled samples is shorter


class ClockRestartDetector:
    """Tell it of every sample whether its stamp could be used. Pure: no clock but the samples' own."""

    def __init__(self) -> None:
        self._first_ns: dict[str, int] = {}  # by stream, of the stamps that were refused
        self._last_ns: dict[str, int] = {}

    def accept(self) -> None:
        """Time goes on as it did."""
        self._first_ns.clear()
        self._last_ns.clear()

    def reject(self, stream: str, stamp_ns: int) -> bool:
        """A stamp that lies before what its stream had reached. Whether the clock has begun anew."""
        if stamp_ns <= self._last_ns.get(stream, stamp_ns - 1):
            self._first_ns[stream] = stamp_ns  # back again: it counts from here
        self._last_ns[stream] = stamp_ns
        return stamp_ns - self._first_ns.setdefault(stream, stamp_ns) >= _MIN_RESTART_NS
