"""SHARE's node on a ROS 2 robot: carries messages between `share robot bridge --node` and the robot's topics.

One file for the robot's own Python, with rclpy and pyzmq and without SHARE (docs/do/robot.md):

    python3 share_robot_node.py tcp://MINIPC:5580 --secret robot.secret --server-key bot.public

The bridge decides. The node connects to it, obeys nobody but the holder of that key (CURVE, RFC 26), and
opens no port. By itself it does one thing: while the bridge is silent it cancels what SHARE has sent the
robot to, and `map → odom` ends.

Messages are JSON, one a frame; units m, rad, ns; stamps are the robot's. Python 3.10 and later.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import ipaddress
import json
import math
import os
import re
import secrets
import signal
import sys
import threading
import time
import zlib
from collections import deque
from typing import Any

try:
    import rclpy
    import zmq
    from action_msgs.msg import GoalStatusArray
    from action_msgs.srv import CancelGoal
    from geometry_msgs.msg import TransformStamped
    from nav2_msgs.action import NavigateToPose
    from nav2_msgs.msg import SpeedLimit
    from nav_msgs.msg import OccupancyGrid, Odometry
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
    from rclpy.signals import SignalHandlerOptions
    from tf2_msgs.msg import TFMessage
except ImportError as error:  # SHARE imports Freshness from here
    MISSING: str | None = error.name
else:
    MISSING = None

VERSION = 1  # of the messages
FRESH_NS = 500_000_000
SILENT_NS = 1_000_000_000  # a bridge, or a node, of which nothing fresh came for so long is gone
HEARTBEAT_NS = 100_000_000
GOAL_PREFIX = b"SHARE\x00\x00\x01"  # of the ids of all goals of SHARE
ACCEPTED, EXECUTING, CANCELING = 1, 2, 3  # action_msgs/GoalStatus
_POLL_MS = 5
_REPEAT_NS = 500_000_000
_COMPLAIN_NS = 10_000_000_000
_LOOK_S = 0.5
_MAX_STAMPS = 500
_ACTION = "navigate_to_pose/_action"
MAX_CELLS = 4_000_000  # of a map, as at the bridge


class Freshness:
    """One end of a link whose messages are late or lost, without a common clock.

    Each message has its sender's time (`at`) and the newest time of the receiver that the sender had then
    (`seen`): what comes longer than FRESH_NS after that, or was meant for another run of the receiver, is not
    fresh. base_ns: random, so that times of two runs differ. heard_ns: when the last fresh message came.
    """

    def __init__(self, base_ns: int) -> None:
        self._base_ns = base_ns
        self._other: int | None = None
        self.heard_ns: int | None = None

    def stamped(self, message: dict[str, Any], now_ns: int) -> bytes:
        """Return a message to send."""
        return json.dumps({**message, "at": self._base_ns + now_ns, "seen": self._other}).encode()

    def take(self, message: dict[str, Any], now_ns: int) -> bool:
        """Return whether a message is fresh. Raises LookupError, TypeError, ValueError for one of no node."""
        at, seen = message["at"], message["seen"]
        if not isinstance(at, int) or not isinstance(seen, (int, type(None))):
            raise TypeError("at or seen is no time")
        self._other = at
        is_fresh = seen is not None and 0 <= self._base_ns + now_ns - seen <= FRESH_NS
        if is_fresh:
            self.heard_ns = now_ns
        return is_fresh

    def is_silent(self, now_ns: int) -> bool:
        return self.heard_ns is None or now_ns - self.heard_ns > SILENT_NS


class RobotTopics:
    """The robot's topics and NavigateToPose. `outgoing`: messages for the bridge."""

    def __init__(self, namespace: str) -> None:
        self.node = node = rclpy.create_node("share", namespace=namespace)
        self.outgoing: deque[dict[str, Any]] = deque(maxlen=200)
        self.under_way: list[str] = []  # ids of SHARE's goals on the robot
        self._frame, self._base, self._has = "odom", "base_link", ""
        self._stamps: dict[int, None] = {}  # of this node's newest map → odom
        self._goals: list[list[Any]] = []
        self._was_ready = False
        latched = QoSProfile(
            depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE
        )
        best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._tf = node.create_publisher(TFMessage, "tf", 100)
        self._static = node.create_publisher(TFMessage, "tf_static", latched)
        self._map = node.create_publisher(OccupancyGrid, "map", latched)
        self._speed = node.create_publisher(SpeedLimit, "speed_limit", 1)
        service, action = node.create_client, NavigateToPose.Impl
        self._goal = service(action.SendGoalService, f"{_ACTION}/send_goal")
        self._result = service(action.GetResultService, f"{_ACTION}/get_result")
        self._cancel = service(CancelGoal, f"{_ACTION}/cancel_goal")
        node.create_subscription(Odometry, "odom", self._on_odometry, best_effort)
        node.create_subscription(TFMessage, "tf", self._on_tf, 100)
        node.create_subscription(GoalStatusArray, f"{_ACTION}/status", self._on_status, latched)
        node.create_subscription(action.FeedbackMessage, f"{_ACTION}/feedback", self._on_feedback, 10)
        node.create_timer(_LOOK_S, self._look_around)

    # ------------------------------------------------------------ to the bridge

    def _on_odometry(self, message: Any) -> None:
        self._frame = message.header.frame_id.strip("/") or self._frame
        self._base = message.child_frame_id.strip("/") or self._base
        p, q, v = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist.linear
        yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)
        values = [one if math.isfinite(one) else None for one in (p.x, p.y, yaw, math.hypot(v.x, v.y))]
        self.outgoing.append({"odometry": [_stamp_ns(message.header.stamp), *values]})

    def _on_tf(self, message: Any) -> None:
        for one in message.transforms:
            is_odom = one.child_frame_id.strip("/") == self._frame
            if is_odom and _stamp_ns(one.header.stamp) not in self._stamps:
                self.outgoing.append({"foreign": one.header.frame_id.strip("/")})

    def _on_status(self, message: Any) -> None:
        goals = [(bytes(one.goal_info.goal_id.uuid), one.status) for one in message.status_list]
        self.under_way = [
            goal.hex()
            for goal, status in goals
            if goal.startswith(GOAL_PREFIX) and status in (ACCEPTED, EXECUTING, CANCELING)
        ]
        self._goals = [[goal.hex(), status] for goal, status in goals]
        self.outgoing.append({"status": self._goals})

    def _on_feedback(self, message: Any) -> None:
        distance_m = message.feedback.distance_remaining
        if math.isfinite(distance_m):
            self.outgoing.append({"feedback": [bytes(message.goal_id.uuid).hex(), distance_m]})

    def _look_around(self) -> None:
        """Tell what there is on the domain; and the status again, which a new bridge has not seen."""
        node, topic = self.node, f"{_ACTION}/status"
        servers = node.count_publishers(topic)
        is_ready = servers > 0 and self._goal.service_is_ready() and self._cancel.service_is_ready()
        names = [name for name, _ in node.get_topic_names_and_types() if name.endswith(f"/{topic}")]
        found = {
            "servers": servers if is_ready and self._was_ready else 0,
            "odometry": node.count_publishers("odom"),
            "others": [] if servers else [name.removesuffix(topic).strip("/") or "/" for name in names],
            "release": _release(),
            "participants": len(node.get_node_names()) > 1,
            "has": self._has,
        }
        self.outgoing.append({"found": found})
        if found["servers"]:
            self.outgoing.append({"status": self._goals})
        self._was_ready = is_ready

    # ------------------------------------------------------------ from the bridge

    def carry_out(self, message: dict[str, Any]) -> None:
        """Do what the bridge says."""
        if "tf" in message:
            stamp, x, y, yaw = message["tf"]
            self._stamps[stamp] = None
            if len(self._stamps) > _MAX_STAMPS:
                del self._stamps[next(iter(self._stamps))]
            self._tf.publish(_transform("map", self._frame, stamp, [x, y, 0.0], _heading(yaw)))
        if "goal" in message:
            self._send_goal(*message["goal"])
        if "cancel" in message:
            self.cancel(message["cancel"])
        if "ask" in message:
            self._ask_result(message["ask"])
        if "speed" in message:
            self._speed.publish(SpeedLimit(percentage=False, speed_limit=float(message["speed"])))
        if "fixed" in message:
            self._publish_fixed(message["fixed"])

    def _send_goal(self, goal_id: str, stamp: int, x: float, y: float, yaw: float) -> None:
        request = NavigateToPose.Impl.SendGoalService.Request()
        request.goal_id.uuid, request.goal.pose.header.frame_id = _uuid(goal_id), "map"
        _set_stamp(request.goal.pose.header, stamp)
        _set_pose(request.goal.pose.pose, x, y, yaw)

        def answer(future: Any) -> None:
            self.outgoing.append({"accepted": bool(future.result().accepted)})

        self._goal.call_async(request).add_done_callback(answer)

    def cancel(self, goal_id: str) -> None:
        """Ask the robot to give up this goal, and no other."""
        request = CancelGoal.Request()
        request.goal_info.goal_id.uuid = _uuid(goal_id)
        self._cancel.call_async(request)

    def _ask_result(self, goal_id: str) -> None:
        request = NavigateToPose.Impl.GetResultService.Request()
        request.goal_id.uuid = _uuid(goal_id)

        def answer(future: Any) -> None:
            result = future.result().result
            if hasattr(result, "error_code"):  # Humble's has none
                self.outgoing.append({"result": [result.error_code, getattr(result, "error_msg", "")]})

        self._result.call_async(request).add_done_callback(answer)

    def _publish_fixed(self, fixed: dict[str, Any]) -> None:
        """Publish the map and the place of the agent's body."""
        height, width = fixed["size"]
        if not (height > 0 and width > 0 and height * width <= MAX_CELLS):
            raise ValueError(f"a map of {height} by {width} cells")
        cells = zlib.decompressobj().decompress(base64.b64decode(fixed["cells"]), width * height)
        grid, now_ns = OccupancyGrid(), time.time_ns()
        grid.header.frame_id, grid.info.resolution = "map", fixed["resolution"]
        _set_stamp(grid.header, now_ns)
        grid.info.width, grid.info.height = width, height
        _set_pose(grid.info.origin, *fixed["origin"])
        grid.data.frombytes(cells)
        self._map.publish(grid)
        body = fixed["body"]
        self._static.publish(_transform(self._base, "share_body", now_ns, body[:3], body[3:]))
        self._has = fixed["name"]


