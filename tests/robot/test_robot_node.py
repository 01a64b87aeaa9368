"""The node on the robot and the bridge's link to it: freshness, keys; with a robot of rclpy, goals."""

from __future__ import annotations

import base64
import contextlib
import importlib.util
import json
import os
import secrets
import signal
import subprocess
import sys
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import zmq
from click.testing import CliRunner
from helpers.raw_zmtp import RawPeer, message, parts
from helpers.ros_bench import (
    ROS,
    RosRoom,
    assert_goal_is_reached,
    built_messages,
    give_a_computer,
    map_odom_at,
    odometry_at,
    ros_environment,
)

from share.cli.main import cli
from share.errors import TransportError, UsageError
from share.net.keys import generate_pair
from share.net.tcp import resident_bytes
from share.robot import robot_events as ev
from share.robot import share_robot_node as robot_node
from share.robot.node_link import NodeKeys, NodeLink, node_events
from share.robot.planar import PlanarPose
from share.robot.share_robot_node import FRESH_NS, SILENT_NS, VERSION, Freshness
from share.types import TrackState

MS = 1_000_000
LOCAL = "tcp://127.0.0.1:0"
GOAL = robot_node.GOAL_PREFIX + b"12345678"


# ------------------------------------------------------------ freshness


def sent(sender: Freshness, now_ns: int) -> dict:
    return json.loads(sender.stamped({}, now_ns))


def test_both_sides_are_fresh_after_each_has_heard_the_other() -> None:
    node, bridge = Freshness(10**15), Freshness(5)
    assert not bridge.take(sent(node, 100), 7)  # the first says nothing of the bridge's time
    assert node.take(sent(bridge, 8), 101) and bridge.take(sent(node, 102), 9)
    assert not node.is_silent(101 + SILENT_NS) and node.is_silent(102 + SILENT_NS)


def test_what_waited_in_a_queue_is_not_fresh_and_what_follows_is() -> None:
    node, bridge = Freshness(10**15), Freshness(5)
    bridge.take(sent(node, 0), 0)
    old = sent(bridge, 0)
    assert node.take(old, FRESH_NS) and not node.take(old, FRESH_NS + 1)
    bridge.take(sent(node, 2 * FRESH_NS), 2 * FRESH_NS)
    assert node.take(sent(bridge, 2 * FRESH_NS), 2 * FRESH_NS + 1)


def test_another_run_is_not_fresh() -> None:
    node, bridge = Freshness(10**15), Freshness(5)
    bridge.take(sent(node, 0), 0)
    message = sent(bridge, 1)
    assert Freshness(10**15).take(message, 2) and not Freshness(2 * 10**15).take(message, 2)
    with pytest.raises(TypeError):
        node.take({"at": "now", "seen": None}, 0)


# ------------------------------------------------------------ the bridge's end


def keys_at(folder: Path) -> NodeKeys:
    return NodeKeys(generate_pair(folder / "bridge", "bot"), generate_pair(folder / "robot", "robot").public)


class FakeNode:
    """The node's end of the link, in this process."""

    def __init__(self, link: NodeLink, secret: str | None = None, server: str | None = None) -> None:
        self.link, self.fresh, self.received = link, Freshness(secrets.randbits(61)), []
        self.socket = zmq.Context.instance().socket(zmq.DEALER)
        self.socket.linger = 0
        if secret is not None and server is not None:
            self.socket.curve_secretkey, self.socket.curve_serverkey = secret.encode(), server.encode()
            self.socket.curve_publickey = zmq.curve_public(secret.encode())
        self.socket.connect(link.endpoint)

    def __enter__(self) -> FakeNode:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def run(self, seconds: float = 0.4, **message: object) -> list[ev.RobotEvent]:
        """Send a message every 20 ms; return what the bridge has of it."""
        events: list[ev.RobotEvent] = []
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            with contextlib.suppress(zmq.Again):
                data = self.fresh.stamped({"version": VERSION, **message}, time.monotonic_ns())
                self.socket.send(data, zmq.NOBLOCK)
            time.sleep(0.02)
            events += self.link.poll(time.monotonic_ns())
            while self.socket.poll(0):
                one = json.loads(self.socket.recv())
                self.fresh.take(one, time.monotonic_ns())
                self.received.append(one)
        return events


