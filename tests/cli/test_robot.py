"""`share robot`: what it says of bad input, and how goals reach a bridge."""

from __future__ import annotations

import importlib.util
import json
import socket
import threading
import time
from pathlib import Path

import pytest
from click.testing import CliRunner

from share.cli.main import cli
from share.cli.robot_links import LocalRobot, RobotNews
from share.errors import ShareError, TransportError, UsageError
from share.robot import robot_events as ev
from share.runtime import robot_commands
from share.runtime.robot_commands import CommandServer, command_path

GOAL_ID = b"SHARE\x00\x00\x01" + b"g" * 8


@pytest.fixture(autouse=True)
def home(monkeypatch, tmp_path_factory):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("run")))
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


def run(*arguments: str) -> object:
    return CliRunner().invoke(cli, ["robot", *arguments])


class Served:
    """A bridge's end of the socket, which answers goals as `answer` says."""

    def __init__(self, answer) -> None:
        self.server, self.events, self._answer = CommandServer(command_path(0, "")), [], answer
        self._is_ended = False
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> Served:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_ended = True
        self._thread.join()
        self.server.close()

    def _serve(self) -> None:
        while not self._is_ended:
            for event in self.server.poll(lambda: GOAL_ID):
                self.events.append(event)
                self._answer(self.server, event)
            time.sleep(0.005)

    def wait_for(self, kind: type) -> ev.RobotEvent:
        end = time.monotonic() + 5
        while time.monotonic() < end:
            if found := [event for event in self.events if isinstance(event, kind)]:
                return found[0]
            time.sleep(0.005)
        raise AssertionError(f"no {kind.__name__}: {self.events}")


def _end(text: str, is_reached: bool):
    def answer(server: CommandServer, event: ev.RobotEvent) -> None:
        if isinstance(event, ev.GotoRequested):
            server.report(ev.GoalReport(event.commander, "executing"))
            server.report(ev.GoalReport(event.commander, text, is_final=True, is_reached=is_reached))

    return answer


def test_goto_is_done_when_the_robot_is_there():
    with Served(_end("reached", True)) as served:
        result = run("goto", "2.5", "-0.8", "90")
    assert (result.exit_code, result.stdout) == (0, "reached\n")
    (goal,) = [event for event in served.events if isinstance(event, ev.GotoRequested)]
    assert (goal.goal_id, goal.x, goal.y) == (GOAL_ID, 2.5, -0.8)
    assert goal.yaw == pytest.approx(1.5708, abs=1e-4) and goal.map_id is None


def test_goto_that_fails_says_why():
    with Served(_end("refused: goals are not allowed", False)):
        result = run("goto", "-2.5", "0.8", "--map-id", "ann-1/0")
        assert isinstance(result.exception, ShareError)
        assert str(result.exception) == "the robot is not at x -2.5 y 0.8: refused: goals are not allowed"
        told = run("goto", "1", "2", "--json")
    assert json.loads(told.stdout) == {"reached": False, "text": "refused: goals are not allowed"}


def test_a_commander_that_is_gone_is_told():
    with Served(lambda server, event: None) as served:
        link = socket.socket(socket.AF_UNIX)
        link.connect(str(command_path(0, "")))
        link.sendall(b'{"do": "goto", "x": 1, "y": 2, "yaw": null, "map_id": null}\n')
        goal = served.wait_for(ev.GotoRequested)
        link.close()
        assert served.wait_for(ev.CommanderLost).commander == goal.commander


def _confirm(text: str, is_reached: bool):
    def answer(server: CommandServer, event: ev.RobotEvent) -> None:
        if isinstance(event, ev.CancelRequested):
            server.report(ev.GoalReport(event.commander, text, True, is_reached, event.cancel_id))

    return answer


def test_cancel_is_done_when_the_robot_confirms_it():
    with Served(_confirm("cancelled", True)):
        result = run("cancel")
    assert (result.exit_code, result.stdout) == (0, "cancelled\n")


@pytest.mark.parametrize("stops", [True, False])
def test_cancel_for_machines(stops):
    with Served(_confirm("text", stops)):
        result = run("cancel", "--json")
    assert json.loads(result.stdout) == {"stopped": stops, "text": "text"}
    assert result.exit_code == 1 - stops


