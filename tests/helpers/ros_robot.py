"""A robot of ROS 2 as a node of rclpy: odometry on an arc, a TF listener, the latched map, NavigateToPose.

Run by the Python of ROS: `python ros_robot.py BEGIN_S DRIVE_S [NAMESPACE [FAULT]]`. FAULT: amcl (it publishes
map → odom itself), nan, behind (its clock by 90 s), simulated (its clock begins at 0), patient (it drives on
without transforms). It writes a line of JSON for whatever it receives. tf2 is in no wheel: `map → odom` is
looked up as tf2 does, between two stamps and never beyond the last.
"""

import bisect
import contextlib
import itertools
import json
import math
import sys
import time
import types
from collections.abc import Generator

import rclpy
from geometry_msgs.msg import TransformStamped
from nav2_msgs.action import NavigateToPose
from nav2_msgs.msg import SpeedLimit
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from tf2_msgs.msg import TFMessage

LATCHED = QoSProfile(
    depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE
)
BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
TF_ERROR = 9002
TOO_FAR_M = 100.0  # a goal so far away is refused
STEP_S = 0.1  # timers and messages wake it earlier
LATE_NS = 300_000_000  # a drive needs map → odom of so long ago


def odometry_at(seconds: float) -> tuple[float, float, float]:
    """Where the robot is in odom after a time: a circle of 1 m radius at 0.15 m/s."""
    angle = 0.15 * seconds
    return math.sin(angle), 1 - math.cos(angle), angle


def say(**message: object) -> None:
    print(json.dumps(message), flush=True)


@types.coroutine
def let_others_run() -> Generator[None, None, None]:
    """Go on after the executor has handled what else is ready."""
    yield


