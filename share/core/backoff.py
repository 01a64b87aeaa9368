"""How long to wait before a process that has died is started again."""

from __future__ import annotations

_LONGEST_S = 60.0
_WELL_NS = 10_000_000_000  # who has lived so long was well: its next death is a first one


class Backoff:
    """1, 2, 4 … 60 s while a process dies again and again. It has no clock: times are given (ns)."""

    def __init__(self, now_ns: int) -> None:
        """now_ns: when the process was first started."""
        self._started_ns = now_ns
        self.deaths = 0  # one after the other, none of which it was well before

    def died(self, now_ns: int) -> float:
        """Seconds from now until it is to be started again."""
        self.deaths = 1 if now_ns - self._started_ns >= _WELL_NS else self.deaths + 1
        pause_s = min(2.0 ** min(self.deaths - 1, 30), _LONGEST_S)
        self._started_ns = now_ns + round(1e9 * pause_s)
        return pause_s
