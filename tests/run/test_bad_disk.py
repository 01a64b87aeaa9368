"""A disk with errors, with a quota, read-only of a sudden, or that does not answer, under a running edge and
under an agent: they go on, what they say is true, and they can be ended."""

from __future__ import annotations

import errno
import json
import os
import signal
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from helpers.children import Child
from helpers.crowd import Walker, crowd
from helpers.preloaded import BadDisk, with_environment
from test_edge_files import kept_ids
from test_edge_killed import family

pytestmark = pytest.mark.slow
WORDS = {
    errno.EIO: "Input/output error",
    errno.EDQUOT: "Disk quota exceeded",
    errno.EROFS: "Read-only file system",
}
ENDS_S = 20.0  # mapper, map and files have five seconds each to come to an end


class Room:
    """An edge that writes its map, and its own files where `out`, to a disk that may be bad; and an agent."""

    def __init__(self, place: Path, disk: BadDisk, out: bool) -> None:
        self.disk, self.map = disk, disk.folder / "room.sqlite"
        where = ("--out", str(disk.folder / "out")) if out else ()
        patch = with_environment(disk.env)
        arguments = ("--bind", "tcp://127.0.0.1:0", "--map", str(self.map), "--http", "0", *where)
        self.edge = Child(place / "edge.log", "edge", *arguments)
        patch.undo()
        address = self.edge.wait_for(r"listening on (tcp://\S+?),")[1]
        self.page = self.edge.wait_for(r"status at (\S+)")[1]
        self.ann: Walker
        (self.ann,) = crowd(("ann",), address, frames=600)
        self.ann.start()
        self.until(lambda: self.acknowledged > 2)

    @property
    def acknowledged(self) -> int:
        return int(self.ann.machine.report()["acknowledged"])

    def shown(self) -> dict[str, Any]:
        with urllib.request.urlopen(f"{self.page}snapshot.json", timeout=5) as answer:
            return dict(json.load(answer))

    def until(self, condition: Any, seconds: float = 30.0) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, self.edge.said
            time.sleep(0.05)

    def ended(self) -> int:
        """Exit code after Ctrl-C."""
        return self.edge.interrupt(ENDS_S)

    def is_served(self) -> None:
        """What the page says of the agent is of now."""
        for _ in range(20):
            ann = self.shown()["agents"]["ann"]
            assert ann["state"] == "OK"
            assert ann["last_received_s"] < 1.0
            assert ann["pose_age_ms"] < 1000.0
            time.sleep(0.1)


@contextmanager
def room(place: Path, out: bool = True) -> Iterator[Room]:
    disk = BadDisk(place)
    made = Room(place, disk, out)
    try:
        yield made
    finally:
        disk.is_well()
        made.ann.finish()
        made.edge.kill()


@pytest.mark.parametrize("number", list(WORDS))
def test_a_disk_that_fails_for_a_while(tmp_path: Path, number: int) -> None:
    with room(tmp_path) as made:
        made.disk.fails(number)
        made.edge.wait_for(f"the map cannot be written: {WORDS[number]}; keyframes are not acknowledged")
        before = made.acknowledged
        made.is_served()
        assert made.acknowledged == before
        assert any(WORDS[number] in text for text in made.shown()["trouble"])
        made.disk.is_well()
        made.edge.wait_for("the map is saved again")
        made.ann.finish()
        made.ann.join(20)
        assert made.ann.machine.report()["pending"] == 0
        assert made.ended() == 1
        assert made.edge.said.endswith(f"events.jsonl: is not complete: {WORDS[number]}\n")
        keyframes = made.ann.machine.report()["keyframes"]
        assert kept_ids(made.map, tmp_path / "copy") == list(range(keyframes))


@pytest.mark.parametrize("number", list(WORDS))
def test_a_disk_that_fails_to_the_end(tmp_path: Path, number: int) -> None:
    with room(tmp_path, out=False) as made:
        made.disk.fails(number)
        made.edge.wait_for("the map cannot be written")
        time.sleep(1.0)
        assert made.ended() == 1
        assert f"{WORDS[number]}: " in made.edge.said.splitlines()[-1]
        assert made.edge.said.endswith("changes are not in the map file\n")
        assert "Traceback" not in made.edge.said
        assert kept_ids(made.map, tmp_path / "copy") == list(range(made.acknowledged))


