"""Timers and the token bucket, on a clock that is passed in."""

from __future__ import annotations

SECOND_NS = 1_000_000_000


def seconds(value: float) -> int:
    """Seconds as ns."""
    return round(value * SECOND_NS)


class Every:
    """Due at once, and then again after each period."""

    def __init__(self, period_s: float) -> None:
        self._period_ns = seconds(period_s)
        self._next_ns: int | None = None

    def due(self, now_ns: int) -> bool:
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
        self._seen_ns: int | None = None

    def limit(self, hz: float | None, now_ns: int) -> None:
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
        passed_ns = 0 if self._seen_ns is None else max(0, now_ns - self._seen_ns)
        self._seen_ns = now_ns
        if self.hz is not None:
            self._tokens = min(self._burst, self._tokens + self.hz * passed_ns / SECOND_NS)


class Buckets:
    """A token bucket of each key. One that is full is as if it had never been, and is not kept."""

    def __init__(self, burst: float, hz: float | None) -> None:
        self._burst, self._hz = burst, hz
        self._kept: dict[str, TokenBucket] = {}

    def __len__(self) -> int:
        return len(self._kept)

    def of(self, key: str, now_ns: int) -> TokenBucket:
        if key not in self._kept:
            self._kept = {one: kept for one, kept in self._kept.items() if not kept.is_full(now_ns)}
            self._kept[key] = TokenBucket(self._burst, self._hz)
        return self._kept[key]
