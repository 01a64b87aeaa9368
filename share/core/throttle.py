"""Limits of how often: for what peers can cause at any rate, such as a line in a log."""

from __future__ import annotations

from share.core.rate import TokenBucket

_MAX_KEYS = 512  # that are told apart; a peer chooses some of them
_NEW_HZ, _NEW_BURST = 2.0, 64.0  # keys that take the place of others where there are so many


class Throttle:
    """Lets each key through `burst` times at once and `hz` times a second, and counts what it holds back.

    Where there are too many keys a new one takes the place of the one that was not asked for the longest; but
    only `_NEW_HZ` of them a second, the others share one limit.
    """

    def __init__(self, hz: float, burst: float) -> None:
        self._hz, self._burst = hz, burst
        self._buckets: dict[object, TokenBucket] = {}  # the one not asked for the longest first
        self._held: dict[object, int] = {}
        self._new = TokenBucket(_NEW_BURST, _NEW_HZ)

    def admit(self, key: object, now_ns: int, before: int = 0) -> int | None:
        """None: held back. Else how many of this key were held back since the last that was let through.
        before: how many somebody else has held back before this one."""
        key = self._known(key, now_ns)
        self._buckets[key] = bucket = self._buckets.pop(key, None) or TokenBucket(self._burst, self._hz)
        if not bucket.take(now_ns):
            self._held[key] = self._held.get(key, 0) + before + 1
            return None
        return self._held.pop(key, 0) + before

    def _known(self, key: object, now_ns: int) -> object:
        """The key under which this one is counted."""
        if key in self._buckets or len(self._buckets) < _MAX_KEYS:
            return key
        if not self._new.take(now_ns):
            return None
        oldest = next(iter(self._buckets))
        del self._buckets[oldest]
        self._held.pop(oldest, None)
        return key
