"""ROS 2 messages as DDS types for cyclonedds, in the field order of ROS's own definitions.

Sources: the packages builtin_interfaces, std_msgs, geometry_msgs, nav_msgs, tf2_msgs, action_msgs,
unique_identifier_msgs, nav2_msgs. Quaternions are x y z w. A message that has more fields than its type here,
of a newer release, is read up to there.

Annotations are evaluated here (no `from __future__`): cyclonedds does not find a generic type by its text.
"""

from dataclasses import dataclass, field

import numpy as np
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float32, float64, int8, int16, int32, sequence, uint8, uint16, uint32


@dataclass
class RosTime(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
class RosDuration(IdlStruct, typename="builtin_interfaces::msg::dds_::Duration_"):
    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
class RosHeader(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: RosTime = field(default_factory=RosTime)
    frame_id: str = ""


@dataclass
class RosVector(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class RosPoint(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class RosQuaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@dataclass
class RosTransform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    translation: RosVector = field(default_factory=RosVector)
    rotation: RosQuaternion = field(default_factory=RosQuaternion)


@dataclass
class RosTransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    header: RosHeader = field(default_factory=RosHeader)
    child_frame_id: str = ""
    transform: RosTransform = field(default_factory=RosTransform)


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    transforms: sequence[RosTransformStamped] = field(default_factory=list)


@dataclass
class RosPose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    position: RosPoint = field(default_factory=RosPoint)
    orientation: RosQuaternion = field(default_factory=RosQuaternion)


@dataclass
class RosPoseStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    header: RosHeader = field(default_factory=RosHeader)
    pose: RosPose = field(default_factory=RosPose)


@dataclass
class RosPoseWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovariance_"):
    pose: RosPose
    covariance: array[float64, 36]


@dataclass
class RosTwist(IdlStruct, typename="geometry_msgs::msg::dds_::Twist_"):
    linear: RosVector
    angular: RosVector


@dataclass
class RosTwistWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::TwistWithCovariance_"):
    twist: RosTwist
    covariance: array[float64, 36]


@dataclass
class RosOdometry(IdlStruct, typename="nav_msgs::msg::dds_::Odometry_"):
    header: RosHeader
    child_frame_id: str
    pose: RosPoseWithCovariance
    twist: RosTwistWithCovariance


@dataclass
class MapMetaData(IdlStruct, typename="nav_msgs::msg::dds_::MapMetaData_"):
    map_load_time: RosTime
    resolution: float32
    width: uint32
    height: uint32
    origin: RosPose


@dataclass
class OccupancyGrid(IdlStruct, typename="nav_msgs::msg::dds_::OccupancyGrid_"):
    header: RosHeader
    info: MapMetaData
    data: sequence[int8]


@dataclass
class SpeedLimit(IdlStruct, typename="nav2_msgs::msg::dds_::SpeedLimit_"):
    header: RosHeader
    percentage: bool
    speed_limit: float64


@dataclass
class RosUUID(IdlStruct, typename="unique_identifier_msgs::msg::dds_::UUID_"):
    uuid: array[uint8, 16]


@dataclass
class GoalInfo(IdlStruct, typename="action_msgs::msg::dds_::GoalInfo_"):
    goal_id: RosUUID
    stamp: RosTime


@dataclass
class RosGoalStatus(IdlStruct, typename="action_msgs::msg::dds_::GoalStatus_"):
    goal_info: GoalInfo
    status: int8


@dataclass
class GoalStatusArray(IdlStruct, typename="action_msgs::msg::dds_::GoalStatusArray_"):
    status_list: sequence[RosGoalStatus]


_ACTION = "nav2_msgs::action::dds_::NavigateToPose"


@dataclass
class NavigateGoal(IdlStruct, typename=f"{_ACTION}_Goal_"):
    pose: RosPoseStamped
    behavior_tree: str


@dataclass
class SendGoalRequest(IdlStruct, typename=f"{_ACTION}_SendGoal_Request_"):
    goal_id: RosUUID
    goal: NavigateGoal


@dataclass
class SendGoalResponse(IdlStruct, typename=f"{_ACTION}_SendGoal_Response_"):
    accepted: bool
    stamp: RosTime


@dataclass
class GetResultRequest(IdlStruct, typename=f"{_ACTION}_GetResult_Request_"):
    goal_id: RosUUID


@dataclass
class NavigateResult(IdlStruct, typename=f"{_ACTION}_Result_"):
    """Of Jazzy and newer; Humble's is empty."""

    error_code: uint16
    error_msg: str


@dataclass
class GetResultResponse(IdlStruct, typename=f"{_ACTION}_GetResult_Response_"):
    status: int8
    result: NavigateResult


@dataclass
class NavigateFeedback(IdlStruct, typename=f"{_ACTION}_Feedback_"):
    current_pose: RosPoseStamped
    navigation_time: RosDuration
    estimated_time_remaining: RosDuration
    number_of_recoveries: int16
    distance_remaining: float32


@dataclass
class NavigateFeedbackMessage(IdlStruct, typename=f"{_ACTION}_FeedbackMessage_"):
    goal_id: RosUUID
    feedback: NavigateFeedback


@dataclass
class CancelGoalRequest(IdlStruct, typename="action_msgs::srv::dds_::CancelGoal_Request_"):
    goal_info: GoalInfo


def ros_time(stamp_ns: int) -> RosTime:
    """Return a stamp in ROS's form."""
    return RosTime(*divmod(stamp_ns, 1_000_000_000))


def stamp_ns(time: RosTime) -> int:
    """Return a stamp of ROS, ns."""
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)


def ros_transform(
    parent: str, child: str, stamp: int, xyz: np.ndarray, quat: np.ndarray
) -> RosTransformStamped:
    """Return a transform at a stamp, ns, from a translation (3,), m, and a quaternion (4,)."""
    transform = RosTransform(RosVector(*map(float, xyz)), RosQuaternion(*map(float, quat)))
    return RosTransformStamped(RosHeader(ros_time(stamp), parent), child, transform)