class BridgeLink(threading.Thread):
    """The link to the bridge, in a thread of its own, which alone uses its socket."""

    def __init__(self, topics: RobotTopics, address: str, keys: tuple[bytes, bytes] | None) -> None:
        super().__init__(daemon=True)
        self._topics, self._address, self.is_ended = topics, address, False
        self._fresh = Freshness(secrets.randbits(61))
        self._socket = zmq.Context().socket(zmq.DEALER)
        for option, value in {
            zmq.LINGER: 0,
            zmq.SNDHWM: 50,
            zmq.IMMEDIATE: 1,  # nothing waits for a bridge that is not there
            zmq.MAXMSGSIZE: 1 << 24,
            zmq.HEARTBEAT_IVL: 500,
            zmq.HEARTBEAT_TIMEOUT: 2000,
            zmq.RECONNECT_IVL_MAX: 1000,
        }.items():
            self._socket.setsockopt(option, value)
        if keys is not None:
            secret, server = keys
            self._socket.curve_secretkey, self._socket.curve_serverkey = secret, server
            self._socket.curve_publickey = zmq.curve_public(secret)
        self._socket.connect(address)

    def run(self) -> None:
        log = self._topics.node.get_logger()
        sent_ns = cancelled_ns = 0
        said_ns = time.monotonic_ns() - _COMPLAIN_NS + 3 * SILENT_NS
        was_silent = True
        while not self.is_ended:
            if self._socket.poll(_POLL_MS):
                self._receive(log)
            now_ns = time.monotonic_ns()
            is_silent = self._fresh.is_silent(now_ns)
            if was_silent and not is_silent:
                log.info(f"the bridge at {self._address} answers")
            if is_silent and (not was_silent or now_ns - said_ns > _COMPLAIN_NS):
                said_ns = now_ns
                log.warning(
                    f"no bridge answers at {self._address}: is it running, do both have the other's key?"
                )
            was_silent = is_silent
            if is_silent and self._topics.under_way and now_ns - cancelled_ns > _REPEAT_NS:
                cancelled_ns = now_ns
                log.warning("the bridge is silent: the robot's goal is cancelled")
                self.cancel_all()
            while self._topics.outgoing:
                self._send(self._topics.outgoing.popleft())
                sent_ns = now_ns
            if now_ns - sent_ns > HEARTBEAT_NS:
                self._send({})
                sent_ns = now_ns

    def cancel_all(self) -> None:
        for goal_id in self._topics.under_way:
            self._topics.cancel(goal_id)

    def _send(self, message: dict[str, Any]) -> None:
        with contextlib.suppress(zmq.Again):
            data = self._fresh.stamped({"version": VERSION, **message}, time.monotonic_ns())
            self._socket.send(data, zmq.NOBLOCK)

    def _receive(self, log: Any) -> None:
        try:
            message = json.loads(self._socket.recv(zmq.NOBLOCK))
            if message["version"] != VERSION:
                raise ValueError("the bridge is of another release: give the robot the node of that one")
            if self._fresh.take(message, time.monotonic_ns()):
                self._topics.carry_out(message)
        except Exception as error:  # the link lives on: it cancels while the bridge is silent
            text = f"{type(error).__name__}: {error}"[:200]
            log.error(f"what the bridge sends is not understood: {text}", throttle_duration_sec=10.0)


