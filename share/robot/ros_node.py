"""A robot's topics by DDS: odometry and foreign transforms in; transforms, the map and goals out.

Only simple discovery: a robot that uses a discovery server is invisible. Names are those of ROS 2 on DDS:
`rt/` before a topic, `rq/` and `rr/` before a service's requests and replies.
"""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from share.errors import ShareError, UsageError, install_hint
from share.geometry.se3 import quat_from_matrix
from share.robot import robot_events as ev
from share.robot.grid import FloorMap
from share.robot.planar import PlanarPose, yaw_of_quaternion
from share.timing import PeriodicTimer
from share.types import F64

MAX_DOMAIN = 232
_TF_CHECK_S, _DISCOVERY_S = 0.2, 0.5
_DISCOVERY_NS = 3_000_000_000  # a cold discovery takes 1 to 2 s
_SETTLE_NS = 600_000_000  # after a match, before the first goal: the server has to match the client too
_FAST_DDS = b"\x01\x0f"  # vendor at the beginning of a participant's key
_HASH = re.compile(rb"typehash=(RIHS01_[0-9a-f]{64})")
# of NavigateToPose's result with an empty one (Humble), and with a code and a text; of its feedback in Jazzy
_EMPTY_RESULT = b"RIHS01_6acfb8cff093868001fe9b46e1262c481cd65cc06e93b655548ded7640b050b0"
_RESULT = b"RIHS01_c59f178c377de5318919c00bdbf7884cb3b185acfdffceba6c9f161e0aa3cc81"
_JAZZY_FEEDBACK = b"RIHS01_9d1f6fa2eb975ce733b419ac2e97b134d8ff92b6478b6559feed9a50bdfd82b3"
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


