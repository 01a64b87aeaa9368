"""A device's clock that began anew without a word: nothing but stamps from the past, in order."""

from __future__ import annotations

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
