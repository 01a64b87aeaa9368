"""Limits of how often: for what peers can cause at any rate, such as a line in a log."""

from __future__ import annotations

from share.core.rate import TokenBucket

_MAX_KEYS = 512  # that are told apart; a peer chooses some of them


class Throttle:
    """Lets each key through `burst` times at once and `hz` times a second, and counts what it holds back."""

    def __init__(self, hz: float, burst: float) -> None:
        self._hz, self._burst = hz, burst
        self._buckets: dict[object, TokenBucket] = {}
        self._held: dict[object, int] = {}

    def admit(self, key: object, now_ns: int) -> int | None:
        """None: held back. Else how many of this key were held back since the last that was let through."""
        if key not in self._buckets and len(self._buckets) >= _MAX_KEYS:
            key = None  # all further keys share one bucket
        bucket = self._buckets.get(key)
        if bucket is None:
            bucket = self._buckets[key] = TokenBucket(self._burst)
            bucket.limit(self._hz, now_ns)
        if not bucket.take(now_ns):
            self._held[key] = self._held.get(key, 0) + 1
            return None
        return self._held.pop(key, 0)
