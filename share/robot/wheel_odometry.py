"""The newest seconds of a robot's odometry, and the robot's clock by its stamps."""

from __future__ import annotations

from collections import deque
from itertools import pairwise

from share.robot.planar import PlanarPose, between
from share.timing import SECOND_NS, seconds_to_ns

_KEEP_NS = seconds_to_ns(3.0)
_MAX_GAP_NS = seconds_to_ns(0.3)  # Create 3 sends 20 a second; across more, a turn is not a straight line
_JUMP_M, _MAX_SPEED_M_S = 0.1, 1.5  # no robot gets further between two samples


class WheelOdometry:
    """Samples of T_odom_base by rising stamp.

    The robot's clock is ahead of the host's by at most the greatest (stamp - arrival): no sample arrives
    before it was made. The quickest sample of the last seconds gives the clock to its own delay.
    """

    def __init__(self) -> None:
        self._samples: deque[tuple[int, int, PlanarPose]] = deque()  # stamp, stamp - arrival, T_odom_base
        self._ahead_ns: int | None = None

    def add(self, stamp_ns: int, arrived_ns: int, T_odom_base: PlanarPose) -> bool:
        """Add a sample; one that comes late is ignored. Return False, and forget the others, if it cannot
        follow them: odometry began anew."""
        follows = True
        if self._samples:
            last_ns, _, last = self._samples[-1]
            if last_ns - _KEEP_NS < stamp_ns <= last_ns:
                return True
            way_m = _JUMP_M + _MAX_SPEED_M_S * (stamp_ns - last_ns) / SECOND_NS
            follows = stamp_ns > last_ns and last.distance_m(T_odom_base) <= way_m
        if not follows:
            self._samples.clear()
        self._samples.append((stamp_ns, stamp_ns - arrived_ns, T_odom_base))
        while self._samples[0][0] < stamp_ns - _KEEP_NS:
            self._samples.popleft()
        self._ahead_ns = max(ahead_ns for _, ahead_ns, _ in self._samples)
        return follows

    @property
    def newest(self) -> PlanarPose | None:
        return self._samples[-1][2] if self._samples else None

    @property
    def newest_stamp_ns(self) -> int | None:
        return self._samples[-1][0] if self._samples else None

    def robot_ns(self, host_ns: int) -> int | None:
        """Return the robot's clock at a time of the host; None before the first sample."""
        return None if self._ahead_ns is None else host_ns + self._ahead_ns

    def at(self, stamp_ns: int) -> PlanarPose | None:
        """Return T_odom_base at a stamp, interpolated; None where it is not between two samples."""
        if not self._samples or stamp_ns > self._samples[-1][0]:
            return None
        for newer, older in pairwise(reversed(self._samples)):
            if older[0] <= stamp_ns <= newer[0]:
                step_ns = newer[0] - older[0]
                if step_ns > _MAX_GAP_NS:
                    return None
                return between(older[2], newer[2], (stamp_ns - older[0]) / step_ns)
        return self._samples[0][2] if self._samples[0][0] == stamp_ns else None
