"""Timers, limits on rates and lines, restart backoff and a ring buffer. The time is passed in."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence

from share.errors import printable

SECOND_NS = 1_000_000_000


def seconds_to_ns(duration_s: float) -> int:
    """Return seconds as ns."""
    return round(duration_s * SECOND_NS)


class PeriodicTimer:
    """Due at once, then after each period."""

    def __init__(self, period_s: float) -> None:
        self._period_ns = seconds_to_ns(period_s)
        self._next_ns: int | None = None

    def fire_if_due(self, now_ns: int) -> bool:
        if self._next_ns is not None and now_ns < self._next_ns:
            return False
        self._next_ns = now_ns + self._period_ns
        return True

    def postpone(self, until_ns: int) -> None:
        """Make it not due before `until_ns`."""
        self._next_ns = until_ns


class TokenBucket:
    """Token bucket: passes `hz` a second on average, at most `burst` at once; everything while hz is None.

    Items that are not preferred pass only when the bucket is full, where a token would be lost otherwise.
    """

    def __init__(self, burst: float, hz: float | None = None) -> None:
        self.hz = hz
        self._burst = burst
        self._tokens = burst
        self._refilled_ns: int | None = None

    def set_rate(self, hz: float | None, now_ns: int) -> None:
        """Set a new rate; saved tokens stay."""
        self._refill(now_ns)
        self.hz = hz

    def limit_saved(self, most: float) -> None:
        """Take the saved tokens beyond `most`."""
        self._tokens = min(self._tokens, most)

    def take(self, now_ns: int, preferred: bool = True, cost: float = 1.0) -> bool:
        """Take `cost` tokens. Return whether the item may pass now."""
        self._refill(now_ns)
        if self.hz is None:
            return True
        if self._tokens < (cost if preferred else self._burst) - 1e-9:
            return False
        self._tokens -= cost
        return True

    def wait_s(self, now_ns: int) -> float:
        """Return the time until a token is available, s; 0: now."""
        self._refill(now_ns)
        return 0.0 if self.hz is None else max(0.0, (1 - 1e-9 - self._tokens) / self.hz)

    def is_full(self, now_ns: int) -> bool:
        """Return whether no token is missing."""
        self._refill(now_ns)
        return self.hz is None or self._tokens >= self._burst

    def _refill(self, now_ns: int) -> None:
        elapsed_ns = 0 if self._refilled_ns is None else max(0, now_ns - self._refilled_ns)
        self._refilled_ns = now_ns
        if self.hz is not None:
            self._tokens = min(self._burst, self._tokens + self.hz * elapsed_ns / SECOND_NS)


class TokenBuckets:
    """One token bucket per key. Full ones are dropped: they equal new ones."""

    def __init__(self, burst: float, hz: float | None) -> None:
        self._burst, self._hz = burst, hz
        self._buckets: dict[str, TokenBucket] = {}

    def __len__(self) -> int:
        return len(self._buckets)

    def count_used(self, now_ns: int) -> int:
        """Return how many keys have taken tokens that are not refilled yet."""
        return sum(not one.is_full(now_ns) for one in self._buckets.values())

    def bucket(self, key: str, now_ns: int) -> TokenBucket:
        if key not in self._buckets:
            self._buckets = {one: kept for one, kept in self._buckets.items() if not kept.is_full(now_ns)}
            self._buckets[key] = TokenBucket(self._burst, self._hz)
        return self._buckets[key]


_MAX_PAUSE_S = 60.0
_HEALTHY_NS = 10_000_000_000  # of most processes


class Backoff:
    """Restart delay of a process that keeps dying: 1, 2, 4 … 60 s."""

    def __init__(self, now_ns: int, healthy_ns: int = _HEALTHY_NS) -> None:
        """now_ns: when the process was first started. healthy_ns: run time after which failures count
        anew."""
        self._started_ns, self._healthy_ns = now_ns, healthy_ns
        self.failures = 0  # in a row

    def record_failure(self, now_ns: int) -> float:
        """Record that the process died. Return the delay until its restart, s."""
        self.failures = 1 if now_ns - self._started_ns >= self._healthy_ns else self.failures + 1
        pause_s = min(2.0 ** min(self.failures - 1, 30), _MAX_PAUSE_S)
        self._started_ns = now_ns + round(1e9 * pause_s)
        return pause_s


_MAX_KEYS = 512  # separate limits; peers choose some of the keys
_NEW_KEY_HZ, _NEW_KEY_BURST = 2.0, 64.0  # replacements of a key when all are in use


class Throttle:
    """Limits events that peers can cause at any rate, such as log lines: per key `burst` at once and `hz` a
    second. Counts those held back.

    Beyond _MAX_KEYS a new key replaces the least recently used one, at most `_NEW_KEY_HZ` a second; further
    keys share one limit.
    """

    def __init__(self, hz: float, burst: float) -> None:
        self._hz, self._burst = hz, burst
        self._buckets: dict[object, TokenBucket] = {}  # least recently used first
        self._suppressed: dict[object, int] = {}
        self._new_key_bucket = TokenBucket(_NEW_KEY_BURST, _NEW_KEY_HZ)

    def admit(self, key: object, now_ns: int, already_suppressed: int = 0) -> int | None:
        """Return None if held back, else how many of this key were held back since the last that passed.
        already_suppressed: number held back by another limit before this event."""
        key = self._counted_key(key, now_ns)
        self._buckets[key] = bucket = self._buckets.pop(key, None) or TokenBucket(self._burst, self._hz)
        if not bucket.take(now_ns):
            self._suppressed[key] = self._suppressed.get(key, 0) + already_suppressed + 1
            return None
        return self._suppressed.pop(key, 0) + already_suppressed

    def _counted_key(self, key: object, now_ns: int) -> object:
        """Return the key under which this one is counted; None: the shared limit."""
        if key in self._buckets or len(self._buckets) < _MAX_KEYS:
            return key
        if not self._new_key_bucket.take(now_ns):
            return None
        oldest = next(iter(self._buckets))
        del self._buckets[oldest]
        self._suppressed.pop(oldest, None)
        return key


_LINE_HZ, _LINE_BURST = 0.2, 20.0  # 20 lines at once, then one each 5 s
_MAX_LINE_LENGTH = 300  # characters
_MAX_REMEMBERED_LINES = 16
_QUIET_NS = 60_000_000_000  # a fault absent for this long is new again


class LineLimiter:
    """Limits lines for a person, so that neither a peer nor a lasting fault fills a terminal or a log."""

    def __init__(self) -> None:
        self._throttle = Throttle(_LINE_HZ, _LINE_BURST)
        self._last_seen_ns: dict[str, int] = {}  # by kind, least recently seen first

    def admit(self, text: str, now_ns: int) -> str | None:
        """Return the line in printable characters, with the number of lines suppressed before it; None if it
        is suppressed."""
        if (suppressed := self._throttle.admit(None, now_ns)) is None:
            return None
        line = printable(text[:_MAX_LINE_LENGTH])
        return f"{line} ({suppressed} lines before this were suppressed)" if suppressed else line

    def admit_new(self, text: str, now_ns: int, kind: str | None = None) -> str | None:
        """Return the line as `admit` does the first time, and after none of its kind came for a minute; else
        None. kind: the text itself by default."""
        kind = text if kind is None else kind
        last_ns = self._last_seen_ns.pop(kind, None)
        self._last_seen_ns[kind] = now_ns
        if len(self._last_seen_ns) > _MAX_REMEMBERED_LINES:
            del self._last_seen_ns[next(iter(self._last_seen_ns))]
        is_new = last_ns is None or now_ns - last_ns > _QUIET_NS
        return self.admit(text, now_ns) if is_new else None


class RingBuffer:
    """The newest `max_rows` rows of `columns` numbers or None. Eight bytes a number, allocated as needed."""

    def __init__(self, columns: int, max_rows: int) -> None:
        self._columns, self._max_rows = columns, max_rows
        self._values = array("d")
        self._next_row = 0  # next row to overwrite, once full

    def __len__(self) -> int:
        return len(self._values) // self._columns

    def add(self, row: Sequence[float | None]) -> None:
        """Append a row. Raises ValueError for a wrong number of columns."""
        if len(row) != self._columns:
            raise ValueError(f"row: {len(row)} numbers, expected {self._columns}")
        values = array("d", [math.nan if value is None else value for value in row])
        if len(self) < self._max_rows:
            self._values.extend(values)
            return
        begin = self._next_row * self._columns
        self._values[begin : begin + self._columns] = values
        self._next_row = (self._next_row + 1) % self._max_rows

    def column(self, index: int) -> list[float | None]:
        """Return a column, oldest first."""
        column = self._values[index :: self._columns]
        in_order = column[self._next_row :] + column[: self._next_row]
        return [None if math.isnan(value) else value for value in in_order]