def _release() -> str:
    if not hasattr(NavigateToPose.Result(), "error_code"):
        return "humble"
    return "newer" if hasattr(NavigateToPose.Feedback(), "heading_tracking_error") else "jazzy"


def _stamp_ns(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _set_stamp(header: Any, stamp_ns: int) -> None:
    header.stamp.sec, header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)


def _uuid(goal_id: str) -> Any:
    return list(bytes.fromhex(goal_id))


def _heading(yaw: float) -> list[float]:
    return [0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]


def _set_pose(pose: Any, x: float, y: float, yaw: float) -> None:
    pose.position.x, pose.position.y = float(x), float(y)
    *_, pose.orientation.z, pose.orientation.w = _heading(yaw)


def _transform(parent: str, child: str, stamp_ns: int, xyz: list[float], quat: list[float]) -> Any:
    one = TransformStamped(child_frame_id=child)
    one.header.frame_id = parent
    _set_stamp(one.header, stamp_ns)
    t, q = one.transform.translation, one.transform.rotation
    (t.x, t.y, t.z), (q.x, q.y, q.z, q.w) = map(float, xyz), map(float, quat)
    return TFMessage(transforms=[one])


def _key(text: str, kind: str) -> bytes:
    """Return the key in a file of `share keys generate`, or a public key itself. Raises ValueError."""
    if kind == "public" and re.fullmatch(r"\S{40}", text):
        return text.encode()
    with open(text) as file:
        if kind == "secret" and os.fstat(file.fileno()).st_mode & 0o077:
            raise ValueError(f"{text}: others can read this secret; chmod 600 {text}")
        words = file.read(500).split()
    if len(words) < 3 or words[0] != f"share-{kind}-key" or len(words[2]) != 40:
        raise ValueError(f"{text}: is no {kind} key of `share keys generate`")
    return words[2].encode()


