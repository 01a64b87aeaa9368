"""`share.Room` and the commands `share marker` and `share robot … --edge` at an edge over a real link."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from helpers.room_server import MAP, RoomServer

from share import Edge, Room, ShareError
from share.cli.main import cli
from share.cli.robot_links import RobotAtEdge, RobotNews
from share.cli.room_options import open_room
from share.errors import UsageError
from share.mapping.map_changes import SaveObject
from share.net import keys
from share.protocol.room_events import MessageWanted, RobotCommanded
from share.runtime.room_link import RoomLink
from share.store.map_store import MapStore
from share.wire.room_messages import Cancel, CommandState, ObjectKind, Permission, RobotPlace, RoomObject

pytestmark = pytest.mark.long
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def server():
    with RoomServer() as server:
        yield server


class Robot:
    """A bridge that takes every goal and says that it is reached after a while."""

    def __init__(self, address: str, reach_s: float = 0.2) -> None:
        self.commands: list[object] = []
        self._reach_s, self._is_ended = reach_s, False
        self._link = RoomLink(address, "bot", drives_robot=True)
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> Robot:
        self._thread.start()
        while not self._link.client.is_connected:
            time.sleep(0.01)
        return self

    def __exit__(self, *_: object) -> None:
        self._is_ended = True
        self._thread.join()
        self._link.close()

    def _serve(self) -> None:
        begun: dict[int, float] = {}
        while not self._is_ended:
            self._link.handle(MessageWanted(RobotPlace(None, MAP, 1.0, 2.0, 0.0, "")))
            for effect in self._link.step(50):
                if isinstance(effect, RobotCommanded):
                    command = effect.command
                    self.commands.append(command)
                    began_s = begun.setdefault(command.command, time.monotonic())
                    done = isinstance(command, Cancel) or time.monotonic() - began_s > self._reach_s
                    text = "done" if done else "driving"
                    state = CommandState(command.command, None, command.commander, text, done, done)
                    self._link.handle(MessageWanted(state))


def share(*arguments: str) -> object:
    return CliRunner().invoke(cli, arguments)


def test_what_one_places_another_sees(server) -> None:
    with Room(server.address, "ann") as ann, Room(server.address, "bob") as bob:
        cube = ann.put("cube", (1, 2, 0.5), yaw=0.3)
        deadline = time.monotonic() + 5
        while cube not in bob.objects and time.monotonic() < deadline:
            time.sleep(0.01)
        seen = bob.objects[cube]
        assert (seen.owner, str(seen.kind), seen.map_id) == ("ann", "cube", MAP)
        np.testing.assert_allclose(seen.T_map_object[:3, 3], (1, 2, 0.5))
        bob.put("cube", (3, 2, 0.5), object_id=cube)
        bob.remove(cube)
        with pytest.raises(ShareError, match="there is no object"):
            bob.remove(cube)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("ball", (0, 0, 0)), "ball"),
        (("cube", (0, 0, float("nan"))), "not finite"),
        (("cube", (0, 0, 1e4)), "more than 1000 m away"),
        (("cube", (0, 0)), "not enough values"),
    ],
)
def test_what_no_room_has_is_refused_here(server, arguments, text) -> None:
    with Room(server.address, "ann") as room, pytest.raises(UsageError, match=text):
        room.put(*arguments)


def test_arguments_of_another_type_are_refused_at_once(server) -> None:
    with Room(server.address, "ann") as room:
        with pytest.raises(UsageError, match="object_id: has to be a whole number"):
            room.remove(7.0)  # type: ignore[arg-type]
        with pytest.raises(UsageError, match="x: has to be a number, not bool"):
            room.goto(True, 2.0)
        with pytest.raises(UsageError, match="map_id: is a int, expected a name, or None"):
            room.put("cube", (1, 2, 0), map_id=5)  # type: ignore[arg-type]
        with pytest.raises(UsageError, match="robot: is a int, expected a name, or None"):
            room.goto(1, 2, robot=5)  # type: ignore[arg-type]
        for name in ("a/b", 7):
            with pytest.raises(UsageError):
                room.stop_robot(name)  # type: ignore[arg-type]
        room.put("cube", (1, 2, 0))  # and it is still served


def test_a_room_that_does_not_let_it_in_says_why() -> None:
    with RoomServer(()) as server, Room(server.address, "ann") as room:
        with pytest.raises(
            ShareError, match="nobody may place objects here; start the edge with --allow objects"
        ):
            room.put("cube", (0, 0, 0))
        goal = room.goto(1, 2, robot="bot")
        assert not goal.wait(5)
        assert goal.text.endswith("nobody may command robots here; start the edge with --allow commands")


def test_a_name_that_is_none(server) -> None:
    with pytest.raises(UsageError, match="name"):
        Room(server.address, "a\nb")


def test_a_goal_is_followed_to_its_end_and_a_room_that_is_left_stops_the_robot(server) -> None:
    with Robot(server.address) as robot:
        with Room(server.address, "ann") as room:
            goal = room.goto(2.0, 1.0, robot="bot")
            assert goal.wait(10) and goal.text == "done"
            robot._reach_s = 1e9
            room.goto(5.0, 1.0)
            time.sleep(0.3)
        assert isinstance(robot.commands[-1], Cancel)


def test_share_marker(server) -> None:
    at = ("--edge", server.address, "--name", "ann")
    made = share("marker", "put", "1.5", "-0.5", "--yaw", "90", *at)
    assert made.exit_code == 0, made.output
    listed = share("marker", "list", *at, "--json")
    assert json.loads(listed.stdout) == [
        {
            "id": int(made.stdout),
            "kind": "marker",
            "owner": "ann",
            "position": [1.5, -0.5, 0.0],
            "yaw_deg": 90.0,
            "map_id": MAP,
        }
    ]
    assert f"x 1.50 y -0.50 z 0.00 m, 90° in {MAP}" in share("marker", "list", *at).stdout
    assert share("marker", "remove", made.stdout.strip(), *at).exit_code == 0
    again = share("marker", "remove", made.stdout.strip(), *at)
    assert isinstance(again.exception, ShareError) and "there is no object" in str(again.exception)
    assert share("marker", "list", *at, "--json").stdout == "[]\n"


def test_share_robot_over_an_edge(server) -> None:
    at = ("--edge", server.address, "--name", "ann")
    nobody = share("robot", "goto", "1", "2", *at)
    assert "no robot is connected: start its bridge with --edge" in str(nobody.exception)
    with Robot(server.address) as robot:
        gone = share("robot", "goto", "2.5", "-0.5", "90", *at)
        assert gone.exit_code == 0 and gone.stdout == "done\n"
        assert (robot.commands[0].x, robot.commands[0].commander) == (2.5, "ann")
        assert share("robot", "cancel", "--robot", "bot", *at).stdout == "done\n"
    far = share("robot", "goto", "99999", "0", *at)
    assert isinstance(far.exception, UsageError)
    assert isinstance(share("robot", "goto", "1", "0", "--edge", server.address).exception, UsageError)


def test_share_robot_watch_over_an_edge(server) -> None:
    with Robot(server.address):
        seen = RobotAtEdge(open_room(server.address, "ann", None, None, wants_robots=True), "bot").watch()
        place = next(one for one in seen if one.is_place)
        seen.close()
    state = {"pose": [1.0, 2.0, 0.0], "map_id": MAP, "text": ""}
    assert place == RobotNews(
        {"robot": "bot", "state": state}, f"bot: x 1.00 y 2.00 m, 0° in {MAP}", is_place=True
    )


def test_a_goto_that_is_interrupted_stops_the_robot(server) -> None:
    import signal

    with Robot(server.address, reach_s=1e9) as robot:
        command = [sys.executable, "-m", "share", "robot", "goto", "2", "1", "--edge", server.address]
        process = subprocess.Popen([*command, "--name", "ann"], cwd=ROOT, stderr=subprocess.PIPE)
        deadline = time.monotonic() + 60
        while not robot.commands and time.monotonic() < deadline:
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=30)
        assert isinstance(robot.commands[-1], Cancel)


def test_who_may_not_command_by_the_edge(tmp_path) -> None:
    with RoomServer({Permission.OBJECTS}) as server, Robot(server.address) as robot:
        refused = share("robot", "goto", "1", "2", "--edge", server.address, "--name", "eve")
        assert "nobody may command robots here" in str(refused.exception) and not robot.commands


def test_with_keys_the_list_says_who_may_and_a_change_counts_at_once(tmp_path) -> None:
    for name in ("edge", "ann"):
        keys.generate_pair(tmp_path / name, name)
    own, ann = keys.load_pair(tmp_path / "edge"), keys.load_pair(tmp_path / "ann")
    keys.authorize(tmp_path / "edge", "ann", ann.public)
    with Edge("tcp://127.0.0.1:0", keys=tmp_path / "edge") as edge:
        with Room(edge.endpoint, "ann", keys=tmp_path / "ann", server_key=own.public) as room:
            line = "the key of 'ann' may not place objects; on the edge run: share keys authorize … --objects"
            with pytest.raises(ShareError, match=line):
                room.put("cube", (0, 0, 0), map_id=MAP)
            keys.authorize(tmp_path / "edge", "ann", ann.public, permissions={Permission.OBJECTS: True})
            time.sleep(0.5)
            with pytest.raises(ShareError, match=f"there is no map {MAP}"):
                room.put("cube", (0, 0, 0), map_id=MAP)
        with pytest.raises(ShareError, match="its key is authorized for 'ann', not for 'bob'"):
            Room(edge.endpoint, "bob", keys=tmp_path / "ann", server_key=own.public).start()


def test_objects_survive_the_edge_with_its_map_file(tmp_path) -> None:
    kept = RoomObject(1, 1, 7, ObjectKind.CUBE, "ann", MAP, np.eye(4))
    with MapStore.open(tmp_path / "room.sqlite") as store:
        store.write([SaveObject(kept, MAP)])
    options = {"map_file": tmp_path / "room.sqlite", "allow": ["objects"]}
    with Edge("tcp://127.0.0.1:0", **options) as edge, Room(edge.endpoint, "bob") as room:
        assert room.objects[7].owner == "ann"
        room.remove(7)
        assert edge.report()["config"]
    with MapStore.open(tmp_path / "room.sqlite") as store:
        assert store.load().objects == ()


def test_the_example(server) -> None:
    with Robot(server.address):
        command = [sys.executable, str(ROOT / "examples" / "shared_objects.py"), server.address, "ann", "bot"]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.stderr == "" and done.returncode == 0
    first, second = done.stdout.splitlines()
    assert first.endswith(f"cube of ann at [1.9 2.  0.5] m in {MAP}") and second == "there"
    assert [one["event"] for one in server.events].count("object removed") == 1
