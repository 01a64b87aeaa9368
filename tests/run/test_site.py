"""`share site` as a process, with the real kitchen: who begins in a wrong room is found in the right one."""

from __future__ import annotations

import json
import sqlite3
import urllib.request
from importlib.util import find_spec
from pathlib import Path

import pytest
from click.testing import CliRunner
from helpers.children import Child, start_agent

from share.cli.main import cli
from share.errors import UsageError
from share.metrics.ate import ate
from share.recordings.trajectory import read_tum

ROOMS = """
rooms:
  hall: {map: hall.sqlite, agents: [bob]}
  kitchen: {map: kitchen.sqlite}
"""


def stored_keyframes(path: Path, name: str) -> list[int]:
    with sqlite3.connect(path) as db:
        rows = db.execute("SELECT id FROM keyframe WHERE run LIKE ? ORDER BY id", (f"{name}-%",))
        return [id for (id,) in rows]


@pytest.mark.long
def test_an_agent_is_found_in_its_room(shared_data, tmp_path):
    kitchen = shared_data / "real" / "redkitchen_0000_0499"
    (tmp_path / "rooms.yaml").write_text(ROOMS)
    out = tmp_path / "site"
    arguments = "--rooms", str(tmp_path / "rooms.yaml"), "--bind", "tcp://127.0.0.1:0", "--out", str(out)
    site = Child(tmp_path / "site.log", "site", *arguments)
    address = site.wait_for(r"listening on (tcp://\S+?),", 60)[1]
    assert start_agent(tmp_path, "ann", kitchen, address, "--frames", "0:250").wait(120) == 0
    bob = start_agent(tmp_path, "bob", kitchen, address, "--frames", "200:500")
    assert bob.wait(120) == 0
    assert site.interrupt() == 0

    changes = [
        (event["room"], event["agent"])
        for event in map(json.loads, (out / "events.jsonl").read_text().splitlines())
        if event["event"] == "room changed"
    ]
    assert changes == [("hall", "bob"), ("kitchen", "bob")]
    report = json.loads((out / "edge.json").read_text())
    assert {name: agent["room"] for name, agent in report["agents"].items()} == {
        "ann": "kitchen",
        "bob": "kitchen",
    }
    assert report["internal_errors"] == report["failed_steps"] == 0

    sent = json.loads((tmp_path / "bob" / "report.json").read_text())["sent"]
    in_hall, in_kitchen = (
        stored_keyframes(tmp_path / f"{room}.sqlite", "bob") for room in ("hall", "kitchen")
    )
    assert in_hall + in_kitchen == list(range(sent))  # each in one room, none lost
    assert len(in_hall) < len(in_kitchen)
    assert "restarted" not in bob.said
    assert "reconnected" not in bob.said

    truth = read_tum(kitchen / "groundtruth.txt")
    error = ate(read_tum(tmp_path / "bob" / "map.tum"), truth)
    print(f"bob changed after {len(in_hall)} of {sent} keyframes; ATE {100 * error.rmse:.2f} cm in the map")


def test_what_is_wrong_with_a_rooms_file_is_a_line(tmp_path):
    (tmp_path / "rooms.yaml").write_text("rooms: {lab: {map: a.sqlite}, hall: {map: a.sqlite}}\n")
    site = Child(tmp_path / "log", "site", "--rooms", str(tmp_path / "rooms.yaml"))
    assert site.wait(30) == 2
    assert site.said.count("\n") == 1
    assert "have the same map; give each its own" in site.said
    assert not (tmp_path / "a.sqlite").exists()


@pytest.mark.parametrize(
    ("views", "line"),
    [
        (["8081"], "--view 8081: give ROOM=PORT or ROOM=HOST:PORT"),
        (["attic=8081"], "--view attic=8081: there is no room 'attic'; there are hall, kitchen"),
        (["hall=8081", "hall=8082"], "--view hall=8082: room 'hall' is shown already; give it once"),
        (["hall=8081", "kitchen=8081"], "--view hall and --view kitchen name the same port 8081"),
        (["hall=a b:1"], "--view hall 'a b:1' is not an address to serve at"),
    ],
)
def test_a_view_that_cannot_be_is_a_line(tmp_path, views, line):
    (tmp_path / "rooms.yaml").write_text(ROOMS)
    options = [part for view in views for part in ("--view", view)]
    result = CliRunner().invoke(cli, ["site", "--rooms", str(tmp_path / "rooms.yaml"), *options])
    assert isinstance(result.exception, UsageError)
    assert line in str(result.exception)


@pytest.mark.skipif(find_spec("viser") is None, reason="viser is not installed")
def test_a_room_is_shown_live(tmp_path):
    (tmp_path / "rooms.yaml").write_text(ROOMS)
    arguments = "--rooms", str(tmp_path / "rooms.yaml"), "--bind", "tcp://127.0.0.1:0", "--http", "0"
    site = Child(tmp_path / "site.log", "site", *arguments, "--view", "kitchen=0")
    page = site.wait_for(r"status at (http://\S+/)", 60)[1]
    live = site.wait_for(r"live room of 'kitchen' at http://(\S+)/", 60)[1]
    rooms = json.loads(urllib.request.urlopen(f"{page}snapshot.json").read())["rooms"]
    assert {name: room.get("live_room") for name, room in rooms.items()} == {"hall": None, "kitchen": live}
    assert b"viser" in urllib.request.urlopen(f"http://{live}/").read().lower()
    assert site.interrupt() == 0


def test_no_room_is_served_if_one_cannot_be(tmp_path):
    (tmp_path / "notes.txt").write_text("no map")
    (tmp_path / "rooms.yaml").write_text("rooms: {lab: {map: a.sqlite}, hall: {map: notes.txt}}\n")
    site = Child(
        tmp_path / "log", "site", "--rooms", str(tmp_path / "rooms.yaml"), "--bind", "tcp://127.0.0.1:0"
    )
    assert site.wait(30) == 2
    assert "notes.txt" in site.said.splitlines()[-1]
    assert (tmp_path / "notes.txt").read_text() == "no map"