class RosNode:
    """Writers and readers of one robot. namespace: such as tb1; "" without. peers: hosts to ask besides
    multicast.

    Raises ShareError without cyclonedds or a network, UsageError for a name that cannot be one.
    """

    def __init__(self, domain: int, namespace: str = "", peers: Sequence[str] = ()) -> None:
        try:
            from share.robot import ros_types as types
            from share.robot.navigate import NavigateClient
            from share.robot.ros_topics import RosTopics, taken
        except ImportError:
            raise ShareError(install_hint("cyclonedds", "robot")) from None
        namespace = namespace.strip("/")
        if namespace and not _NAME.fullmatch(namespace):
            raise UsageError(f"--namespace {namespace!r}: use letters, digits and _, such as tb1")
        if not 0 <= domain <= MAX_DOMAIN:
            raise UsageError(f"--domain {domain}: give the robot's ROS_DOMAIN_ID, 0 to {MAX_DOMAIN}")
        self._types, self._taken = types, taken
        self.topics = topics = RosTopics(domain, namespace, _configuration(peers))
        self._tf = topics.writer("tf", types.TFMessage, depth=100)
        self._static = topics.writer("tf_static", types.TFMessage, latched=True)
        self._map = topics.writer("map", types.OccupancyGrid, latched=True)
        self._speed = topics.writer("speed_limit", types.SpeedLimit)
        self._odometry = topics.reader("odom", types.RosOdometry, reliable=False, depth=10)
        self._tf_reader = topics.reader("tf", types.TFMessage, depth=20, own=False)
        self._navigate = NavigateClient(topics)
        self._frame, self._base = "odom", "base_link"
        self._T_base_body: F64 | None = None
        self._tf_timer, self._discovery_timer = PeriodicTimer(_TF_CHECK_S), PeriodicTimer(_DISCOVERY_S)
        self._matched_ns: int | None = None
        self._began_ns: int | None = None

    # ------------------------------------------------------------ in

    def poll(self, now_ns: int) -> list[ev.RobotEvent]:
        """Return what has come; never waits."""
        events: list[ev.RobotEvent] = [
            self._odometry_event(one) for one in self._taken(self._odometry, self._types.RosOdometry)
        ]
        events += self._navigate.poll()
        if self._tf_timer.fire_if_due(now_ns):
            events += self._foreign_frames()
        if self._discovery_timer.fire_if_due(now_ns):
            found = self._discovered(now_ns)
            self._began_ns = self._began_ns or now_ns
            if found.servers or now_ns - self._began_ns > _DISCOVERY_NS:
                events.append(found)
        return events

    def _odometry_event(self, message: Any) -> ev.OdometryReceived:
        from share.robot.ros_types import stamp_ns

        self._take_frames(message.header.frame_id.strip("/"), message.child_frame_id.strip("/"))
        p, q, v = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist.linear
        pose = PlanarPose(p.x, p.y, yaw_of_quaternion(q.x, q.y, q.z, q.w))
        return ev.OdometryReceived(
            stamp_ns(message.header.stamp), time.time_ns(), pose, float(np.hypot(v.x, v.y))
        )

    def _take_frames(self, frame: str, base: str) -> None:
        """Take the names that the robot gives its frames."""
        frame, base = frame or self._frame, base or self._base
        if (frame, base) == (self._frame, self._base):
            return
        self._frame, self._base = frame, base
        if self._T_base_body is not None:
            self.publish_body(self._T_base_body)

    def _foreign_frames(self) -> list[ev.RobotEvent]:
        found = {
            one.header.frame_id.strip("/")
            for message in self._taken(self._tf_reader, self._types.TFMessage)
            for one in message.transforms
            if one.child_frame_id.strip("/") == self._frame
        }
        return [ev.ForeignMapFrame(parent) for parent in sorted(found)]

    def _discovered(self, now_ns: int) -> ev.RobotDiscovered:
        servers = self._navigate.servers()
        if not servers:
            self._matched_ns = None
        elif self._matched_ns is None and self._navigate.is_matched:
            self._matched_ns = now_ns
        is_settled = self._matched_ns is not None and now_ns - self._matched_ns >= _SETTLE_NS
        others = () if servers else tuple(self.topics.namespaces_with("navigate_to_pose/_action/status"))
        publishers = len(self._odometry.get_matched_publications())
        release = _release(*self._navigate.user_data()) if servers else ""
        self._navigate.has_error_code = release in ("jazzy", "newer")
        is_fast = all(server.participant_key.bytes[:2] == _FAST_DDS for server in servers)
        return ev.RobotDiscovered(
            len(servers) if is_settled else 0,
            publishers,
            others,
            release,
            is_fast,
            self.topics.has_participants(),
        )

    # ------------------------------------------------------------ out

    def publish_map_odom(self, stamp_ns: int, T_map_odom: PlanarPose) -> None:
        """Publish map → odom, as AMCL does."""
        half = T_map_odom.yaw / 2
        xyz, quat = (
            np.array([T_map_odom.x, T_map_odom.y, 0.0]),
            np.array([0.0, 0.0, np.sin(half), np.cos(half)]),
        )
        transform = self._types.ros_transform("map", self._frame, stamp_ns, xyz, quat)
        self._tf.write(self._types.TFMessage([transform]))

    def publish_body(self, T_base_body: F64) -> None:
        """Publish where the agent's body sits on the robot, for whoever draws it; latched."""
        self._T_base_body = T_base_body
        quat = quat_from_matrix(T_base_body[:3, :3])
        transform = self._types.ros_transform(
            self._base, "share_body", time.time_ns(), T_base_body[:3, 3], quat
        )
        self._static.write(self._types.TFMessage([transform]))

    def publish_grid(self, grid: FloorMap) -> None:
        """Publish the map for Nav2's static layer; latched."""
        types, stamp = self._types, self._types.ros_time(time.time_ns())
        origin = types.RosPose(
            types.RosPoint(grid.origin.x, grid.origin.y, 0.0), _yaw_quaternion(types, grid.origin.yaw)
        )
        height, width = grid.cells.shape
        info = types.MapMetaData(stamp, grid.resolution_m, width, height, origin)
        self._map.write(types.OccupancyGrid(types.RosHeader(stamp, "map"), info, grid.cells.ravel().tolist()))

    def limit_speed(self, speed_m_s: float) -> None:
        """Ask Nav2's controller to keep below a speed."""
        header = self._types.RosHeader(self._types.ros_time(time.time_ns()), "")
        self._speed.write(self._types.SpeedLimit(header, False, speed_m_s))

    def send_goal(self, goal: ev.SendGoal) -> None:
        self._navigate.send(goal)

    def cancel_goal(self, goal_id: bytes) -> None:
        self._navigate.cancel(goal_id)

    def ask_result(self, goal_id: bytes) -> None:
        self._navigate.ask_result(goal_id)

    def close(self) -> None:
        """Leave the domain."""
        self.topics.close()


def _yaw_quaternion(types: Any, yaw: float) -> Any:
    return types.RosQuaternion(0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))


def _release(result_data: bytes | None, feedback_data: bytes | None) -> str:
    """Return the ROS release by the user data of the publishers of results and feedback, which name their
    types (not in Humble); "" for types of no release, or before the publishers are found."""
    if result_data is None or feedback_data is None:
        return ""
    result, feedback = (_HASH.search(data) for data in (result_data, feedback_data))
    if result is None or result[1] == _EMPTY_RESULT:
        return "humble"
    if result[1] != _RESULT or feedback is None:
        return ""
    return "jazzy" if feedback[1] == _JAZZY_FEEDBACK else "newer"


def _configuration(peers: Sequence[str]) -> str:
    """Return Cyclone's configuration: hosts to ask besides multicast."""
    for peer in peers:
        if not re.fullmatch(r"[0-9A-Za-z._:-]+", peer):
            raise UsageError(f"--peer {peer!r}: give the robot's address, such as 192.168.1.20")
    listed = "".join(f"<Peer address={quoteattr(peer)}/>" for peer in peers)
    discovery = f"<Discovery><Peers>{listed}</Peers></Discovery>" if peers else ""
    return f"<CycloneDDS><Domain>{discovery}</Domain></CycloneDDS>"