def test_a_disk_that_does_not_answer_for_ten_seconds(tmp_path: Path) -> None:
    with room(tmp_path) as made:
        made.disk.hangs()
        time.sleep(0.5)  # a write that was under way
        before = made.acknowledged
        began = time.monotonic()
        while time.monotonic() - began < 10.0:
            made.is_served()
            assert made.acknowledged == before
        trouble = "\n".join(made.shown()["trouble"])
        assert "a write to the map file has taken" in trouble
        assert "out: its disk has not answered for" in trouble
        made.disk.is_well()
        made.ann.finish()
        made.ann.join(20)
        assert made.ann.machine.report()["pending"] == 0
        made.until(lambda: not made.shown()["trouble"])
        assert made.ended() == 0
        keyframes = made.ann.machine.report()["keyframes"]
        assert kept_ids(made.map, tmp_path / "copy") == list(range(keyframes))
        events = (made.disk.folder / "out" / "events.jsonl").read_text().splitlines()
        assert not [line for line in events if '"silent"' in line]


def test_ctrl_c_while_the_disk_does_not_answer(tmp_path: Path) -> None:
    with room(tmp_path) as made:
        made.disk.hangs()
        time.sleep(2.0)
        acknowledged = made.acknowledged
        assert made.ended() == 1
        assert "the disk of the map file does not answer" in made.edge.said
        assert "Traceback" not in made.edge.said
        made.disk.is_well()
        assert kept_ids(made.map, tmp_path / "copy") == list(range(acknowledged))


def test_the_mapper_dies_while_the_disk_does_not_answer(tmp_path: Path) -> None:
    with room(tmp_path) as made:
        made.disk.hangs()
        time.sleep(1.0)
        before = made.acknowledged
        os.kill(family(made.edge.process.pid)["mapper"], signal.SIGKILL)
        made.edge.wait_for("map: the disk of the map file does not answer; retried")
        made.is_served()
        assert made.acknowledged == before
        made.disk.is_well()
        made.until(lambda: made.acknowledged > before + 3)
        made.ann.finish()
        made.ann.join(20)
        assert made.ann.machine.report()["pending"] == 0
        assert made.ended() == 0
        keyframes = made.ann.machine.report()["keyframes"]
        assert kept_ids(made.map, tmp_path / "copy") == list(range(keyframes))


@pytest.mark.parametrize("lasting", [False, True])
def test_an_agent_whose_disk_does_not_answer(tmp_path: Path, plain_session: Path, lasting: bool) -> None:
    """It tracks and tells the edge as if nothing were wrong."""
    disk = BadDisk(tmp_path)
    edge = Child(tmp_path / "edge.log", "edge", "--bind", "tcp://127.0.0.1:0", "--http", "0")
    address, page = edge.wait_for(r"listening on (tcp://\S+?),")[1], edge.wait_for(r"status at (\S+)")[1]
    patch = with_environment(disk.env)
    out, who = disk.folder / "ann", ("--name", "ann", "--kind", "ar", "--edge", address)
    agent = Child(tmp_path / "ann.log", "agent", str(plain_session / "ar1"), *who, "--out", str(out))
    patch.undo()
    edge.wait_for("agent joined")
    disk.hangs()
    edge.wait_for("left: ann: sent bye")
    with urllib.request.urlopen(f"{page}snapshot.json", timeout=5) as answer:
        reported = json.load(answer)["agents"]["ann"]
    if not lasting:
        disk.is_well()
    code = agent.wait(ENDS_S)
    disk.is_well()
    edge.kill()
    assert "Traceback" not in agent.said
    assert reported["poses"] > 30
    if lasting:
        assert code == 1
        assert agent.said.endswith("ann: is not complete: its disk does not answer\n")
    else:
        assert code == 0
        assert len((out / "odom.tum").read_text().splitlines()) == 45
