"""The robot's node with a goal under way, without ROS: prints UP while it runs, CANCEL where it cancels.

python node_without_ros.py FOLDER   (of share_robot_node.py)
"""

from __future__ import annotations

import importlib
import sys
import time
from types import ModuleType
from typing import Any
from unittest.mock import MagicMock

MODULES = {
    "rclpy": (),
    "rclpy.qos": ("DurabilityPolicy", "QoSProfile", "ReliabilityPolicy"),
    "rclpy.signals": ("SignalHandlerOptions",),
    "action_msgs.msg": ("GoalStatusArray",),
    "action_msgs.srv": ("CancelGoal",),
    "geometry_msgs.msg": ("TransformStamped",),
    "nav2_msgs.action": ("NavigateToPose",),
    "nav2_msgs.msg": ("SpeedLimit",),
    "nav_msgs.msg": ("OccupancyGrid", "Odometry"),
    "tf2_msgs.msg": ("TFMessage",),
}


def spin_once(_node: Any, timeout_sec: float) -> None:
    print("UP", flush=True)
    time.sleep(timeout_sec)


def main(folder: str) -> int:
    for name, contents in MODULES.items():
        for part in (name.partition(".")[0], name):
            sys.modules.setdefault(part, ModuleType(part))
        for one in contents:
            setattr(sys.modules[name], one, MagicMock())
    ros: Any = sys.modules["rclpy"]
    ros.create_node, ros.init, ros.spin_once = MagicMock(), MagicMock(), spin_once
    sys.path.insert(0, folder)
    node: Any = importlib.import_module("share_robot_node")
    node.RobotTopics.cancel = lambda topics, goal_id: print("CANCEL", flush=True)
    node.Freshness.is_silent = lambda fresh, now_ns: False  # the bridge answers: it cancels only at its end
    begin = node.RobotTopics.__init__

    def begin_with_a_goal(topics: Any, namespace: str) -> None:
        begin(topics, namespace)
        topics.under_way = ["53" * 16]

    node.RobotTopics.__init__ = begin_with_a_goal
    sys.argv = ["node", "tcp://127.0.0.1:1"]
    return int(node.main())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
