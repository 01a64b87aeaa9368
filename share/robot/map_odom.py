"""`map → odom` of a robot from the agent's poses and the robot's odometry, and why there is none."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from share.mapping.localisation_gate import AHEAD_M
from share.robot import robot_events as ev
from share.robot.planar import PlanarPose, flattened, wrapped
from share.robot.settings import RobotSettings
from share.robot.wheel_odometry import WheelOdometry
from share.timing import seconds_to_ns

STALE_S = 0.5  # a pose or odometry older than this is none
CLOCK_LIMIT_S = 1.0  # between the robot's clock and this machine's
_STALE_NS, _CLOCK_LIMIT_NS = seconds_to_ns(STALE_S), seconds_to_ns(CLOCK_LIMIT_S)
_FOREIGN_NS = seconds_to_ns(
    3.0
)  # another map → odom counts so long; AMCL repeats its own at least each second
_MAX_PENDING = 16  # poses that wait for odometry: half a second at 30 Hz
_REORDERED = (
    64  # a sequence number so much lower is of a late datagram, one still lower of an agent begun anew
)
_MOVED_M = 0.5  # a map moved if the robot and what is ahead of it did by more
_SIMULATED_NS = seconds_to_ns(1e8)  # a clock before 1973 is a simulation's


@dataclass(frozen=True)
class MapJumped:
    """The map moved under the robot. text: how, for a person."""

    text: str


class MapOdom:
    """T_map_odom = T_map_base inv(T_odom_base(t)) at each pose's own time t, on the floor.

    A pose waits until odometry on both sides of it has come. T_map_odom, map_id: of the newest pose; None
    before the first, and after a loss.
    """

    def __init__(self, settings: RobotSettings) -> None:
        self._settings = settings
        self._agent = settings.agent
        self._odometry = WheelOdometry()
        self.T_map_odom: PlanarPose | None = None
        self.map_id: str | None = None
        self._pending: deque[tuple[int, PlanarPose, str]] = deque(maxlen=_MAX_PENDING)  # host time, …, map
        self._sequence: int | None = None
        self._pose_ns: int | None = None  # time of the newest pose in the map, host
        self._odometry_ns: int | None = None  # arrival of the newest sample
        self._foreign_ns: int | None = None
        self._pose_fault: str | None = "no poses yet; is the agent running, with --poses to this address?"
        self._odometry_fault: str | None = "no odometry yet; is the robot on, in this domain and namespace?"
        self._foreign = ""

    # ------------------------------------------------------------ in

    def add_pose(self, pose: ev.AgentPoseReceived, now_ns: int) -> MapJumped | None:
        """Add a message of the pose stream. Return how the map moved by it, if it did."""
        self._agent = self._agent or pose.agent
        if pose.agent != self._agent or self._is_late(pose.sequence):
            return None
        self._sequence = pose.sequence
        self._pose_fault = self._fault_of(pose)
        if self._pose_fault is not None or pose.T_map_body is None or pose.map_id is None:
            self._pending.clear()
            self.T_map_odom = None
            return None
        self._pose_ns = now_ns - (pose.age_ns or 0)
        T_map_base = flattened(pose.T_map_body @ self._settings.T_body_base)
        self._pending.append((self._pose_ns, T_map_base, pose.map_id))
        return self._resolve()

    def add_odometry(self, event: ev.OdometryReceived, now_ns: int) -> MapJumped | None:
        """Add a sample of odometry. Return how the map moved by the poses that waited for it."""
        self._odometry_fault = _odometry_fault(event)
        if self._odometry_fault is not None:
            return None
        self._odometry_ns = now_ns
        if not self._odometry.add(event.stamp_ns, now_ns, event.T_odom_base):
            self._pending.clear()  # the robot's odom is another one
            self.T_map_odom = None
        return self._resolve()

    def add_foreign(self, frame: str, now_ns: int) -> None:
        """Another program publishes where odom is in `frame`."""
        self._foreign_ns, self._foreign = now_ns, frame

    def _is_late(self, sequence: int) -> bool:
        return self._sequence is not None and self._sequence - _REORDERED < sequence <= self._sequence

    def _fault_of(self, pose: ev.AgentPoseReceived) -> str | None:
        if not pose.state.has_pose:
            return f"{pose.agent} has lost tracking ({pose.state})"
        if pose.T_map_body is None or pose.map_id is None:
            return f"{pose.agent} is not localised in the map yet"
        if pose.sigma_m is None:
            return f"{pose.agent} sends no covariance; use a camera with an IMU"
        if pose.sigma_m > self._settings.max_sigma_m:
            return f"{pose.agent}'s position sigma exceeds {self._settings.max_sigma_m:g} m"
        return None

    def _resolve(self) -> MapJumped | None:
        """Take the poses for which odometry is known on both sides. Return the last move of the map."""
        moved: MapJumped | None = None
        while self._pending:
            pose_ns, T_map_base, map_id = self._pending[0]
            stamp_ns, newest_ns = self._odometry.robot_ns(pose_ns), self._odometry.newest_stamp_ns
            if stamp_ns is None or newest_ns is None or stamp_ns > newest_ns:
                break
            self._pending.popleft()
            if (T_odom_base := self._odometry.at(stamp_ns)) is not None:
                moved = self._take(T_map_base @ T_odom_base.inverse(), map_id) or moved
        return moved

    def _take(self, T_map_odom: PlanarPose, map_id: str) -> MapJumped | None:
        before, self.T_map_odom = self.T_map_odom, T_map_odom
        map_before, self.map_id = self.map_id, map_id
        if map_before is not None and map_id != map_before:
            return MapJumped(f"the map is now {map_id}, before {map_before}")
        if before is None or (T_odom_base := self._odometry.newest) is None:
            return None
        old, new = before @ T_odom_base, T_map_odom @ T_odom_base
        way_m = old.distance_m(new) + AHEAD_M * abs(wrapped(new.yaw - old.yaw))
        return MapJumped(f"a correction moved the map by {way_m:.1f} m") if way_m > _MOVED_M else None

    # ------------------------------------------------------------ out

    def fault(self, now_ns: int) -> str | None:
        """Return why the robot's place in the map is not known; None if it is."""
        if self._foreign_ns is not None and now_ns - self._foreign_ns <= _FOREIGN_NS:
            return (
                f"another program publishes {self._foreign} → odom; "
                "turn AMCL, slam_toolbox or that bridge off"
            )
        if self._odometry_fault is not None:
            return self._odometry_fault
        if self._odometry_ns is None or now_ns - self._odometry_ns > _STALE_NS:
            return f"no odometry for {STALE_S:g} s; is the robot on, and the network up?"
        if self._pose_fault is not None:
            return self._pose_fault
        if self._pose_ns is None or now_ns - self._pose_ns > _STALE_NS:
            return f"no pose for {STALE_S:g} s; is the agent running?"
        if self.T_map_odom is None:
            return "no odometry at the time of the pose"
        return None

    @property
    def T_map_base(self) -> PlanarPose | None:
        """Where the robot is by the newest pose and odometry."""
        newest = self._odometry.newest
        return None if self.T_map_odom is None or newest is None else self.T_map_odom @ newest

    def robot_ns(self, now_ns: int) -> int | None:
        """Return the robot's clock; None before the first odometry."""
        return self._odometry.robot_ns(now_ns)


def _odometry_fault(event: ev.OdometryReceived) -> str | None:
    if event.problem is not None:
        return event.problem
    if 0 <= event.stamp_ns < _SIMULATED_NS < event.unix_ns:
        return "the robot's clock begins at 0, as in a simulation; turn use_sim_time off"
    if abs(event.stamp_ns - event.unix_ns) > _CLOCK_LIMIT_NS:
        side = "behind" if event.stamp_ns < event.unix_ns else "ahead of"
        return (
            f"the robot's clock is more than {CLOCK_LIMIT_S:g} s {side} this machine's; "
            "let both follow one time server (docs/do/sync.md)"
        )
    return None