class RosRobot(Node):
    def __init__(self, begin_s: float, drive_s: float, namespace: str, fault: str) -> None:
        super().__init__("robot", namespace=namespace)
        self.begin_s, self.drive_s, self.fault = begin_s, drive_s, fault
        self.stamps: list[int] = []  # ns
        self.transforms: list[tuple[float, float, float]] = []
        self.odometry = self.create_publisher(Odometry, "odom", BEST_EFFORT)
        self.tf = self.create_publisher(TFMessage, "tf", 10)
        self.heard = self.create_subscription(TFMessage, "tf", self.on_tf, 100)
        self.create_subscription(TFMessage, "tf_static", self.on_static, LATCHED)
        self.create_subscription(OccupancyGrid, "map", self.on_map, LATCHED)
        self.create_subscription(SpeedLimit, "speed_limit", lambda m: say(speed_limit=m.speed_limit), 10)
        self.create_timer(0.05, self.send_odometry)
        self.create_timer(0.1, self.look_up)
        self.server = ActionServer(
            self,
            NavigateToPose,
            "navigate_to_pose",
            execute_callback=self.drive,
            goal_callback=self.on_goal,
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
        )

    def send_odometry(self) -> None:
        now_ns = time.time_ns()
        x, y, yaw = odometry_at(now_ns / 1e9 - self.begin_s)
        if self.fault == "behind":
            now_ns -= 90 * 10**9
        elif self.fault == "simulated":
            now_ns -= round(self.begin_s * 1e9)
        elif self.fault == "nan":
            x = math.nan
        message = Odometry()
        message.header.frame_id, message.child_frame_id = "odom", "base_link"
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(now_ns, 10**9)
        message.pose.pose.position.x, message.pose.pose.position.y = x, y
        message.pose.pose.orientation.z, message.pose.pose.orientation.w = (
            math.sin(yaw / 2),
            math.cos(yaw / 2),
        )
        message.twist.twist.linear.x = 0.15
        self.odometry.publish(message)
        transform = TransformStamped()
        transform.header, transform.child_frame_id = message.header, "base_link"
        transform.transform.translation.x, transform.transform.translation.y = x, y
        transform.transform.rotation = message.pose.pose.orientation
        self.tf.publish(TFMessage(transforms=[transform]))
        if self.fault == "amcl":
            other = TransformStamped(child_frame_id="odom")
            other.header.stamp, other.header.frame_id = message.header.stamp, "map"
            self.tf.publish(TFMessage(transforms=[other]))

    def on_tf(self, message: TFMessage) -> None:
        """Take this message and all that wait: a busy machine else leaves rclpy, which takes one at a time,
        ever further behind."""
        waiting = (taken[0] for taken in iter(lambda: self.heard.handle.take_message(TFMessage, False), None))
        for one in itertools.chain(message.transforms, *(more.transforms for more in waiting)):
            if one.child_frame_id != "odom":
                continue
            t, q = one.transform.translation, one.transform.rotation
            stamp = one.header.stamp.sec * 10**9 + one.header.stamp.nanosec
            if self.stamps and stamp <= self.stamps[-1]:
                say(error=f"a stamp falls by {self.stamps[-1] - stamp} ns")
                continue
            self.stamps.append(stamp)
            self.transforms.append((t.x, t.y, 2 * math.atan2(q.z, q.w)))
            if one.header.frame_id != "map" or t.z or q.x or q.y:
                say(error="map → odom is not flat")

    def look_up(self) -> None:
        """Say where the robot is in the map now, or that tf2 would have to extrapolate."""
        now_ns = time.time_ns()
        now, place = now_ns / 1e9, self.map_odom(now_ns)
        if place is None:
            say(tf_missing=now)
            return
        (x, y, yaw), (ox, oy, oyaw) = place, odometry_at(now - self.begin_s)
        c, s = math.cos(yaw), math.sin(yaw)
        ahead = (self.stamps[-1] - now_ns) / 1e9
        say(tf=[now, x + c * ox - s * oy, y + s * ox + c * oy, yaw + oyaw], ahead=ahead)

    def map_odom(self, now_ns: int) -> tuple[float, float, float] | None:
        i = bisect.bisect_left(self.stamps, now_ns)
        if i == 0 or i == len(self.stamps):
            return None
        u = (now_ns - self.stamps[i - 1]) / (self.stamps[i] - self.stamps[i - 1])
        a, b = self.transforms[i - 1], self.transforms[i]
        turn = math.remainder(b[2] - a[2], 2 * math.pi)
        return a[0] + u * (b[0] - a[0]), a[1] + u * (b[1] - a[1]), a[2] + u * turn

    def on_static(self, message: TFMessage) -> None:
        say(static=[[one.header.frame_id, one.child_frame_id] for one in message.transforms])

    def on_map(self, message: OccupancyGrid) -> None:
        info = message.info
        say(
            map=[info.width, info.height, info.resolution, info.origin.position.x, info.origin.position.y],
            free=sum(cell == 0 for cell in message.data),
            occupied=sum(cell == 100 for cell in message.data),
        )

    def on_goal(self, goal: NavigateToPose.Goal) -> GoalResponse:
        position = goal.pose.pose.position
        say(goal=[position.x, position.y], frame=goal.pose.header.frame_id)
        return GoalResponse.REJECT if position.x > TOO_FAR_M else GoalResponse.ACCEPT

    async def drive(self, handle) -> NavigateToPose.Result:
        result, end = NavigateToPose.Result(), time.time() + self.drive_s
        while time.time() < end:
            if handle.is_cancel_requested:
                handle.canceled()
                say(ended="canceled")
                return result
            if self.fault != "patient" and self.map_odom(time.time_ns() - LATE_NS) is None:
                if hasattr(result, "error_code"):
                    result.error_code, result.error_msg = TF_ERROR, "no transform"
                handle.abort()
                say(ended="aborted")
                return result
            handle.publish_feedback(NavigateToPose.Feedback(distance_remaining=end - time.time()))
            next_s = time.time() + 0.05
            while time.time() < next_s:
                await let_others_run()
        handle.succeed()
        say(ended="succeeded")
        return result


if __name__ == "__main__":
    rclpy.init()
    namespace, fault = [*sys.argv[3:5], "", ""][:2]
    robot = RosRobot(float(sys.argv[1]), float(sys.argv[2]), namespace, fault)
    # Of several threads, rclpy hands out a task again and again until it runs: a core is busy, odometry late.
    executor = SingleThreadedExecutor()
    executor.add_node(robot)
    say(ready=True)
    with contextlib.suppress(KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        while rclpy.ok():
            executor.spin_once(STEP_S)
