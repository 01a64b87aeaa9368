"""Timers and the token bucket, on a clock that is passed in."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence

SECOND_NS = 1_000_000_000


def seconds_to_ns(duration_s: float) -> int:
    """Seconds as ns."""
    return round(duration_s * SECOND_NS)


class PeriodicTimer:
    """Due at once, and then again after each period."""

    def __init__(self, period_s: float) -> None:
        self._period_ns = seconds_to_ns(period_s)
        self._next_ns: int | None = None

    def fire_if_due(self, now_ns: int) -> bool:
        if self._next_ns is not None and now_ns < self._next_ns:
            return False
        self._next_ns = now_ns + self._period_ns
        return True

    def postpone(self, until_ns: int) -> None:
        """Not due before `until_ns`."""
        self._next_ns = until_ns


class TokenBucket:
    """Lets `hz` a second through on average, at most `burst` at once; everything while hz is None.

    What is not preferred passes only where a token would be lost otherwise: when `burst` have been saved up.
    """

    def __init__(self, burst: float, hz: float | None = None) -> None:
        self.hz = hz
        self._burst = burst
        self._tokens = burst
        self._refilled_ns: int | None = None

    def set_rate(self, hz: float | None, now_ns: int) -> None:
        """A new rate from now on; what has been saved up stays."""
        self._refill(now_ns)
        self.hz = hz

    def take(self, now_ns: int, preferred: bool = True, cost: float = 1.0) -> bool:
        """Whether one may pass now; cost: one that counts as so many."""
        self._refill(now_ns)
        if self.hz is None:
            return True
        if self._tokens < (cost if preferred else self._burst) - 1e-9:
            return False
        self._tokens -= cost
        return True

    def wait_s(self, now_ns: int) -> float:
        """How long until one may pass, s; 0: now."""
        self._refill(now_ns)
        return 0.0 if self.hz is None else max(0.0, (1 - 1e-9 - self._tokens) / self.hz)

    def is_full(self, now_ns: int) -> bool:
        """Whether it is as if nothing had ever passed."""
        self._refill(now_ns)
        return self.hz is None or self._tokens >= self._burst

    def _refill(self, now_ns: int) -> None:
        elapsed_ns = 0 if self._refilled_ns is None else max(0, now_ns - self._refilled_ns)
        self._refilled_ns = now_ns
        if self.hz is not None:
            self._tokens = min(self._burst, self._tokens + self.hz * elapsed_ns / SECOND_NS)


class TokenBuckets:
    """A token bucket of each key. One that is full is as if it had never been, and is not kept."""

    def __init__(self, burst: float, hz: float | None) -> None:
        self._burst, self._hz = burst, hz
        self._buckets: dict[str, TokenBucket] = {}

    def __len__(self) -> int:
        return len(self._buckets)

    def bucket(self, key: str, now_ns: int) -> TokenBucket:
        if key not in self._buckets:
            self._buckets = {one: kept for one, kept in self._buckets.items() if not kept.is_full(now_ns)}
            self._buckets[key] = TokenBucket(self._burst, self._hz)
        return self._buckets[key]


# ---- How long to wait before a process that has died is started again.

_MAX_PAUSE_S = 60.0
_HEALTHY_NS = 10_000_000_000  # who has lived so long was well: its next death is a first one


class Backoff:
    """1, 2, 4 … 60 s while a process dies again and again. It has no clock: times are given (ns)."""

    def __init__(self, now_ns: int) -> None:
        """now_ns: when the process was first started."""
        self._started_ns = now_ns
        self.failures = 0  # one after the other, none of which it was well before

    def record_failure(self, now_ns: int) -> float:
        """Seconds from now until it is to be started again."""
        self.failures = 1 if now_ns - self._started_ns >= _HEALTHY_NS else self.failures + 1
        pause_s = min(2.0 ** min(self.failures - 1, 30), _MAX_PAUSE_S)
        self._started_ns = now_ns + round(1e9 * pause_s)
        return pause_s


# ---- Limits of how often: for what peers can cause at any rate, such as a line in a log.

_MAX_KEYS = 512  # that are told apart; a peer chooses some of them
_NEW_KEY_HZ, _NEW_KEY_BURST = 2.0, 64.0  # keys that take the place of others where there are so many


class Throttle:
    """Lets each key through `burst` times at once and `hz` times a second, and counts what it holds back.

    Where there are too many keys a new one takes the place of the one that was not asked for the longest; but
    only `_NEW_KEY_HZ` of them a second, the others share one limit.
    """

    def __init__(self, hz: float, burst: float) -> None:
        self._hz, self._burst = hz, burst
        self._buckets: dict[object, TokenBucket] = {}  # the one not asked for the longest first
        self._suppressed: dict[object, int] = {}
        self._new_key_bucket = TokenBucket(_NEW_KEY_BURST, _NEW_KEY_HZ)

    def admit(self, key: object, now_ns: int, already_suppressed: int = 0) -> int | None:
        """None: held back. Else how many of this key were held back since the last that was let through.
        before: how many somebody else has held back before this one."""
        key = self._counted_key(key, now_ns)
        self._buckets[key] = bucket = self._buckets.pop(key, None) or TokenBucket(self._burst, self._hz)
        if not bucket.take(now_ns):
            self._suppressed[key] = self._suppressed.get(key, 0) + already_suppressed + 1
            return None
        return self._suppressed.pop(key, 0) + already_suppressed

    def _counted_key(self, key: object, now_ns: int) -> object:
        """The key under which this one is counted."""
        if key in self._buckets or len(self._buckets) < _MAX_KEYS:
            return key
        if not self._new_key_bucket.take(now_ns):
            return None
        oldest = next(iter(self._buckets))
        del self._buckets[oldest]
        self._suppressed.pop(oldest, None)
        return key


# ---- The newest rows of a table of numbers, in little memory.


class RingBuffer:
    """Rows of `columns` numbers, or None; the newest `max_rows` of them. Eight bytes a number, and none
    before it is needed."""

    def __init__(self, columns: int, max_rows: int) -> None:
        self._columns, self._max_rows = columns, max_rows
        self._values = array("d")
        self._next_row = 0  # row that is written next, once all are taken

    def __len__(self) -> int:
        return len(self._values) // self._columns

    def add(self, row: Sequence[float | None]) -> None:
        """Raises ValueError for another number of columns."""
        if len(row) != self._columns:
            raise ValueError(f"row: {len(row)} numbers instead of {self._columns}")
        values = array("d", [math.nan if value is None else value for value in row])
        if len(self) < self._max_rows:
            self._values.extend(values)
            return
        begin = self._next_row * self._columns
        self._values[begin : begin + self._columns] = values
        self._next_row = (self._next_row + 1) % self._max_rows

    def column(self, index: int) -> list[float | None]:
        """Oldest first."""
        column = self._values[index :: self._columns]
        in_order = column[self._next_row :] + column[: self._next_row]
        return [None if math.isnan(value) else value for value in in_order]
