"""When an agent's frames arrived at it, on the server's clock, from when its poses came here; and how its
body moves.

The delay of a message is at least the least one lately: what is above it, its frame has waited for. Stamps
pass on the agent's own clock, so they are even where messages are not.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.timing import seconds_to_ns
from share.types import F64

_WINDOW_S = 10.0  # in which the least delay is sought: clocks drift by a millisecond in 20 s
_MAX_LATE_S = 2.0  # later than that: the agent's clock was set
_LEAST_S, _MOST_S = 0.05, 0.2  # between the poses that a velocity is taken from
_MAX_TURN = 0.9 * np.pi  # rad between them; more is ambiguous


@dataclass(frozen=True)
class _Delay:
    received_ns: int
    delay_ns: int  # against the stamp, by two clocks


class LeastDelay:
    """Offset of one agent's clock from the server's."""

    def __init__(self) -> None:
        self._candidates: deque[_Delay] = deque()  # delays rising, times rising: the first is the least
        self._least_rtt_ms: float | None = None

    def set_rtt(self, rtt_ms: float | None) -> None:
        """Take the round trip that the agent reports, filtered; half of the least is the way here."""
        if rtt_ms is not None:
            known = self._least_rtt_ms
            self._least_rtt_ms = rtt_ms if known is None else min(rtt_ms, known)

    def time_of(self, stamp_ns: int, received_ns: int, age_ms: float) -> int:
        """Return when the frame of a pose arrived at its agent, ns. received_ns: when the pose came here;
        age_ms: how long after the frame it was sent."""
        delay = _Delay(received_ns, received_ns - round(age_ms * 1e6) - stamp_ns)
        kept = self._candidates
        if kept and delay.delay_ns - kept[0].delay_ns > seconds_to_ns(_MAX_LATE_S):
            kept.clear()
        while kept and kept[-1].delay_ns >= delay.delay_ns:
            kept.pop()
        kept.append(delay)
        while kept[0].received_ns < received_ns - seconds_to_ns(_WINDOW_S):
            kept.popleft()
        return stamp_ns + kept[0].delay_ns - round((self._least_rtt_ms or 0.0) * 1e6 / 2)


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """velocity (3,): m/s along the axes of odom. angular_velocity (3,): rad/s about the body's."""

    velocity: F64
    angular_velocity: F64


class MotionEstimate:
    """How a body moves, by its newest poses in odom: the mean over a twentieth of a second."""

    def __init__(self) -> None:
        self._poses: deque[tuple[int, F64]] = deque()

    def add(self, stamp_ns: int, T_odom_body: F64) -> BodyMotion | None:
        """Take the newest pose (4, 4); return the motion, None before there are poses enough."""
        if self._poses and stamp_ns <= self._poses[-1][0]:
            self._poses.clear()
        self._poses.append((stamp_ns, T_odom_body))
        while len(self._poses) > 2 and self._poses[1][0] <= stamp_ns - seconds_to_ns(_LEAST_S):
            self._poses.popleft()
        elapsed_s = (stamp_ns - self._poses[0][0]) * 1e-9
        if elapsed_s > _MOST_S:
            self._poses = deque([self._poses[-1]])
        if not _LEAST_S <= elapsed_s <= _MOST_S:
            return None
        before = self._poses[0][1]
        turn = se3.so3_log(before[:3, :3].T @ T_odom_body[:3, :3])
        if np.linalg.norm(turn) > _MAX_TURN:
            return None
        return BodyMotion((T_odom_body[:3, 3] - before[:3, 3]) / elapsed_s, turn / elapsed_s)

    def forget(self) -> None:
        """Forget all poses: odometry begins anew."""
        self._poses.clear()