STALE = b'{"version": 1, "at": 1, "seen": null}'


@pytest.fixture
def printed() -> list[str]:
    return []


@pytest.fixture
def link(printed: list[str]) -> Iterator[NodeLink]:
    link = NodeLink(LOCAL, None, printed.append)
    yield link
    link.close()


def test_messages_become_events_and_effects_messages(link: NodeLink) -> None:
    odometry = [17 * MS, 1.0, 2.0, 0.5, 0.1]
    with FakeNode(link) as node:
        events = node.run(odometry=odometry)
        assert {(one.stamp_ns, one.T_odom_base, one.speed_m_s) for one in events} == {
            (17 * MS, PlanarPose(1.0, 2.0, 0.5), 0.1)
        }
        link.publish_map_odom(5, PlanarPose(1.0, 2.0, 3.0))
        link.send_goal(ev.SendGoal(GOAL, 6, PlanarPose(4.0, 5.0, 6.0)))
        link.cancel_goal(GOAL)
        node.run(0.1)
        told = {key: one[key] for one in node.received for key in ("tf", "goal", "cancel") if key in one}
        assert told == {
            "tf": [5, 1.0, 2.0, 3.0],
            "goal": [GOAL.hex(), 6, 4.0, 5.0, 6.0],
            "cancel": GOAL.hex(),
        }


def test_every_kind_of_message() -> None:
    found = {
        "servers": 1,
        "odometry": 1,
        "others": ["tb1"],
        "release": "jazzy",
        "participants": True,
        "has": "",
    }
    message = {
        "odometry": [1, None, 0, 0, 0],
        "foreign": "map",
        "status": [[GOAL.hex(), 2], [GOAL.hex(), 99]],
        "feedback": [GOAL.hex(), 1.5],
        "accepted": False,
        "result": [9002, "no way"],
        "found": found,
    }
    odometry, *others = node_events(message, 3, 1)
    assert not odometry.T_odom_base.is_finite
    assert others == [
        ev.ForeignMapFrame("map"),
        ev.StatusReceived(((GOAL, ev.GoalStatus.EXECUTING), (GOAL, ev.GoalStatus.UNKNOWN))),
        ev.FeedbackReceived(GOAL, 1.5),
        ev.GoalAnswered(False),
        ev.ResultReceived(9002, "no way"),
        ev.RobotDiscovered(1, 1, ("tb1",), "jazzy"),
    ]


@pytest.mark.parametrize(
    "message",
    [
        {"odometry": [1, 2]},
        {"odometry": 7},
        {"status": [["zz", 2]]},
        {"found": {"servers": 1}},
        {"feedback": [3, "x"]},
    ],
)
def test_nonsense_is_one_line_and_moves_nothing(
    link: NodeLink, printed: list[str], message: dict[str, object]
) -> None:
    with FakeNode(link) as node:
        assert node.run(**message) == []
        node.socket.send(b"\xff{")
        assert node.run(foreign="map")
    assert sum("is not understood" in line for line in printed) == 1


def test_of_two_nodes_only_the_first_is_heard_and_the_robot_is_two(link: NodeLink) -> None:
    found = {"servers": 1, "odometry": 1, "others": [], "release": "jazzy", "participants": True, "has": ""}
    with FakeNode(link) as first:
        first.run()
        with FakeNode(link) as second:
            assert second.run(0.2, foreign="map") == []
            assert first.run(0.1, found=found)[-1].odometry_publishers == 2


def test_a_program_that_came_first_and_answers_nothing_loses_its_place(
    link: NodeLink, printed: list[str]
) -> None:
    """It holds the connection without ever hearing the bridge; the true node comes after it."""
    with FakeNode(link) as mute, FakeNode(link) as node:
        end = time.monotonic() + 10
        events: list[ev.RobotEvent] = []
        while not events and time.monotonic() < end:
            mute.socket.send(STALE)
            events = node.run(0.1, foreign="map")
        assert events
        mute.socket.send(STALE)
        assert node.run(2.5, foreign="map")[-1:]
        mute.socket.send(STALE)
        assert node.run(0.2, foreign="map")  # it keeps the place
    assert any("2 programs speak as the robot's node at tcp://127.0.0.1:" in line for line in printed)


