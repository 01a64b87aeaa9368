"""Only changes in the map file are acknowledged, however the disk fails; pending ones are bounded."""

import threading
import time
from collections import deque

import numpy as np
import pytest

from share.errors import ShareError, StoreError
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import RemoveLoops, SavePoses
from share.protocol.edge_events import ChangesSaved, SaveChanges
from share.runtime import map_writer
from share.runtime.map_writer import MapWriter, newest_poses_only

FULL = "/room.sqlite: the map cannot be written: No space left on device"


def change(number):
    return RemoveLoops(KeyframeKey("ann", number), KeyframeKey("ann", number + 1))


def poses(number):
    return SavePoses((KeyframeKey("ann", number),), np.eye(4)[None], ("ann/0",))


class Disk:
    """A store whose `write` raises what it is told to."""

    problems = ()

    def __init__(self):
        self.rows, self.error, self.tries, self.closed = [], None, 0, False
        self.go_on = threading.Event()
        self.go_on.set()

    def write(self, news):
        self.tries += 1
        self.go_on.wait()
        if self.error is not None:
            raise self.error
        if any(one == "poison" for one in news):
            raise OverflowError("int too large")
        self.rows += news

    def close(self):
        self.closed = True

    def abandon(self):
        self.abandoned = True


@pytest.fixture
def opened(monkeypatch):
    monkeypatch.setattr(map_writer, "_RETRY_S", 0.02)
    disk, tickets, messages = Disk(), [], []
    writer = MapWriter(disk, lambda done: tickets.append(done), messages.append)
    yield writer, disk, tickets, messages
    disk.go_on.set()
    writer.close()


def until(condition):
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_written_changes_are_acknowledged(opened):
    writer, disk, tickets, messages = opened
    for n in range(200):
        writer.submit(SaveChanges(n, (change(n),)))
    until(lambda: tickets and tickets[-1] == ChangesSaved(199))
    assert disk.rows == [change(n) for n in range(200)]
    assert (messages, writer.trouble) == ([], None)


@pytest.mark.parametrize("reason", [FULL, FULL.replace("No space left on device", "disk I/O error")])
def test_unwritten_changes_are_not_acknowledged(opened, reason):
    writer, disk, tickets, messages = opened
    writer.submit(SaveChanges(0, (change(0),)))
    until(lambda: tickets == [ChangesSaved(0)])
    disk.error = StoreError(reason)
    for n in range(1, 40):
        writer.submit(SaveChanges(n, (change(n),)))
    tries = disk.tries
    until(lambda: disk.tries > tries + 5)
    assert tickets == [ChangesSaved(0)]
    assert disk.rows == [change(0)]
    assert messages == [f"{reason}; keyframes are not acknowledged until a write succeeds"]
    assert writer.trouble == f"{reason}; keyframes are not acknowledged"
    disk.error = None
    until(lambda: tickets[-1] == ChangesSaved(39))
    assert disk.rows == [change(n) for n in range(40)]  # in order, each once
    assert messages[1:] == ["the map is saved again"]
    assert writer.trouble is None


def test_another_reason_is_reported(opened):
    writer, disk, tickets, messages = opened
    for reason, kind in (("full", StoreError), ("broken", StoreError), ("a repair fails", ShareError)):
        disk.error = kind(reason)
        writer.submit(SaveChanges(0, (change(0),)))
        until(lambda reason=reason: messages and messages[-1].startswith(reason))
    assert len(messages) == 3
    assert not tickets


def test_a_disk_that_does_not_answer_is_reported(opened, monkeypatch):
    writer, disk, tickets, _ = opened
    monkeypatch.setattr(map_writer, "_SLOW_WRITE_S", 0.05)
    disk.go_on.clear()
    writer.submit(SaveChanges(0, (change(0),)))
    until(lambda: writer.trouble is not None)
    assert "has taken" in writer.trouble
    assert "not acknowledged" in writer.trouble
    assert not tickets
    disk.go_on.set()
    until(lambda: tickets == [ChangesSaved(0)])
    assert writer.trouble is None


def test_a_faulty_change_is_skipped(opened):
    writer, disk, tickets, messages = opened
    disk.go_on.clear()
    for n in range(5):
        writer.submit(SaveChanges(n, (change(n) if n != 2 else "poison",)))
    disk.go_on.set()
    until(lambda: tickets and tickets[-1] == ChangesSaved(4))
    assert disk.rows == [change(n) for n in (0, 1, 3, 4)]
    assert messages == ["a change cannot be saved and is skipped: OverflowError: int too large"]


def test_of_pending_solutions_only_the_newest_is_kept(opened):
    writer, disk, tickets, _ = opened
    disk.error = StoreError(FULL)
    for n in range(500):
        writer.submit(SaveChanges(n, (poses(n),)))
    until(lambda: disk.tries > 3 and writer.pending_changes == 1)
    disk.error = None
    until(lambda: tickets and tickets[-1] == ChangesSaved(499))
    assert [p.keys[0].id for p in disk.rows] == [499]


def test_the_newest_solution_stays_in_its_place():
    held = deque(
        [
            SaveChanges(0, (poses(0), change(0))),
            SaveChanges(1, (poses(1), change(1))),
            SaveChanges(2, (change(2),)),
        ]
    )
    out = newest_poses_only(held)
    assert [keep.ticket for keep in out] == [0, 1, 2]
    assert [keep.changes for keep in out] == [(change(0),), held[1].changes, (change(2),)]


def test_unsaved_changes_are_reported_at_the_end(opened):
    writer, disk, tickets, messages = opened
    disk.error = StoreError(FULL)
    writer.submit(SaveChanges(0, (change(0), change(1))))
    assert writer.close() == f"{FULL}: 2 changes are not in the map file"
    assert disk.closed
    assert not tickets
    assert messages[-1] == "2 changes are not in the map file; none of their keyframes was acknowledged"


def test_close_does_not_wait_for_a_disk_that_does_not_answer(opened):
    writer, disk, tickets, _ = opened
    disk.go_on.clear()
    writer.submit(SaveChanges(0, (change(0),)))
    until(lambda: disk.tries)
    assert not writer.drain(0.05)
    assert "the disk of the map file does not answer" in writer.close(timeout_s=0.05)
    assert disk.abandoned
    assert not disk.closed  # which would wait for the write
    assert not tickets
    disk.go_on.set()
    until(lambda: tickets == [ChangesSaved(0)])  # it was written after all
    assert writer.drain(1.0)
