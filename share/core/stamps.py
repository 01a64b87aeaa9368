"""Stamps as a device gives them to one time that only goes forward.

Repairs the wrap of the D4xx's 32-bit microsecond counter; believes a jump forward once several
measurements agree on it; drops single stamps that are far off. All streams share one clock.
"""

from __future__ import annotations

from collections.abc import Iterator

from share.core.measurement import Measurement

WRAP_NS = 2**32 * 1000  # 4294.967296 s
_WITNESSES = 3  # measurements that must agree before a jump is believed
_PATIENCE = 100  # measurements from before it, after which a jump without witnesses is a stray stamp


class StampRepair:
    """Pure state: feed measurements, get (stamp_ns, measurement) with `stamp_ns` unwrapped.

    `wraps`, `jumps`, `strays` (single stamps far off) and `past` (stamps further back than
    max_jump_s that no wrap explains) count what was done.
    """

    def __init__(self, max_jump_s: float) -> None:
        self.wraps = self.jumps = self.strays = self.past = 0
        self._max_ns = int(max_jump_s * 1e9)
        self._latest: int | None = None
        self._suspects: list[tuple[int, Measurement]] = []
        self._patience = 0

    def feed(self, measurement: Measurement) -> Iterator[tuple[int, Measurement]]:
        """What may now be used: nothing, this measurement, or a jump's witnesses with it."""
        if self._latest is None:
            self._latest = measurement.stamp_ns
        stamp = self._unwrap(measurement.stamp_ns, self._latest)
        step = stamp - self._latest
        if step < -self._max_ns:
            self.past += 1
        elif step > self._max_ns:
            yield from self._suspect(stamp, measurement)
        else:
            self._latest = max(self._latest, stamp)
            if self._suspects:
                self._doubt()
            yield stamp, measurement

    def flush(self) -> Iterator[tuple[int, Measurement]]:
        """At the end of the stream nothing can contradict the suspects any more: a last jump."""
        if self._suspects:
            yield from self._believe()

    def _unwrap(self, raw: int, latest: int) -> int:
        """`raw` plus as many wraps as bring it near; unchanged in the epoch if none does."""
        stamp = raw + self.wraps * WRAP_NS
        if abs(stamp - latest) <= self._max_ns:
            return stamp
        if abs(stamp + WRAP_NS - latest) <= self._max_ns:
            self.wraps += 1
            return stamp + WRAP_NS
        if self.wraps and abs(stamp - WRAP_NS - latest) <= self._max_ns:
            return stamp - WRAP_NS  # a straggler from before the wrap
        return stamp

    def _suspect(self, stamp: int, measurement: Measurement) -> Iterator[tuple[int, Measurement]]:
        if self._suspects and abs(stamp - self._suspects[0][0]) > self._max_ns:
            self.strays += len(self._suspects)
            self._suspects = []
        self._suspects.append((stamp, measurement))
        self._patience = _PATIENCE
        if len(self._suspects) >= _WITNESSES:
            yield from self._believe()

    def _doubt(self) -> None:
        self._patience -= 1
        if self._patience <= 0:
            self.strays += len(self._suspects)
            self._suspects = []

    def _believe(self) -> Iterator[tuple[int, Measurement]]:
        self.jumps += 1
        self._latest = max(stamp for stamp, _ in self._suspects)
        yield from self._suspects
        self._suspects = []
