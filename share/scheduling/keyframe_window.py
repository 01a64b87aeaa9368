"""How many keyframes of an agent may be unacknowledged at a time: a congestion window with slow start.

Source: M. Allman et al., *TCP Congestion Control* (RFC 5681), with delay as the sign of congestion (LEDBAT,
RFC 6817): over a radio nothing is lost, it queues.
"""

from __future__ import annotations

from share.scheduling.base_delay import BaseDelay

MAX_KEYFRAMES = 3  # a keyframe under way, one at the edge, one whose acknowledgement comes back
LATE_MS = 100.0  # an acknowledgement that takes so much longer than the fastest has met a queue


class KeyframeWindow:
    """Grows by one with each acknowledgement in time, and is halved by each late one."""

    def __init__(self) -> None:
        self._size, self._base = 1.0, BaseDelay()

    @property
    def size(self) -> int:
        """Number of keyframes that may be unacknowledged, 1 to MAX_KEYFRAMES."""
        return int(self._size)

    def acknowledge(self, ack_ms: float, now_ns: int) -> None:
        """Record an acknowledgement, `ack_ms` after its keyframe was sent."""
        self._base = self._base.with_delay(ack_ms, now_ns)
        is_late = ack_ms > self._base.ms + LATE_MS
        self._size = max(1.0, self._size / 2) if is_late else min(MAX_KEYFRAMES, self._size + 1)
