"""`share edge` without something that it needs: one line, and nothing is left behind."""

from __future__ import annotations

import json
import multiprocessing
import socket
import time
import urllib.request
from contextlib import closing

import pytest
from helpers.children import Child
from helpers.map_changes import small_map

from share.config import Config
from share.net.transport import bind
from share.runtime.edge import EdgeRun
from share.store.map_store import MapStore
from share.store.schema import PAGE_BYTES


def test_a_busy_status_port_ends_it_with_one_line(tmp_path):
    with closing(socket.create_server(("127.0.0.1", 0))) as other:
        port = other.getsockname()[1]
        child = Child(tmp_path / "edge.log", "edge", "--bind", "tcp://127.0.0.1:0", "--http", str(port))
        assert child.wait(20) == 1
    said = child.said.splitlines()
    assert said[-1].startswith(f"share: tcp://127.0.0.1:{port}: the port is in use") and len(said) <= 2


@pytest.mark.long
def test_a_busy_port_releases_the_map(tmp_path):
    """Another edge can have it at once."""
    at_map = ("--map", str(tmp_path / "room.sqlite"), "--bind", "tcp://127.0.0.1:0")
    with closing(socket.create_server(("127.0.0.1", 0))) as other:
        port = str(other.getsockname()[1])
        child = Child(tmp_path / "first.log", "edge", *at_map, "--http", port)
        assert child.wait(20) == 1
    again = Child(tmp_path / "again.log", "edge", *at_map)
    again.wait_for("listening on")
    assert again.interrupt() == 0
    assert "in use" not in again.said


@pytest.mark.long
def test_a_map_that_is_set_aside_at_the_start_is_said_until_it_is_moved_away(tmp_path):
    path = tmp_path / "room.sqlite"
    with MapStore.open(path) as store:
        store.write(small_map())
    content = bytearray(path.read_bytes())
    content[3 * PAGE_BYTES : 5 * PAGE_BYTES] = bytes(2 * PAGE_BYTES)
    path.write_bytes(content)
    kept = path.with_name("room.sqlite.damaged-1")
    for number, expected in enumerate(("degraded", "degraded", "ok")):
        child = Child(
            tmp_path / f"{number}.log",
            *("edge", "--bind", "tcp://127.0.0.1:0", "--http", "127.0.0.1:0", "--map", str(path)),
        )
        page = child.wait_for(r"status at (http://\S+)")[1]
        health = health_of_a_running(f"{page}health")
        assert (health["status"], health["trouble"]) == (expected, [])
        assert any(kept.name in line for line in health["degraded"]) == (expected == "degraded")
        assert child.interrupt() == 0
        if number == 1:
            kept.unlink()


def health_of_a_running(address):
    """Return /health once the edge has reported: before, it knows no agents."""
    deadline = time.monotonic() + 20
    while True:
        with urllib.request.urlopen(address, timeout=10) as answer:
            health = json.load(answer)
        if "waiting" in health:
            return health
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize("http", ["nowhere", "192.0.2.1:8080"])
def test_an_address_that_cannot_be_served_on(http, tmp_path):
    child = Child(tmp_path / "edge.log", "edge", "--bind", "tcp://127.0.0.1:0", "--http", http)
    assert child.wait(20) in (1, 2)
    assert child.said.splitlines()[-1].startswith("share: ") and "Traceback" not in child.said


@pytest.mark.long
def test_close_without_run_ends_all_processes():
    before = set(multiprocessing.active_children())
    run = EdgeRun(Config(), bind("tcp://127.0.0.1:0"), None, lambda event: None)
    assert len(set(multiprocessing.active_children()) - before) == 1
    run.close()
    run.close()
    assert set(multiprocessing.active_children()) == before
