"""Events and effects of the robot bridge's state machine.

Its time is the host's monotonic clock, ns. A stamp is in the robot's clock, that of its odometry.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

from share.protocol.common_events import PrintLine, Tick
from share.robot.planar import PlanarPose
from share.types import F64, TrackState

MAX_ODOMETRY_M = 100_000.0  # from where the odometry began, along each axis
MAX_ODOMETRY_RAD = 1e6  # of a yaw that is not wrapped
MAX_STAMP_NS = 2**62

# ---------------------------------------------------------------- events


@dataclass(frozen=True, eq=False)
class AgentPoseReceived:
    """A message of the agent's pose stream.

    T_map_body (4, 4), map_id: None without a pose in the map. sigma_m: standard deviation of the position
    on the floor; None if the agent does not know it. age_ns: of the frame; None if the agent does not say.
    has_edge: whether the agent receives its edge's messages; None if not stated. T_odom_body (4, 4): by the
    agent's own odometry, z up.
    """

    agent: str
    sequence: int
    state: TrackState
    T_map_body: F64 | None
    map_id: str | None
    sigma_m: float | None
    age_ns: int | None
    has_edge: bool | None = None
    T_odom_body: F64 | None = None


@dataclass(frozen=True)
class OdometryReceived:
    """The robot's odometry, as it came: use it only where `problem` is None. unix_ns: when it arrived.
    speed_m_s: as the robot reports it."""

    stamp_ns: int
    unix_ns: int
    T_odom_base: PlanarPose
    speed_m_s: float

    @property
    def problem(self) -> str | None:
        """Why no robot can mean this, for a person; None for a usable sample."""
        T = self.T_odom_base
        if not T.is_finite or not math.isfinite(self.speed_m_s):
            return "the robot's odometry has values that are not finite; restart its base"
        if max(abs(T.x), abs(T.y)) > MAX_ODOMETRY_M or abs(self.speed_m_s) > MAX_ODOMETRY_M:
            return f"the robot's odometry is more than {MAX_ODOMETRY_M / 1000:g} km off; restart its base"
        if abs(T.yaw) > MAX_ODOMETRY_RAD:
            return f"the robot's odometry has a yaw of more than {MAX_ODOMETRY_RAD:g} rad; restart its base"
        if not 0 <= self.stamp_ns < MAX_STAMP_NS:
            return "the robot's odometry has a time of no clock; restart its base"
        return None


@dataclass(frozen=True)
class ForeignMapFrame:
    """Another program publishes `frame` → odom."""

    frame: str


@dataclass(frozen=True)
class RobotDiscovered:
    """Counts on the DDS domain: navigation servers and publishers of odometry in the robot's
    namespace; others: other namespaces with a server. release: humble, jazzy, newer; "" unknown. is_fast_dds:
    whether the servers use Fast DDS. has_participants: whether there is anybody on the domain."""

    servers: int
    odometry_publishers: int
    others: tuple[str, ...] = ()
    release: str = ""
    is_fast_dds: bool = True
    has_participants: bool = True


@dataclass(frozen=True)
class GotoRequested:
    """A commander wants the robot at x, y (m, in the map). yaw: rad; None: as it arrives. map_id: in which
    map the goal is meant; None: in the present one. goal_id (16 bytes): its name on the robot, used once."""

    commander: str
    goal_id: bytes
    x: float
    y: float
    yaw: float | None = None
    map_id: str | None = None


@dataclass(frozen=True)
class CancelRequested:
    """Any commander wants the robot to stop. cancel_id (16 bytes): a final `GoalReport` on it follows;
    empty: nobody waits for one."""

    commander: str
    cancel_id: bytes = b""


@dataclass(frozen=True)
class CommanderLost:
    """The link to a commander is gone."""

    commander: str


class GoalStatus(StrEnum):
    """State of a goal on the robot (action_msgs/GoalStatus)."""

    UNKNOWN = "unknown"
    ACCEPTED = "accepted"
    EXECUTING = "executing"
    CANCELING = "canceling"
    SUCCEEDED = "succeeded"
    CANCELED = "canceled"
    ABORTED = "aborted"

    @property
    def is_final(self) -> bool:
        return self in (GoalStatus.SUCCEEDED, GoalStatus.CANCELED, GoalStatus.ABORTED)

    @classmethod
    def of_ros(cls, number: int) -> GoalStatus:
        """Return the state that ROS's number stands for."""
        known = list(cls)
        return known[number] if 0 <= number < len(known) else cls.UNKNOWN


@dataclass(frozen=True)
class StatusReceived:
    """The robot's list of its goals: (goal id, status) of each."""

    goals: tuple[tuple[bytes, GoalStatus], ...]


@dataclass(frozen=True)
class FeedbackReceived:
    """Nav2's feedback: distance remaining, m."""

    goal_id: bytes
    distance_m: float


@dataclass(frozen=True)
class GoalAnswered:
    """A reply to a goal; which goal it answers is not known."""

    is_accepted: bool


@dataclass(frozen=True)
class ResultReceived:
    """Why a goal failed, as the robot says: a code of Nav2, and its text ("" without one)."""

    code: int
    text: str = ""


RobotEvent = (
    AgentPoseReceived
    | OdometryReceived
    | ForeignMapFrame
    | RobotDiscovered
    | GotoRequested
    | CancelRequested
    | CommanderLost
    | StatusReceived
    | FeedbackReceived
    | GoalAnswered
    | ResultReceived
    | Tick
)

# ---------------------------------------------------------------- effects


@dataclass(frozen=True)
class PublishMapOdom:
    """Publish `map → odom`, valid from the last one until stamp_ns."""

    stamp_ns: int
    T_map_odom: PlanarPose


@dataclass(frozen=True)
class SendGoal:
    """Send a goal to the robot's navigation."""

    goal_id: bytes
    stamp_ns: int
    T_map_base: PlanarPose


@dataclass(frozen=True)
class CancelGoal:
    """Ask the robot to give a goal up."""

    goal_id: bytes


@dataclass(frozen=True)
class AskResult:
    """Ask the robot why a goal failed."""

    goal_id: bytes


@dataclass(frozen=True)
class LimitSpeed:
    """Ask the robot's controller to drive no faster."""

    speed_m_s: float


@dataclass(frozen=True)
class GoalReport:
    """A report to a commander on `goal_id`, or on the cancellation of that id. is_final: nothing follows.
    is_reached: the goal ended there; of a cancellation: no goal is under way any more."""

    commander: str
    text: str
    is_final: bool = False
    is_reached: bool = False
    goal_id: bytes = b""


RobotEffect = PublishMapOdom | SendGoal | CancelGoal | AskResult | LimitSpeed | GoalReport | PrintLine