def _is_local(address: str) -> bool:
    host = address.removeprefix("tcp://").rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("bridge", help="where the bridge listens: tcp://HOST:PORT")
    parser.add_argument("--namespace", default="", help="the robot's namespace, such as tb1")
    parser.add_argument("--secret", help="file NAME.secret of the robot's own key")
    parser.add_argument("--server-key", help="public key of the bridge, or its file")
    options = parser.parse_args()
    if MISSING is not None:
        parser.error(f"{MISSING} is missing: source /opt/ros/DISTRO/setup.bash; apt install python3-zmq")
    if not re.fullmatch(r"tcp://\S+:\d+", options.bridge):
        parser.error(f"{options.bridge}: expected tcp://HOST:PORT")
    if (options.secret is None) != (options.server_key is None):
        parser.error("give both --secret and --server-key")
    if options.secret is None and not _is_local(options.bridge):
        parser.error("without keys only a bridge on this machine: give --secret and --server-key")
    try:
        keys = options.secret and (_key(options.secret, "secret"), _key(options.server_key, "public"))
    except (OSError, ValueError) as error:
        parser.error(str(error))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    topics = RobotTopics(options.namespace)
    link = BridgeLink(topics, options.bridge, keys or None)
    link.start()
    stops: list[int] = []  # noted, not raised: a second one must not break off the robot's stop
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda one, _frame: stops.append(one))
    try:
        while link.is_alive() and not stops:
            rclpy.spin_once(topics.node, timeout_sec=0.1)
    finally:  # however it ends, the robot stops
        link.is_ended = True
        link.join()
        link.cancel_all()
        rclpy.spin_once(topics.node, timeout_sec=0.2)
    return 0 if stops else 1


if __name__ == "__main__":
    sys.exit(main())