def test_a_node_that_is_silent_is_gone_and_the_next_is_heard(link: NodeLink, printed: list[str]) -> None:
    with FakeNode(link) as node:
        node.run()
    end = time.monotonic() + 20
    while len(printed) < 2 and time.monotonic() < end:
        link.poll(time.monotonic_ns())
        time.sleep(0.02)
    assert printed == ["the robot's node has connected", "the robot's node is gone"]
    with FakeNode(link) as node:
        assert node.run(foreign="map")


@pytest.mark.parametrize(
    ("flood", "is_endless"),
    [(parts(1000, b"x" * 60_000), True), (parts(200_000), True), (message(STALE) * 500, False)],
    ids=["message without end", "empty parts without end", "small messages"],
)
def test_a_flood_at_the_port_takes_no_memory_and_the_node_is_heard(
    link: NodeLink, printed: list[str], flood: bytes, is_endless: bool
) -> None:
    with FakeNode(link) as node, RawPeer.joined(link.endpoint, b"evil") as evil:
        assert node.run(foreign="map")
        ends: list[float] = []

        def send() -> None:
            end = time.monotonic() + 4
            while time.monotonic() < end and evil.send(flood):
                pass
            ends.append(end - time.monotonic())

        before = resident_bytes()
        thread = threading.Thread(target=send)
        thread.start()
        heard, most = 0, 0
        while thread.is_alive():
            heard += len(node.run(0.1, foreign="map"))
            most = max(most, resident_bytes() - before)
        thread.join()
        assert heard and most < 100_000_000
        if is_endless:
            assert ends[0] > 0 and "disconnected" in printed[1]


def test_the_right_key_enters_and_no_other(tmp_path: Path, printed: list[str]) -> None:
    keys = keys_at(tmp_path)
    robot = (tmp_path / "robot" / "robot.secret").read_text().split()[2]
    eve = zmq.curve_keypair()[1].decode()
    link = NodeLink(LOCAL, keys, printed.append)
    try:
        for secret in (None, eve):
            with FakeNode(link, secret, keys.own.public) as node:
                assert node.run(0.6, foreign="map") == [] and node.received == []
        with FakeNode(link, robot, zmq.curve_keypair()[0].decode()) as node:  # another bridge's key
            assert node.run(0.6, foreign="map") == []
        assert sum("its key is not that of --node-key" in line for line in printed) == 1
        with FakeNode(link, robot, keys.own.public) as node:
            assert node.run(0.6, foreign="map") and node.received
    finally:
        link.close()


def test_addresses(link: NodeLink) -> None:
    with pytest.raises(UsageError, match="need keys"):
        NodeLink("tcp://0.0.0.0:0", None, print)
    with pytest.raises(TransportError, match="stop the other bridge"):
        NodeLink(link.endpoint, None, print)


# ------------------------------------------------------------ the file


def test_the_command_prints_a_file_that_needs_no_share(tmp_path: Path) -> None:
    result = CliRunner().invoke(cli, ["robot", "node"])
    (tmp_path / "share_robot_node.py").write_text(result.output)
    command = [sys.executable, "-I", "share_robot_node.py", "--help"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "tcp://HOST:PORT" in done.stdout
    assert "import share" not in result.output and "from share" not in result.output


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is not None, reason="rclpy is installed here")
@pytest.mark.parametrize("signals", [(signal.SIGINT,), (signal.SIGTERM,), (signal.SIGINT,) * 3])
def test_however_often_it_is_stopped_the_node_cancels_its_goal(signals: tuple[int, ...]) -> None:
    """A second Ctrl-C came while it stopped, and broke that off."""
    child = Path(__file__).parents[1] / "helpers" / "node_without_ros.py"
    command = [sys.executable, str(child), str(Path(robot_node.__file__).parent)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "UP\n"
        for number in signals:
            process.send_signal(number)
            time.sleep(0.001)
        printed = process.stdout.read()
    assert "CANCEL" in printed and process.returncode == 0


def test_without_rclpy_it_says_what_to_do(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["share_robot_node.py", "tcp://127.0.0.1:5580"])
    with pytest.raises(SystemExit) as ended:
        robot_node.main()
    assert ended.value.code == 2 and "source /opt/ros/" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["robot"], "expected tcp://HOST:PORT"),
        (["tcp://10.0.0.7:5580"], "without keys only a bridge on this machine"),
        (["tcp://10.0.0.7:5580", "--secret", "x"], "give both"),
        (["tcp://10.0.0.7:5580", "--secret", "nothing", "--server-key", "k" * 40], "No such file"),
        (
            ["tcp://10.0.0.7:5580", "--secret", "open", "--server-key", "k" * 40],
            "others can read this secret",
        ),
        (["tcp://10.0.0.7:5580", "--secret", "wrong", "--server-key", "k" * 40], "is no secret key"),
    ],
)
def test_bad_words(tmp_path: Path, monkeypatch, capsys, words: list[str], text: str) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "open").write_text("share-secret-key robot " + "k" * 40)
    (tmp_path / "wrong").write_text("share-public-key robot " + "k" * 40)
    (tmp_path / "wrong").chmod(0o600)
    (tmp_path / "open").chmod(0o644)
    monkeypatch.setattr(robot_node, "MISSING", None)
    monkeypatch.setattr(sys, "argv", ["share_robot_node.py", *words])
    with pytest.raises(SystemExit) as ended:
        robot_node.main()
    assert ended.value.code == 2 and text in capsys.readouterr().err


