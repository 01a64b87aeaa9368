"""`share edge --map` on a map that an edge of wire version 4 wrote, with what ended mappers in it."""

from __future__ import annotations

import contextlib
import os
import signal
import sqlite3
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest
from helpers.children import Child, start_agent
from helpers.recorded_traffic import map_file
from test_edge_killed import _workers, until

from share.mapping.loops import KeyframeKey
from share.store import rows
from share.store.map_store import MapStore

pytestmark = pytest.mark.slow
POISONED = KeyframeKey("ann-0fb6", 3)


def poison(path: Path) -> None:
    """What that edge kept of an agent that said that it is 1.7e308 m away: finite and rigid, so believed."""
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as db:
        where = "FROM keyframe WHERE run = ? AND id = ?"
        columns = f"number, {', '.join(rows.COLUMNS['keyframe'])}"
        number, *row = db.execute(f"SELECT {columns} {where}", POISONED).fetchone()
        frames = msgspec.msgpack.decode(row[-1])
        for part in (1, 3):  # T_odom_body, T_ref_body or what is in their places
            T = np.frombuffer(frames[part], np.float64).copy()
            T[3] = 1.7e308
            frames[part] = T.tobytes()
        row[-1] = msgspec.msgpack.encode(frames)
        db.execute(f"DELETE {where}", POISONED)
        rows.insert(db, "keyframe", tuple(row), number)


def edge(folder: Path, path: Path) -> tuple[Child, str]:
    out = ("--out", str(folder / "edge"))
    child = Child(folder / "edge.log", "edge", "--bind", "tcp://127.0.0.1:0", "--map", str(path), *out)
    return child, child.wait_for(r"listening on (tcp://\S+?),")[1]


def test_an_absurd_pose_costs_its_keyframe(tmp_path: Path, plain_session: Path) -> None:
    path = map_file(4, tmp_path)
    poison(path)
    child, address = edge(tmp_path, path)
    assert f"map {path}: 1 keyframes could not be read\n" in child.said
    assert f"map {path}: 15 keyframes of 2 runs" in child.said
    agent = start_agent(tmp_path, "eve", plain_session / "ar1", address)
    assert agent.wait(60) == 0
    assert child.interrupt() == 0
    assert "mapper died" not in child.said
    with MapStore.read(path) as store:
        keys = [found.keyframe_key for found in store.load().keyframes]
    assert len([key for key in keys if not key.agent.startswith("eve")]) == 15
    assert len(keys) > 15


def test_a_map_that_three_mappers_die_of_is_set_aside(tmp_path: Path, plain_session: Path) -> None:
    """Whatever it is of that they die while they take it in."""
    path = map_file(4, tmp_path)
    child, address = edge(tmp_path, path)
    killed: set[int] = set()

    def aside() -> bool:
        for pid in _workers(child.process.pid):
            if pid not in killed and len(killed) < 3:
                killed.add(pid)
                os.kill(pid, signal.SIGKILL)
        return "the map file is renamed to" in child.said

    until("renamed to", aside, 60)
    why = "3 mappers in a row have died while restoring it; a new one is started"
    assert f"the map file is renamed to {path.name}.damaged-1: {why}" in child.said
    assert child.said.count("mapper died: its process was ended by SIGKILL; restarted in") == 3
    agent = start_agent(tmp_path, "eve", plain_session / "ar1", address)
    assert agent.wait(60) == 0
    time.sleep(0.2)
    assert child.interrupt() == 0
    for file, people in ((path, {"eve"}), (path.with_name(f"{path.name}.damaged-1"), {"ann", "rob"})):
        with MapStore.read(file) as store:
            kept = store.load()
        assert {run.hello.name for run in kept.runs} == people
        assert kept.keyframes
        assert kept.problems == ()
