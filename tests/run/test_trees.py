"""A process that starts others may be killed at any moment: two seconds later none of them is left."""

from __future__ import annotations

import os
import random
import signal
import sys
import time
from pathlib import Path

import pytest
from helpers.children import SHARE
from helpers.trees import Tree

GONE_S = 2.0
IN_ORDER_S = 20.0  # to write files, and for agents to say bye

# What `share demo` does, without a room: an edge with its mapper and solver.
OF_A_PARENT = """
import sys, time
from pathlib import Path
from share.lab.evaluate.real_time import running_child
log = Path(sys.argv[1]) / "edge.log"
with running_child(log, "edge", "--bind", "tcp://127.0.0.1:0", "--out", sys.argv[1]):
    time.sleep(600)
"""
OF_A_THREAD = """
import sys, threading, time
from pathlib import Path
from share.lab.evaluate.real_time import running_child
def start():
    held.append(running_child(Path(sys.argv[1]) / "edge.log", "edge", "--bind", "tcp://127.0.0.1:0"))
    held[0].__enter__()
held = []
thread = threading.Thread(target=start)
thread.start()
thread.join()
time.sleep(600)
"""


def edge(folder: Path) -> list[str]:
    return [
        *SHARE,
        "edge",
        "--bind",
        "tcp://127.0.0.1:0",
        "--out",
        str(folder),
        "--map",
        str(folder / "m.sqlite"),
    ]


def parent(folder: Path) -> list[str]:
    return [sys.executable, "-c", OF_A_PARENT, str(folder)]


def thread(folder: Path) -> list[str]:
    return [sys.executable, "-c", OF_A_THREAD, str(folder)]


def emulate(folder: Path) -> list[str]:
    out = str(folder / "session")
    return [*SHARE, "emulate", "--scene", "plain", "--motion", "a=walk:", "--seconds", "60", "--out", out]


def demo(folder: Path) -> list[str]:
    return [*SHARE, "demo", "--scene", "plain", "--seconds", "3", "--seed", "18", "--out", str(folder)]


KINDS = {"edge": edge, "parent": parent, "thread": thread, "emulate": emulate, "demo": demo}
QUICK = [("edge", 0.3), ("edge", 0.8), ("parent", 0.5), ("parent", 1.5), ("thread", 1.5), ("emulate", 2.0)]


@pytest.mark.long
@pytest.mark.parametrize(("kind", "after_s"), QUICK)
def test_killed(tmp_path, kind, after_s):
    tree = Tree(KINDS[kind](tmp_path), tmp_path / "log")
    time.sleep(after_s)
    tree.parent.kill()
    assert tree.left(GONE_S) == {}


@pytest.mark.parametrize("kind", ["parent", "thread"])
def test_killed_when_all_are_there(tmp_path, kind):
    tree = Tree(KINDS[kind](tmp_path), tmp_path / "log")
    tree.until(4)  # parent, edge, mapper, solver
    tree.parent.kill()
    assert tree.left(GONE_S) == {}


@pytest.mark.long
def test_a_thread_that_has_ended_is_no_parent_that_has_died(tmp_path):
    tree = Tree(thread(tmp_path), tmp_path / "log")
    tree.until(4)
    time.sleep(1.0)
    assert len(tree.alive()) >= 4
    tree.parent.kill()
    assert tree.left(GONE_S) == {}


@pytest.mark.long
def test_grandchildren_follow(tmp_path):
    """The mapper's death is not the edge's, but the solver's."""
    tree = Tree(edge(tmp_path), tmp_path / "log")
    tree.until(3)
    mapper = _worker(tree.parent.pid)
    solver = _worker(mapper)
    os.kill(mapper, signal.SIGKILL)
    deadline = time.monotonic() + IN_ORDER_S  # it may be importing still
    while _runs(solver):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert tree.parent.poll() is None
    tree.parent.kill()
    assert tree.left(GONE_S) == {}


def _worker(pid: int) -> int:
    """Return the process that `pid` has spawned, once there is one. Right after a fork it has no command line
    yet."""
    deadline = time.monotonic() + 60
    while True:
        of_threads = Path(f"/proc/{pid}/task").glob("*/children")
        children = [child for file in of_threads for child in file.read_text().split()]
        for child in children:
            if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                return int(child)
        assert time.monotonic() < deadline


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.long
@pytest.mark.parametrize(
    ("number", "whom"),
    [
        (signal.SIGHUP, "parent alone"),
        (signal.SIGHUP, "all"),
        (signal.SIGTERM, "all"),
        (signal.SIGINT, "all"),
    ],
)
def test_a_signal_ends_all_in_good_order(tmp_path, number, whom):
    """Files are written, and nothing is said of it by Python."""
    tree = Tree(
        [*SHARE, "edge", "--bind", "tcp://127.0.0.1:0", "--out", str(tmp_path / "out")], tmp_path / "log"
    )
    tree.until(4)
    while "listening" not in tree.log.read_text():
        time.sleep(0.02)
    if whom == "all":  # a terminal, or systemd
        os.killpg(tree.parent.pid, number)
    else:
        tree.parent.send_signal(number)
    assert tree.left(IN_ORDER_S) == {}
    assert tree.parent.returncode == 0
    assert (tmp_path / "out" / "edge.json").exists()
    assert "mapper died" not in (tmp_path / "out" / "events.jsonl").read_text()
    assert "Traceback" not in tree.log.read_text()


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGHUP, signal.SIGTERM])
def test_at_fifty_random_moments(tmp_path, monkeypatch, plain_cache, kind, number):
    """What is killed leaves nothing; what is asked to end ends, with no word of Python's."""
    draw = random.Random(f"{kind} {number}")
    monkeypatch.setenv("XDG_CACHE_HOME", str(plain_cache))  # the demo's session
    python = kind in ("parent", "thread")  # scripts of ours do not handle signals
    for i in range(50):
        folder = tmp_path / str(i)
        folder.mkdir()
        tree = Tree(KINDS[kind](folder), folder / "log")
        time.sleep(draw.uniform(0.0, 4.0))
        tree.parent.send_signal(number)
        left = tree.left(GONE_S if number == signal.SIGKILL or python else IN_ORDER_S)
        assert left == {}, (i, folder, tree.log.read_text())
        assert "Traceback" not in tree.log.read_text()
