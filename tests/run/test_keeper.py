"""What is not in the map's file is not acknowledged, however the disk fails; what waits is bounded."""

import threading
import time
from collections import deque

import numpy as np
import pytest

from share.errors import StoreError
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import RemoveLoops, SavePoses
from share.protocol.edge_events import ChangesSaved, SaveChanges
from share.runtime import map_writer as keeper_module
from share.runtime.map_writer import MapWriter, newest_poses_only

FULL = "/room.sqlite: the map cannot be written: No space left on device"


def change(number):
    return RemoveLoops(KeyframeKey("ann", number), KeyframeKey("ann", number + 1))


def poses(number):
    return SavePoses((KeyframeKey("ann", number),), np.eye(4)[None], ("ann/0",))


class Disk:
    """A store whose `write` raises what it is told to."""

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
def kept(monkeypatch):
    monkeypatch.setattr(keeper_module, "_RETRY_S", 0.02)
    disk, tickets, said = Disk(), [], []
    keeper = MapWriter(disk, lambda done: tickets.append(done), said.append)
    yield keeper, disk, tickets, said
    disk.go_on.set()
    keeper.close()


def until(condition):
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_what_is_written_is_kept(kept):
    keeper, disk, tickets, said = kept
    for n in range(200):
        keeper.submit(SaveChanges(n, (change(n),)))
    until(lambda: tickets and tickets[-1] == ChangesSaved(199))
    assert disk.rows == [change(n) for n in range(200)]
    assert (said, keeper.trouble) == ([], None)


@pytest.mark.parametrize("reason", [FULL, FULL.replace("No space left on device", "disk I/O error")])
def test_what_is_not_on_the_disk_is_not_kept(kept, reason):
    keeper, disk, tickets, said = kept
    keeper.submit(SaveChanges(0, (change(0),)))
    until(lambda: tickets == [ChangesSaved(0)])
    disk.error = StoreError(reason)
    for n in range(1, 40):
        keeper.submit(SaveChanges(n, (change(n),)))
    tries = disk.tries
    until(lambda: disk.tries > tries + 5)
    assert tickets == [ChangesSaved(0)]
    assert disk.rows == [change(0)]
    assert said == [f"{reason}; keyframes are not acknowledged until a write succeeds"]
    assert keeper.trouble == f"{reason}; keyframes are not acknowledged"
    disk.error = None
    until(lambda: tickets[-1] == ChangesSaved(39))
    assert disk.rows == [change(n) for n in range(40)]  # in order, each once
    assert said[1:] == ["the map is saved again"]
    assert keeper.trouble is None


def test_another_reason_is_said(kept):
    keeper, disk, _, said = kept
    for reason in ("full", "broken"):
        disk.error = StoreError(reason)
        keeper.submit(SaveChanges(0, (change(0),)))
        until(lambda reason=reason: said and said[-1].startswith(reason))
    assert len(said) == 2


def test_a_disk_that_does_not_answer_is_said(kept, monkeypatch):
    keeper, disk, tickets, _ = kept
    monkeypatch.setattr(keeper_module, "_SLOW_WRITE_S", 0.05)
    disk.go_on.clear()
    keeper.submit(SaveChanges(0, (change(0),)))
    until(lambda: keeper.trouble is not None)
    assert "has taken" in keeper.trouble
    assert "not acknowledged" in keeper.trouble
    assert not tickets
    disk.go_on.set()
    until(lambda: tickets == [ChangesSaved(0)])
    assert keeper.trouble is None


def test_a_change_that_cannot_be_kept_costs_itself(kept):
    keeper, disk, tickets, said = kept
    disk.go_on.clear()
    for n in range(5):
        keeper.submit(SaveChanges(n, (change(n) if n != 2 else "poison",)))
    disk.go_on.set()
    until(lambda: tickets and tickets[-1] == ChangesSaved(4))
    assert disk.rows == [change(n) for n in (0, 1, 3, 4)]
    assert said == ["a change cannot be saved and is skipped: OverflowError: int too large"]


def test_solutions_do_not_pile_up(kept):
    keeper, disk, tickets, _ = kept
    disk.error = StoreError(FULL)
    for n in range(500):
        keeper.submit(SaveChanges(n, (poses(n),)))
    until(lambda: disk.tries > 3 and keeper.pending_changes == 1)
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


def test_what_is_left_at_the_end_is_said(kept):
    keeper, disk, tickets, said = kept
    disk.error = StoreError(FULL)
    keeper.submit(SaveChanges(0, (change(0), change(1))))
    assert keeper.close() == f"{FULL}: 2 changes are not in the map file"
    assert disk.closed
    assert not tickets
    assert said[-1] == "2 changes are not in the map file; none of their keyframes was acknowledged"


def test_who_ends_does_not_wait_for_a_disk_that_does_not_answer(kept, monkeypatch):
    keeper, disk, tickets, _ = kept
    monkeypatch.setattr(keeper_module, "_TIMEOUT_S", 0.05)
    disk.go_on.clear()
    keeper.submit(SaveChanges(0, (change(0),)))
    until(lambda: disk.tries)
    assert not keeper.drain(0.05)
    assert "the disk of the map file does not answer" in keeper.close()
    assert disk.abandoned
    assert not disk.closed  # which would wait for the write
    assert not tickets
    disk.go_on.set()
    until(lambda: tickets == [ChangesSaved(0)])  # it was written after all
    assert keeper.drain(1.0)