class _Topics(robot_node.RobotTopics):
    """The node's topics without rclpy, which remember what is cancelled."""

    def __init__(self) -> None:
        self.node = self
        self.outgoing, self.under_way, self.cancelled = deque(), [], []  # type: ignore[var-annotated]
        self.lines: list[str] = []

    def get_logger(self) -> _Topics:
        return self

    def _log(self, text: str, **_: object) -> None:
        self.lines.append(text)

    info = warning = error = _log

    def cancel(self, goal_id: str) -> None:
        self.cancelled.append(goal_id)


def _bomb() -> str:
    """A map of 1 GB in 1.4 MB."""
    packer = zlib.compressobj(1)
    data = b"".join(packer.compress(bytes(1 << 20)) for _ in range(1 << 6)) + packer.flush()
    fixed = {"size": [1 << 13, 1 << 13], "cells": base64.b64encode(data).decode()}
    return json.dumps({**fixed, "resolution": 1, "origin": [0, 0, 0], "body": [0] * 7, "name": "x"})


def test_what_no_bridge_sends_does_not_end_the_nodes_link(monkeypatch) -> None:
    monkeypatch.setattr(robot_node, "zmq", zmq, raising=False)
    topics, bridge = _Topics(), Freshness(5)
    socket = zmq.Context.instance().socket(zmq.ROUTER)
    port = socket.bind_to_random_port("tcp://127.0.0.1")
    link = robot_node.BridgeLink(topics, f"tcp://127.0.0.1:{port}", None)
    bomb = _bomb()
    link.start()
    bodies = [
        "[" * 100_000,
        '{"version": 1, "x": ' + "[" * 100_000 + "]" * 100_000 + "}",
        "\udcff{",
        '"goal": 5',
        '"speed": ' + "9" * 5000,
        '"speed": ' + "9" * 400,
        '"fixed": ' + bomb,
        '"fixed": {"size": [-1, 5], "cells": ""}',
        '"cancel": []',
    ]
    try:
        name = b""
        for body in bodies:
            while socket.poll(0) or not name:
                name, data = socket.recv_multipart()
                bridge.take(json.loads(data), time.monotonic_ns())
            told = bridge.stamped({"version": VERSION}, time.monotonic_ns()).decode()
            text = f"{told[:-1]}, {body}}}" if body.startswith('"') else body
            socket.send_multipart([name, told.encode()])
            socket.send_multipart([name, text.encode("utf-8", "surrogateescape")])
            time.sleep(0.15)
        assert link.is_alive()
        topics.under_way = [GOAL.hex()]
        end = time.monotonic() + 20
        while len(topics.cancelled) < 2 and time.monotonic() < end:  # nothing comes any more
            time.sleep(0.05)
        assert topics.cancelled[-1] == GOAL.hex() and link.is_alive()
        nonsense = [line for line in topics.lines if "is not understood" in line]
        assert len(nonsense) == len(bodies) - 1 and any("a map of 8192 by 8192" in line for line in nonsense)
    finally:
        link.is_ended = True
        link.join()
        link._socket.close()
        link._socket.context.term()
        socket.close(0)


# ------------------------------------------------------------ with a robot of rclpy

