"""A real robot of rclpy, a pose stream and a bridge between them, in one test process."""

from __future__ import annotations

import contextlib
import json
import math
import os
import queue
import socket
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from helpers.robot_drive import T_BASE_BODY, solid

from share.geometry.se3 import inverse
from share.net.udp import HostPort, StampedSocket
from share.robot import robot_events as ev
from share.robot.planar import PlanarPose
from share.robot.robot_file import RobotDescription
from share.robot.settings import RobotSettings
from share.runtime.pose import Pose
from share.runtime.pose_feed import PoseMessages
from share.runtime.robot_bridge import RobotBridgeRun
from share.runtime.robot_commands import CommandServer
from share.runtime.room_link import RoomLink
from share.types import TrackState

ROS = os.environ.get("SHARE_ROS")
HELPERS = Path(__file__).parent
AGE_S, POSE_HZ = 0.015, 30


def odometry_at(seconds: float) -> PlanarPose:
    angle = 0.15 * seconds
    return PlanarPose(math.sin(angle), 1 - math.cos(angle), angle)


def map_odom_at(seconds: float) -> PlanarPose:
    """What corrections make of the map: a step of 1.2 cm and 0.2° every 4 s, at 15 mm/s, beside a steady
    drift."""
    steps, into = divmod(seconds, 4.0)
    moved = 0.012 * (steps + min(1.0, into / 0.8))
    return PlanarPose(2.0 + moved, -1.0 + 0.002 * seconds, 0.4 + 0.3 * moved)


def built_messages(release: str) -> Path:
    """Build the messages of a release once; return their folder."""
    assert ROS is not None
    folder = Path(ROS) / "share-test-messages" / release
    if not (folder / "done").exists():
        command = [f"{ROS}/bin/python", str(HELPERS / "ros_messages.py"), str(folder), release]
        subprocess.run(command, check=True, capture_output=True)
        (folder / "done").touch()
    return folder


def ros_environment(folder: Path, domain: int) -> dict[str, str]:
    """The environment of a process of ROS."""
    return {
        **{key: value for key, value in os.environ.items() if not key.startswith("PYTHON")},
        "PYTHONPATH": str(folder / "site"),
        "LD_LIBRARY_PATH": str(folder / "lib"),
        "ROS_DOMAIN_ID": str(domain),
        "ROS_LOG_DIR": str(folder / "log"),
    }