def test_cancel_that_the_robot_does_not_confirm():
    with Served(_confirm("not confirmed by the robot: stop it by hand", False)):
        result = run("cancel")
    assert isinstance(result.exception, ShareError) and result.exit_code == 1
    assert str(result.exception) == "the robot's stop: not confirmed by the robot: stop it by hand"


def test_cancel_that_nobody_answers(monkeypatch):
    monkeypatch.setattr(robot_commands, "ask_bridge", lambda path, wish: iter(()))
    result = run("cancel")
    assert isinstance(result.exception, ShareError)
    assert str(result.exception) == "the robot's stop: the bridge has ended"


def test_watch_shows_lines_and_where_the_robot_is():
    state = {"pose": [1.0, 2.0, 1.5708], "map_id": "ann-1/0", "fault": None, "refusal": None, "goal": None}
    with Served(lambda server, event: None) as served:
        seen = LocalRobot(command_path(0, "")).watch()
        end = time.monotonic() + 5
        first = threading.Thread(target=lambda: served.__dict__.update(got=next(seen)))
        first.start()
        while first.is_alive() and time.monotonic() < end:
            served.server.show(lambda: state, time.monotonic_ns())
            time.sleep(0.01)
        first.join()
        seen.close()
    assert served.got == RobotNews({"state": state}, "x 1.00 y 2.00 m, 90° in ann-1/0", is_place=True)


@pytest.mark.parametrize(
    "line",
    [
        b"\n",
        b"[]\n",
        b'{"do": "goto"}\n',
        b'{"do": "goto", "x": "a", "y": 1, "yaw": 1, "map_id": 1}\n',
        b'{"do": "fly"}\n',
        b"x" * 10_000,
        b"\xff\n",
    ],
)
def test_a_malformed_wish_costs_its_connection_only(line: bytes):
    with Served(_end("reached", True)) as served:
        link = socket.socket(socket.AF_UNIX)
        link.connect(str(command_path(0, "")))
        link.sendall(line)
        time.sleep(0.1)
        assert run("goto", "1", "1").exit_code == 0
        link.close()
        assert len([event for event in served.events if isinstance(event, ev.GotoRequested)]) == 1


def test_the_socket_is_the_users_own_and_one_bridge_holds_it():
    path = command_path(0, "")
    server = CommandServer(path)
    assert path.stat().st_mode & 0o077 == 0
    with pytest.raises(TransportError, match="runs already"):
        CommandServer(path)
    server._listener.close()  # as one that was killed: the file stays
    CommandServer(path).close()
    assert not path.exists()


def test_robots_have_sockets_of_their_own():
    paths = {command_path(0, ""), command_path(1, ""), command_path(0, "tb1"), command_path(0, "/tb1/")}
    assert len(paths) == 3


@pytest.mark.parametrize("words", [["goto", "1", "2"], ["cancel"], ["watch"]])
def test_without_a_bridge(words: list[str]):
    result = run(*words)
    assert isinstance(result.exception, ShareError) and "no bridge of this robot runs" in str(
        result.exception
    )


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--poses", "udp://0.0.0.0:5570"], "could be forged"),
        (["--poses", "udp://192.168.1.2:5570"], "could be forged"),
        (["--poses", "udp://"], "is not an address"),
        (["--namespace", "tb 1"], "use letters, digits and _"),
        (["--peer", "<x>"], "give the robot's address"),
    ],
)
def test_bridge_with_bad_options(tmp_path: Path, more: list[str], said: str):
    if more[0] in ("--namespace", "--peer"):
        pytest.importorskip("cyclonedds")
    (tmp_path / "robot.yaml").write_text("camera: {position_m: [0, 0, 0.2]}\n")
    result = run(
        "bridge",
        "--robot",
        str(tmp_path / "robot.yaml"),
        *(more or []),
        *([] if more[0] == "--poses" else ["--poses", "udp://127.0.0.1:0"]),
    )
    assert isinstance(result.exception, UsageError) and said in str(result.exception)


@pytest.mark.skipif(importlib.util.find_spec("cyclonedds") is not None, reason="cyclonedds is installed")
def test_bridge_without_cyclonedds(tmp_path: Path):
    (tmp_path / "robot.yaml").write_text("camera: {position_m: [0, 0, 0.2]}\n")
    result = run("bridge", "--robot", str(tmp_path / "robot.yaml"), "--poses", "udp://127.0.0.1:0")
    assert isinstance(result.exception, ShareError)
    assert "pip install 'share-slam[robot]'" in str(result.exception)
