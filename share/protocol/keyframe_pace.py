"""Which keyframe candidates an agent sends: by the edge's rate and window, and the better ones first."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from statistics import median

import numpy as np

from share.scheduling.base_delay import BaseDelay
from share.timing import TokenBucket
from share.types import OdometryKeyframe
from share.wire.messages import Rate

RATE_BURST = 2.0  # keyframes that may be saved up under a rate limit
_MIN_RATE_HZ = 0.1  # whatever the edge asks for: without keyframes it could not evaluate again


class KeyframePace:
    """The pace of one agent, without a limit until the edge sends a rate. Times: agent's clock, ns."""

    def __init__(self) -> None:
        self._bucket, self._score = TokenBucket(RATE_BURST), KeyframeScore()
        self._window: KeyframeWindow | None = None  # None: the edge asks for none
        self._poses = TokenBucket(1.0)
        self._held_until_ns = 0
        self.jpeg_quality: int | None = None  # of keyframes' pictures; None: as they are

    @property
    def hz(self) -> float | None:
        """The rate; None: no limit."""
        return self._bucket.hz

    @property
    def window(self) -> int | None:
        """How many keyframes may be unacknowledged; None: as many as the link allows."""
        return None if self._window is None else self._window.size

    def begin_session(self, now_ns: int) -> None:
        """Forget what an earlier session of the edge asked for."""
        self._bucket.set_rate(None, now_ns)
        self._poses.set_rate(None, now_ns)
        self._window = self.jpeg_quality = None

    def hold(self, hold_ms: float, now_ns: int) -> None:
        """Hold keyframes, as a welcome asks for."""
        self._held_until_ns = now_ns + round(1e6 * hold_ms)

    def is_holding(self, now_ns: int) -> bool:
        """Return whether keyframes are still held."""
        return now_ns < self._held_until_ns

    def set_rate(self, rate: Rate, now_ns: int) -> None:
        """Apply a rate of the edge. The first one leaves at most one keyframe saved up: if twelve agents are
        limited at once, their bursts would fill the air."""
        if self._bucket.hz is None:
            self._bucket.limit_saved(1.0)
        self._bucket.set_rate(max(rate.hz, _MIN_RATE_HZ), now_ns)
        self._poses.set_rate(rate.pose_hz, now_ns)
        self.jpeg_quality = rate.jpeg_quality
        if not rate.is_windowed:
            self._window = None
        elif self._window is None:
            self._window = KeyframeWindow()

    def acknowledge(self, acks_ms: Sequence[float], now_ns: int) -> None:
        """Record how long acknowledgements took, ms."""
        if self._window is not None:
            for ack_ms in acks_ms:
                self._window.acknowledge(ack_ms, now_ns)

    def take_pose(self, now_ns: int) -> bool:
        """Return whether a pose is sent now."""
        return self._poses.take(now_ns)

    def take(self, candidate: OdometryKeyframe, unacknowledged: int, now_ns: int) -> bool:
        """Return whether this candidate is sent. unacknowledged: keyframes; 0 while the edge is away, for
        which they are kept."""
        is_preferred = self._score.is_above_median(candidate)
        has_room = self._window is None or unacknowledged < self._window.size
        return has_room and self._bucket.take(now_ns, is_preferred)


MAX_KEYFRAMES = 3  # one under way, one at the edge, one with its acknowledgement under way
LATE_MS = 100.0  # an acknowledgement that takes so much longer than the fastest has met a queue


class KeyframeWindow:
    """How many keyframes may be unacknowledged at a time: a congestion window with slow start (M. Allman et
    al., *TCP Congestion Control*, RFC 5681), with delay as the sign of congestion (LEDBAT, RFC 6817): over a
    radio nothing is lost, it queues. It grows by one with each acknowledgement in time, and is halved by each
    late one."""

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


_SCORE_WINDOW = 20  # recent candidates with which one is compared
_MAX_DEPTH_M = 20.0  # depth beyond which the score does not grow


class KeyframeScore:
    """Scores the keyframe candidates of an agent by their median depth: under a rate limit it prefers views
    that are recognised more often.

    A view of distant structure overlaps with views from elsewhere; a close-up is recognised from the same
    spot only.
    """

    def __init__(self) -> None:
        self._recent_scores: deque[float] = deque(maxlen=_SCORE_WINDOW)

    def is_above_median(self, candidate: OdometryKeyframe) -> bool:
        """Return whether the candidate scores at least the median of the recent ones, itself included."""
        depth = candidate.points[:, 2]
        valid = depth[np.isfinite(depth)]
        score = float(np.median(valid.clip(0.0, _MAX_DEPTH_M))) if valid.size else 0.0
        self._recent_scores.append(score)
        return score >= median(self._recent_scores)