def give_a_computer(process: subprocess.Popen[str]) -> None:
    """Let a program that runs on the robot not wait for others of this machine, where that is permitted:
    a robot has a computer of its own. The bridge gets no such thing."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(process.pid, os.SCHED_RR, os.sched_param(1))


class RosProcess:
    """The node in its own process, and what it says."""

    def __init__(
        self,
        folder: Path,
        domain: int,
        begin_s: float,
        drive_s: float,
        namespace: str = "",
        fault: str = "",
    ) -> None:
        environment = ros_environment(folder, domain)
        words = [str(begin_s), str(drive_s), namespace, fault]
        command = [f"{ROS}/bin/python", str(HELPERS / "ros_robot.py"), *words]
        self.process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        give_a_computer(self.process)
        self.lines: queue.Queue[dict] = queue.Queue()
        self.said: list[dict] = []
        self.thread = threading.Thread(target=self._read, daemon=True)
        self.thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.put(json.loads(line))

    def of(self, key: str) -> list[dict]:
        """What it said under a key."""
        while not self.lines.empty():
            self.said.append(self.lines.get())
        return [one for one in self.said if key in one]

    def forget(self) -> None:
        """Forget what it has said."""
        self.of("")
        self.said.clear()

    def end(self) -> None:
        self.process.kill()
        self.process.wait()
        self.thread.join()
        self.process.stdout.close()


def _by_dds(domain: int, namespace: str) -> object:
    from share.robot.ros_node import RosNode

    return RosNode(domain, namespace, [])


class RosRoom:
    """Agent, bridge and robot: `run` lets time pass."""

    def __init__(
        self,
        folder: Path,
        domain: int,
        tmp_path: Path,
        namespace: str = "",
        drive_s: float = 2.0,
        fault: str = "",
        robots: tuple[str, ...] | None = None,
        edge: str | None = None,
        connect: Callable[[Callable[[str], None]], object] | None = None,
    ) -> None:
        self.begin_s = time.time()
        names = (namespace,) if robots is None else robots  # namespaces in which there is a robot
        self.robots = [RosProcess(folder, domain, self.begin_s, drive_s, name, fault) for name in names]
        self.robot = self.robots[0] if self.robots else None
        self.poses = StampedSocket.bind(HostPort("127.0.0.1", 0))
        self.sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.commands = CommandServer(tmp_path / "robot.sock")
        self.printed: list[str] = []
        self.node = _by_dds(domain, namespace) if connect is None else connect(self.printed.append)
        self.link = None if edge is None else RoomLink(edge, "bot", drives_robot=True)
        self.reports: list[ev.GoalReport] = []
        self.commands.report = self.reports.append  # type: ignore[method-assign]
        self.restart_bridge()
        self.messages, self.state = PoseMessages("bot"), TrackState.OK
        self.next_s = time.time()

    def restart_bridge(self) -> None:
        """Begin a bridge at the present connection."""
        description = RobotDescription(RobotSettings(inverse(T_BASE_BODY), allow_goals=True))
        self.run_ = RobotBridgeRun(
            description, self.node, self.poses, self.commands, self.printed.append, self.link
        )

    def send_pose(self) -> None:
        stamp_s = time.time() - AGE_S
        if not self.state.has_pose:
            text = self.messages.of_state(round(stamp_s * 1e9), self.state, None)
        else:
            since = stamp_s - self.begin_s
            T = solid(map_odom_at(since) @ odometry_at(since)) @ T_BASE_BODY
            cov = np.eye(6) * 1e-4
            pose = Pose(
                round(stamp_s * 1e9), self.state, T, T, "ann-1/0", cov=cov, map_cov=cov, age_ms=AGE_S * 1e3
            )
            text = self.messages.of_pose(pose)
        self.sender.sendto(text.encode(), ("127.0.0.1", self.poses.port))

    def run(self, seconds: float, until: Callable[[], object] = lambda: False) -> bool:
        """Go on until something is so, at most for a time. Return whether it is."""
        end = time.time() + seconds
        while time.time() < end:
            if time.time() >= self.next_s:
                self.next_s = max(self.next_s + 1 / POSE_HZ, time.time())
                self.send_pose()
            self.run_.step(min(0.01, max(0.0, self.next_s - time.time())))
            if until():
                return True
        return bool(until())

    def goto(self, x: float = 1.0, y: float = 0.5) -> None:
        goal_id = self.run_._goal_id()
        self.run_._handle(ev.GotoRequested("ann", goal_id, x, y))

    def ended(self) -> bool:
        return bool(self.reports) and self.reports[-1].is_final

    def is_ready(self) -> bool:
        return self.run_.bridge.report(time.monotonic_ns())["refusal"] is None

    def close(self) -> None:
        for robot in self.robots:
            robot.end()
        if self.link is not None:
            self.link.close()
        self.node.close()
        self.commands.close()
        self.poses.close()
        self.sender.close()


def assert_goal_is_reached(here: RosRoom, release: str, within_s: float) -> None:
    """Send a robot of this release to a place; check what it says, and what reached it."""
    assert here.run_.bridge.report(time.monotonic_ns())["release"] == release
    here.goto(1.5, 0.5)
    assert here.run(within_s, here.ended), here.reports
    texts = [report.text for report in here.reports]
    assert texts[-1] == "reached" and any("to go" in text for text in texts), texts
    assert here.robot.of("goal") == [{"goal": [1.5, 0.5], "frame": "map"}]
    assert here.robot.of("speed_limit")[-1]["speed_limit"] == 0.2
