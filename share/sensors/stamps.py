"""Stamps as a device gives them to one time that only goes forward.

Repairs the wrap of the D4xx's 32-bit microsecond counter; believes a jump forward once several
measurements agree on it; drops single stamps that are far off. All streams share one clock.
"""

from __future__ import annotations

from collections.abc import Iterator

from share.sensors.measurement import Measurement

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


# ---- Of one stream: what is missing, and what comes in the wrong order.

_LATE = 1.5  # times the expected step: something is missing


class Gaps:
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
            self._missing(step, number)
        self.first_ns = stamp_ns if self.first_ns is None else self.first_ns
        self.last_ns, self._number = stamp_ns, number
        self.samples += 1
        return True

    def _missing(self, step: int, number: int | None) -> None:
        late = step > _LATE * self._step_ns
        lost = round(step / self._step_ns) - 1 if late else 0
        if number is not None and self._number is not None and number > self._number:
            lost = number - self._number - 1
        self.missing += lost
        self.gaps += late or lost > 0


# ---- A device's clock that began anew without a word: nothing but stamps from the past, in order.

_LONG_NS = 250_000_000  # of nothing but the past; a burst of late or doubled samples is shorter


class Restart:
    """Tell it of every sample whether its stamp could be used. Pure: no clock but the samples' own."""

    def __init__(self) -> None:
        self._first_ns: dict[str, int] = {}  # by stream, of the stamps that were refused
        self._last_ns: dict[str, int] = {}

    def used(self) -> None:
        """Time goes on as it did."""
        self._first_ns.clear()
        self._last_ns.clear()

    def refused(self, stream: str, stamp_ns: int) -> bool:
        """A stamp that lies before what its stream had reached. Whether the clock has begun anew."""
        if stamp_ns <= self._last_ns.get(stream, stamp_ns - 1):
            self._first_ns[stream] = stamp_ns  # back again: it counts from here
        self._last_ns[stream] = stamp_ns
        return stamp_ns - self._first_ns.setdefault(stream, stamp_ns) >= _LONG_NS