ros = [
    pytest.mark.ros,
    pytest.mark.long,
    pytest.mark.skipif(ROS is None, reason="SHARE_ROS names no environment with rclpy (CONTRIBUTING.md)"),
]


def in_ros(test: Callable[..., None]) -> Callable[..., None]:
    for mark in ros:
        test = mark(test)
    return test


class NodeProcess:
    """The node by the Python of ROS, on the robot's domain."""

    def __init__(self, folder: Path, domain: int, address: str, *words: str) -> None:
        command = [f"{ROS}/bin/python", "-u", robot_node.__file__, address, *words]
        self.log = folder / f"node-{secrets.token_hex(3)}.log"
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                command, env=ros_environment(folder, domain), stdout=log, stderr=log, text=True
            )
        give_a_computer(self.process)

    def end(self) -> None:
        self.process.kill()
        self.process.wait()


class NodeRoom(RosRoom):
    """A room whose bridge reaches the robot by a node, with keys."""

    def __init__(self, folder: Path, tmp_path: Path, **more: object) -> None:
        self.folder, self.domain = folder, 40 + os.getpid() % 60
        self.keys = keys_at(tmp_path)
        self.secret = str(tmp_path / "robot" / "robot.secret")
        self.nodes: list[NodeProcess] = []

        def connect(print_line: Callable[[str], None]) -> NodeLink:
            return NodeLink("tcp://127.0.0.1:0", self.keys, print_line)

        super().__init__(folder, self.domain, tmp_path, connect=connect, **more)
        self.start_node()

    def start_node(self) -> NodeProcess:
        words = ["--secret", self.secret, "--server-key", self.keys.own.public]
        self.nodes.append(NodeProcess(self.folder, self.domain, self.node.endpoint, *words))
        return self.nodes[-1]

    def close(self) -> None:
        for node in self.nodes:
            node.end()
        super().close()

    def drive(self) -> None:
        """Send the robot somewhere, and wait until it is under way."""
        self.goto()
        assert self.run(30.0, lambda: any(one.text == "executing" for one in self.reports)), self.reports


@pytest.fixture
def room(tmp_path: Path) -> Iterator[Callable[..., NodeRoom]]:
    rooms: list[NodeRoom] = []

    def open_room(release: str = "jazzy", **more: object) -> NodeRoom:
        rooms.append(NodeRoom(built_messages(release), tmp_path, **more))
        assert rooms[-1].run(60.0, rooms[-1].is_ready), (
            rooms[-1].printed,
            rooms[-1].nodes[0].log.read_text(),
        )
        return rooms[-1]

    yield open_room
    for one in rooms:
        one.close()


@in_ros
def test_the_map_the_body_and_tf(room: Callable[..., NodeRoom]) -> None:
    here = room()
    assert here.run(30.0, lambda: here.robot.of("map") and here.robot.of("static"))
    assert (here.robot.of("map")[0]["free"], here.robot.of("map")[0]["occupied"]) == (640_000, 0)
    assert here.robot.of("static")[-1]["static"] == [["base_link", "share_body"]]
    begin, seconds = time.time() + 1.0, float(os.environ.get("SHARE_ROS_SECONDS", "8"))
    here.run(1.0 + seconds)
    rows = np.array([one["tf"] for one in here.robot.of("tf") if one["tf"][0] > begin])
    truth = [map_odom_at(t - here.begin_s) @ odometry_at(t - here.begin_s) for t in rows[:, 0]]
    errors = np.hypot(rows[:, 1] - [p.x for p in truth], rows[:, 2] - [p.y for p in truth])
    missing = [one for one in here.robot.of("tf_missing") if one["tf_missing"] > begin]
    print(
        f"\nmap → base_link by a node: {1e3 * np.sqrt((errors**2).mean()):.2f} mm rms, "
        f"{1e3 * errors.max():.1f} max, n {len(rows)}, extrapolations {len(missing)}"
    )
    assert len(rows) > 7 * seconds and np.sqrt((errors**2).mean()) < 0.005
    assert not here.robot.of("error")


@in_ros
@pytest.mark.parametrize("release", ["humble", "jazzy", "newer"])
def test_a_goal_is_reached(room: Callable[..., NodeRoom], release: str) -> None:
    here = room(release, drive_s=1.5)
    assert_goal_is_reached(here, here.folder.name, within_s=40.0)


