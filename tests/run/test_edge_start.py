"""`share edge` without something that it needs: one line, and nothing is left behind."""

from __future__ import annotations

import multiprocessing
import socket
from contextlib import closing

import pytest
from helpers.children import Child

from share.config import Config
from share.net.transport import bind
from share.runtime.edge import EdgeRun


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