@in_ros
@pytest.mark.parametrize("release", ["humble", "newer"])
def test_a_goal_that_fails_says_why(room: Callable[..., NodeRoom], release: str) -> None:
    here = room(release, drive_s=20.0)
    here.drive()
    here.node.publish_map_odom = lambda *_: None
    assert here.run(30.0, here.ended)
    text = "without a reason" if here.folder.name == "humble" else "Nav2's error 9002, no transform"
    assert text in here.reports[-1].text


@in_ros
def test_cancel_and_a_lost_pose(room: Callable[..., NodeRoom]) -> None:
    here = room(drive_s=20.0)
    here.drive()
    here.run_._handle(ev.CancelRequested("bob"))
    assert here.run(30.0, here.ended)
    assert here.reports[-1].text == "stopped: cancelled by bob"
    here.reports.clear()
    here.drive()
    here.state = TrackState.LOST
    assert here.run(30.0, here.ended)
    assert here.reports[-1].text == "stopped: bot has lost tracking (LOST)"
    here.robot.forget()
    here.run(1.0)
    assert not here.robot.of("tf")[4:] and here.robot.of("tf_missing")


@in_ros
def test_dead_man_a_silent_bridge_stops_the_robot_and_map_odom(room: Callable[..., NodeRoom]) -> None:
    here = room(drive_s=30.0, fault="patient")
    here.drive()
    began = time.monotonic()
    while not here.robot.of("ended") and time.monotonic() < began + 30:  # the bridge hangs
        time.sleep(0.02)
    took_s = time.monotonic() - began
    print(f"\na silent bridge → the goal has ended: {took_s:.1f} s")
    assert here.robot.of("ended") == [{"ended": "canceled"}]  # not for want of transforms
    time.sleep(1.0)
    here.robot.forget()
    time.sleep(1.0)
    assert here.robot.of("tf_missing") and not here.robot.of("tf")


@in_ros
def test_a_goal_of_before_a_gap_is_not_begun_after_it(room: Callable[..., NodeRoom]) -> None:
    here = room(drive_s=30.0)
    here.robot.forget()
    here.nodes[0].process.send_signal(19)  # SIGSTOP: what the bridge sends waits
    here.goto()
    time.sleep(2.0)
    here.nodes[0].process.send_signal(18)
    assert here.run(30.0, here.ended)
    assert not here.robot.of("goal")


@in_ros
def test_a_bridge_that_is_begun_again_drives_the_robot_on(room: Callable[..., NodeRoom]) -> None:
    here = room(drive_s=30.0)
    here.drive()
    address = here.node.endpoint
    here.node.close()
    time.sleep(2.5)
    assert here.robot.of("ended")
    printed: list[str] = []
    here.node = NodeLink(address, here.keys, printed.append)
    here.restart_bridge()
    assert here.run(30.0, here.is_ready), printed
    here.reports.clear()
    here.drive()


@in_ros
def test_a_node_that_dies_leaves_no_goal_and_the_next_one_drives(room: Callable[..., NodeRoom]) -> None:
    here = room(drive_s=30.0)
    here.drive()
    here.nodes[0].end()
    here.run(1.0)
    here.start_node()
    assert here.run(30.0, here.ended)
    assert here.robot.of("ended") and not here.reports[-1].is_reached
    assert here.run(30.0, here.is_ready)
    here.reports.clear()
    here.drive()


@in_ros
def test_another_key_and_forged_messages_reach_nothing(room: Callable[..., NodeRoom]) -> None:
    here = room(drive_s=30.0)
    eve = zmq.curve_keypair()[1].decode()
    before = here.run_.bridge.report(time.monotonic_ns())["pose"]
    for secret in (None, eve):
        with FakeNode(here.node, secret, here.keys.own.public) as node:
            for _ in range(30):
                with contextlib.suppress(zmq.Again):
                    forged = b'{"version":1,"at":1,"seen":null,"odometry":[1,9,9,9,0]}'
                    node.socket.send(forged, zmq.NOBLOCK)
            here.run(1.0)
    after = here.run_.bridge.report(time.monotonic_ns())["pose"]
    assert np.hypot(after[0] - before[0], after[1] - before[1]) < 1.5 and here.is_ready()
    assert any("a node was refused" in line for line in here.printed)
