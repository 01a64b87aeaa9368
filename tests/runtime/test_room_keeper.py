"""A room of a site that sleeps while nobody is in it."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import pytest
from helpers.hellos import hello_of
from helpers.map_changes import small_map
from helpers.map_files import is_locked

from share.config import Config
from share.errors import ShareError, StoreError
from share.mapping.loops import KeyframeKey
from share.mapping.places import FindKeyframe
from share.protocol.edge import EdgeProtocol
from share.protocol.edge_events import EdgeEvent, PeerMessageReceived
from share.protocol.edge_records import SessionTotals
from share.runtime import room_jobs, room_keeper
from share.runtime.room_keeper import RoomKeeper, RoomStart
from share.store import database
from share.store.map_store import MapStore
from share.store.schema import PAGE_BYTES
from share.wire import codec
from share.wire.codec import decode, encode
from share.wire.messages import NO_SESSION, Bye, Ping, Pong, peer_id
from share.wire.room_messages import ClientHello

ANN, BOB = hello_of("ann", 1), hello_of("bob", 2)


@dataclass
class FakeRoom:
    """Stands for a `ServedRoom` and its processes."""

    store: MapStore | None
    is_unchanged: bool
    is_idle: bool = True
    is_unused: bool = False
    is_ended: bool = False
    loss: str | None = None
    handled: list[EdgeEvent] = field(default_factory=list)
    sought: list[FindKeyframe] = field(default_factory=list)
    threads: dict[str, int] = field(default_factory=dict)  # in which each part of the end ran
    evaluations: dict[str, Any] = field(default_factory=dict)
    reason: str | None = None

    def __post_init__(self) -> None:
        self.protocol = EdgeProtocol(Config(), 1)

    def handle(self, event: EdgeEvent) -> None:
        self.handled.append(event)
        self.protocol.handle(event, time.monotonic_ns())

    def find(self, request: FindKeyframe) -> None:
        self.sought.append(request)

    def step(self) -> None:
        assert not self.is_ended

    def stop(self) -> None:
        pass

    def report(self) -> dict[str, Any]:
        agents = {"ann": {"gone": True, "last_received_s": 60.0, "pose_age_ms": None}}
        lines = {"trouble": ["the solver: died"], "refused": ["12 messages refused"], "loading": "the map"}
        return {"maps": {"ann/0": 7}, "agents": agents, **lines}

    def may_have_map(self, map_id: str) -> bool:
        return False

    def series(self) -> dict[str, Any]:
        return self.evaluations

    def end_totals(self) -> SessionTotals:
        return SessionTotals()

    def _note(self, part: str) -> None:
        self.threads[part] = threading.get_ident()

    def end_processes(self) -> None:
        self._note("end_processes")
        self.is_ended = True

    def handle_answers(self) -> None:
        self._note("handle_answers")

    def close_file(self, timeout_s: float | None = None) -> str | None:
        self._note("close_file")
        if self.store is not None:
            self.store.close()
        return None

    def finish(self, incomplete_reason: str | None) -> None:
        self._note("finish")
        self.reason = incomplete_reason

    def close(self) -> str | None:
        self.end_processes()
        return self.close_file()


class Bench:
    """A keeper of fake rooms, over a real map file."""

    def __init__(
        self,
        store: MapStore | None,
        idle_s: float = 0.0,
        keep_s: float | None = None,
        begins_asleep: bool = False,
    ) -> None:
        self.rooms: list[FakeRoom] = []
        self.lines: list[str] = []
        self.sent: list[tuple[bytes, Any]] = []
        self.is_failing = False
        self.woken = threading.Event()
        self.wake = self.woken.set
        self.keeper = RoomKeeper(store, self._serve, self, idle_s, keep_s, begins_asleep)

    def send(self, peer_id: bytes, frames: Any) -> None:
        self.sent.append((peer_id, frames))

    def log_event(self, event: str, reason: str) -> None:
        self.lines.append(reason)

    def _serve(self, start: RoomStart) -> Any:
        if self.is_failing:
            raise StoreError("it cannot be read")
        self.rooms.append(FakeRoom(start.store, start.is_unchanged, is_unused=start.is_unused))
        return self.rooms[-1]

    def step_until(self, is_awake: bool) -> None:
        deadline = time.monotonic() + 20.0
        while self.is_awake is not is_awake:
            assert time.monotonic() < deadline
            self.woken.wait(0.01)
            self.woken.clear()
            self.keeper.step()

    @property
    def is_awake(self) -> bool | None:
        """None: in between."""
        if self.keeper.room is not None:
            return True
        return None if self.keeper._is_changing else False


@pytest.fixture
def bench(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(room_keeper, "_REPEATED_S", 60.0)  # however slow the machine is
    bench = Bench(MapStore.open(tmp_path / "room.sqlite"))
    yield bench
    bench.keeper.close()


def hello(of=ANN) -> PeerMessageReceived:
    return PeerMessageReceived(peer_id(of.run_id), [bytes(f) for f in encode(of)])


def ping(of=ANN) -> PeerMessageReceived:
    return PeerMessageReceived(peer_id(of.run_id), [bytes(f) for f in encode(Ping(1, 1))])


def request() -> FindKeyframe:
    return FindKeyframe(KeyframeKey("ann", 1), None, ANN.rig)  # type: ignore[arg-type]


def test_an_empty_room_closes_its_map_file_and_opens_it_for_a_hello(bench, tmp_path):
    path = tmp_path / "room.sqlite"
    assert is_locked(path)
    bench.step_until(is_awake=False)
    assert not is_locked(path)
    assert bench.rooms[0].is_ended

    bench.keeper.handle(hello())
    bench.step_until(is_awake=True)
    assert is_locked(path)
    first, second = bench.rooms
    assert [event.peer_id for event in second.handled] == [peer_id(ANN.run_id)]
    assert second.is_unchanged
    assert not first.is_unchanged


def test_what_waits_for_processes_or_the_disk_runs_in_a_thread_and_the_rest_in_the_loop(bench):
    bench.step_until(is_awake=False)
    threads, loop = bench.rooms[0].threads, threading.get_ident()
    assert threads["end_processes"] != loop
    assert threads["close_file"] != loop
    assert threads["handle_answers"] == threads["finish"] == loop


def test_a_room_stays_awake_while_somebody_is_in_it_and_a_while_longer(tmp_path):
    bench = Bench(MapStore.open(tmp_path / "room.sqlite"), idle_s=3600.0)
    bench.rooms[0].is_idle = False
    for _ in range(3):
        bench.keeper.step()
    bench.rooms[0].is_idle = True
    bench.keeper.step()
    assert bench.keeper.room is bench.rooms[0]
    bench.keeper.close()


def test_a_room_without_a_writable_map_file_never_sleeps(tmp_path):
    path = tmp_path / "room.sqlite"
    MapStore.open(path).close()
    for store in (None, MapStore.read(path)):
        bench = Bench(store)
        bench.keeper.step()
        assert bench.keeper.room is bench.rooms[0]
        bench.keeper.close()


def test_a_keyframe_to_search_wakes_it(bench):
    bench.step_until(is_awake=False)
    one = request()
    bench.keeper.find(one)
    bench.step_until(is_awake=True)
    assert bench.rooms[1].sought == [one]


def test_only_a_hello_or_somebody_it_knows_wakes_it(bench):
    bench.keeper.handle(hello(ANN))
    assert bench.keeper.knows(peer_id(ANN.run_id)) == 0
    bench.step_until(is_awake=False)
    assert bench.keeper.knows(peer_id(ANN.run_id)) == 0
    assert bench.keeper.knows(peer_id(BOB.run_id)) is None

    noise = PeerMessageReceived(peer_id(BOB.run_id), [b"\xff" * 40])
    for event in (ping(BOB), noise):
        bench.keeper.handle(event)
    for _ in range(5):
        bench.keeper.step()
    assert bench.is_awake is False

    bench.keeper.handle(ping(ANN))
    bench.step_until(is_awake=True)
    assert len(bench.rooms[1].handled) == 1


def header_of(message, version=codec.WIRE_VERSION) -> bytes:
    """A header that says such a message, without anything in it."""
    _, code, *_ = msgspec.msgpack.decode(encode(message)[0])
    return msgspec.msgpack.encode([version, code, [], []])


JUNK = [bytes(64_000)] * 16


def test_what_only_claims_to_be_a_hello_is_not_kept(bench):
    """Of a room that could not open, 70 MB were."""
    bench.step_until(is_awake=False)
    for sent in (header_of(ANN), header_of(ClientHello("ann", 1))):
        bench.keeper.handle(PeerMessageReceived(peer_id(BOB.run_id), [sent, *JUNK]))
    assert not bench.keeper._messages and not bench.keeper._is_called
    bench.keeper.handle(PeerMessageReceived(peer_id(BOB.run_id), [header_of(ANN, version=1), *JUNK]))
    ((_, kept),) = bench.keeper._messages
    assert len(kept.frames) == 1  # it is to hear which side to upgrade, whatever else it sends


def test_of_one_that_it_knows_too_only_hellos_and_pings_are_kept(bench):
    bench.keeper.handle(hello(ANN))
    bench.step_until(is_awake=False)
    bench.keeper.handle(PeerMessageReceived(peer_id(ANN.run_id), [b"\xff", *JUNK]))
    bench.keeper.handle(PeerMessageReceived(peer_id(ANN.run_id), [header_of(Bye()), *JUNK]))
    assert not bench.keeper._messages
    bench.step_until(is_awake=True)


def test_what_a_sleeping_room_is_sent_in_vain_is_counted_and_said(bench, monkeypatch):
    def handle(frames: list[bytes]) -> None:
        bench.keeper.handle(PeerMessageReceived(peer_id(BOB.run_id), frames))

    before = bench.keeper.report()["unjoined"]
    bench.step_until(is_awake=False)
    for _ in range(20):
        handle([b"\xff"])
        handle([bytes(one) for one in encode(Bye())])
    handle([header_of(Ping(1, 1), version=1)])
    report = bench.keeper.report()
    (line,) = report["refused"]
    assert line.startswith("peers that have not joined: 40 messages refused, the last: a message Bye before")
    counts = {"bad_messages": 20, "unexpected": 20, "other_version": 1}
    assert (before, report["unjoined"]) == ({}, counts)
    bench.keeper.handle(hello())
    bench.step_until(is_awake=True)
    monkeypatch.setattr(FakeRoom, "report", lambda room: {"unjoined": {"bad_messages": 3}, "trouble": []})
    for _ in range(2):
        assert bench.keeper.report()["unjoined"] == {**counts, "bad_messages": 23}


def test_damage_that_is_found_when_it_wakes_up_is_said_once(bench, tmp_path):
    path = tmp_path / "room.sqlite"
    bench.rooms[0].store.write(small_map(60, 60))
    bench.step_until(is_awake=False)
    with path.open("r+b") as file:
        for page in range(6, 30, 3):
            file.seek(page * PAGE_BYTES)
            file.write(b"\xa5" * PAGE_BYTES)
    for _ in range(2):
        bench.keeper.handle(hello())
        bench.step_until(is_awake=True)
        bench.step_until(is_awake=False)
    repaired, *lost = bench.lines
    assert repaired.startswith("the file was damaged; it is kept as room.sqlite.damaged-1")
    assert any("could not be read" in line for line in lost)
    assert len(set(bench.lines)) == len(bench.lines)


def test_a_message_that_comes_while_it_falls_asleep_is_not_lost(bench):
    bench.keeper.step()
    assert bench.is_awake is None
    bench.keeper.handle(hello())
    bench.step_until(is_awake=True)
    assert [event.peer_id for event in bench.rooms[1].handled] == [peer_id(ANN.run_id)]


def test_messages_that_wait_are_bounded(bench):
    bench.step_until(is_awake=False)
    for _ in range(10_000):
        bench.keeper.handle(hello())
    bench.step_until(is_awake=True)
    assert len(bench.rooms[1].handled) == 64


def test_a_file_that_another_program_has_written_is_new(bench, tmp_path):
    bench.step_until(is_awake=False)
    with MapStore.open(tmp_path / "room.sqlite") as store:
        store.write([])
        store.compact()
    bench.keeper.handle(hello())
    bench.step_until(is_awake=True)
    assert not bench.rooms[1].is_unchanged


def test_a_file_that_another_edge_uses_is_said_once_and_opened_later(bench, tmp_path):
    bench.step_until(is_awake=False)
    other = MapStore.open(tmp_path / "room.sqlite")
    bench.keeper.handle(hello())
    deadline = time.monotonic() + 20.0
    while not bench.lines:
        assert time.monotonic() < deadline
        bench.keeper.step()
    assert bench.keeper.report()["trouble"] == [bench.lines[0].rpartition("; retried")[0]]
    other.close()
    bench.step_until(is_awake=True)
    assert len(bench.lines) == 1
    assert bench.keeper.report()["trouble"] == ["the solver: died"]


def test_a_map_that_cannot_be_read_keeps_the_room_asleep(bench, tmp_path):
    bench.step_until(is_awake=False)
    bench.is_failing = True
    bench.keeper.handle(hello())
    deadline = time.monotonic() + 20.0
    while not bench.lines:
        assert time.monotonic() < deadline
        bench.keeper.step()
    assert not is_locked(tmp_path / "room.sqlite")
    bench.is_failing = False
    bench.step_until(is_awake=True)


def test_a_sleeping_room_is_shown_as_it_was(bench):
    bench.step_until(is_awake=False)
    report = bench.keeper.report()
    assert report["asleep"] is True
    assert report["maps"] == {"ann/0": 7}
    assert "loading" not in report
    assert bench.keeper.may_have_map("ann/0")
    assert report["trouble"] == report["refused"] == []


def test_a_room_whose_report_fails_falls_asleep_and_is_shown_as_it_was(bench, monkeypatch):
    shown = bench.keeper.report()

    def fail(room):
        raise KeyError("a run")

    monkeypatch.setattr(FakeRoom, "report", fail)
    bench.step_until(is_awake=False)
    assert bench.keeper.report()["maps"] == shown["maps"]
    assert any("its last report: KeyError" in line for line in bench.lines)


def test_the_ages_of_a_sleeping_room_grow(bench):
    bench.step_until(is_awake=False)
    first = bench.keeper.report()["agents"]["ann"]
    time.sleep(0.1)
    second = bench.keeper.report()["agents"]["ann"]
    assert 60.0 <= first["last_received_s"] < second["last_received_s"] - 0.09
    assert second["pose_age_ms"] is None


def test_a_room_may_begin_asleep(tmp_path):
    path = tmp_path / "room.sqlite"
    bench = Bench(MapStore.open(path), idle_s=3600.0, begins_asleep=True)
    assert bench.rooms[0].is_unused
    bench.step_until(is_awake=False)
    assert not is_locked(path)
    bench.keeper.handle(hello())
    bench.step_until(is_awake=True)
    assert not bench.rooms[1].is_unused
    bench.keeper.step()
    assert bench.is_awake
    bench.keeper.close()


@pytest.mark.parametrize("who_comes", ["nobody", "an agent", "a search"])
def test_a_room_that_is_visited_sleeps_again_as_soon_as_it_is_idle(tmp_path, who_comes):
    bench = Bench(MapStore.open(tmp_path / "room.sqlite"), idle_s=3600.0, begins_asleep=True)
    bench.step_until(is_awake=False)
    bench.keeper.visit()
    assert bench.keeper.is_visited
    bench.step_until(is_awake=True)
    bench.rooms[1].is_idle = False
    bench.keeper.step()
    assert bench.is_awake
    assert bench.keeper.is_visited
    if who_comes == "an agent":
        bench.keeper.handle(hello())
    elif who_comes == "a search":
        bench.keeper.find(request())
    bench.keeper.step()
    bench.rooms[1].is_idle = True
    bench.keeper.step()
    assert not bench.keeper.is_visited
    assert (bench.keeper.room is None) is (who_comes == "nobody")
    bench.keeper.close()


def test_a_visit_that_waits_for_a_file_does_not_count(tmp_path):
    """Others need not wait for it."""
    bench = Bench(MapStore.open(tmp_path / "room.sqlite"), begins_asleep=True)
    bench.step_until(is_awake=False)
    bench.is_failing = True
    bench.keeper.visit()
    line_of(bench)
    assert not bench.keeper.is_visited
    bench.keeper.close()


def line_of(bench: Bench) -> str:
    """Step until a line is said, and return it."""
    deadline = time.monotonic() + 20.0
    while not bench.lines:
        assert time.monotonic() < deadline
        bench.keeper.step()
        time.sleep(0.005)
    return bench.lines[0]


def test_a_map_that_can_no_longer_be_written_keeps_the_room_asleep(bench, monkeypatch):
    """Awake it would acknowledge keyframes that no file has."""
    bench.step_until(is_awake=False)
    obstacle = "its folder cannot be written: Read-only file system"
    with monkeypatch.context() as patch:
        patch.setattr(database, "write_obstacle", lambda path: obstacle)
        bench.keeper.handle(hello())
        assert obstacle in line_of(bench)
    assert len(bench.rooms) == 1
    bench.step_until(is_awake=True)
    assert bench.rooms[1].store.writable


@pytest.mark.parametrize("is_asleep", [False, True])
def test_a_map_file_that_is_gone_is_not_made_anew(bench, tmp_path, is_asleep):
    path, away = tmp_path / "room.sqlite", tmp_path / "away"
    if is_asleep:
        bench.step_until(is_awake=False)
    path.rename(away)
    bench.step_until(is_awake=False)
    bench.keeper.handle(hello())
    assert "is gone since its room fell asleep" in line_of(bench)
    assert not path.exists()
    away.rename(path)
    bench.step_until(is_awake=True)


def test_an_unforeseen_error_while_the_file_is_opened_is_said_and_it_is_tried_again(bench, monkeypatch):
    def fails(path: Path) -> MapStore:
        raise OSError(116, "Stale file handle")

    bench.step_until(is_awake=False)
    with monkeypatch.context() as patch:
        patch.setattr(MapStore, "open", fails)
        bench.keeper.handle(hello())
        assert "Stale file handle" in line_of(bench)
    bench.step_until(is_awake=True)


def test_a_room_that_cannot_start_ends_nothing_else(bench, tmp_path):
    bench.step_until(is_awake=False)
    serve = bench.keeper._serve

    def fails(*arguments: Any) -> Any:
        raise OSError(24, "Too many open files")

    bench.keeper._serve = fails
    bench.keeper.handle(hello())
    assert "Too many open files" in line_of(bench)
    assert not is_locked(tmp_path / "room.sqlite")
    bench.keeper._serve = serve
    bench.step_until(is_awake=True)


def test_a_hello_of_another_version_wakes_it(bench):
    """Its agent is to hear which side to upgrade; a ping is a probe, and stays unanswered."""
    bench.step_until(is_awake=False)
    for of, wakes in ((Ping(1, 1), False), (ANN, True)):
        version, *rest = msgspec.msgpack.decode(encode(of)[0])
        header = msgspec.msgpack.encode((version - 1, *rest))
        bench.keeper.handle(PeerMessageReceived(peer_id(9), [header]))
        bench.keeper.step()
        assert (bench.is_awake is None) is wakes


def test_it_wakes_up_when_a_keyframe_is_too_old(tmp_path):
    """What is to be forgotten after some time is forgotten in a sleeping room too."""
    store = MapStore.open(tmp_path / "room.sqlite")
    store.write(small_map())
    bench = Bench(store, keep_s=2.0)
    bench.step_until(is_awake=False)
    began_s = time.time()
    bench.step_until(is_awake=True)
    assert time.time() > began_s + 0.5
    bench.keeper.close()


def test_a_slow_disk_does_not_lock_the_file_for_ever(bench):
    timeouts: list[float | None] = []
    close = bench.rooms[0].close_file

    def close_file(timeout_s: float | None = None) -> str | None:
        timeouts.append(timeout_s)
        return close()

    bench.rooms[0].close_file = close_file
    bench.step_until(is_awake=False)
    assert timeouts[0] is not None
    assert timeouts[0] > 3600.0


def test_it_ends_well_in_every_state(tmp_path):
    for steps in range(4):
        bench = Bench(MapStore.open(tmp_path / f"{steps}.sqlite"))
        for _ in range(steps):
            bench.keeper.step()
            time.sleep(0.02)
        if steps == 3:
            bench.keeper.handle(hello())
            bench.keeper.step()
        assert bench.keeper.close() is None
        assert not is_locked(tmp_path / f"{steps}.sqlite")


def test_a_stranger_s_ping_is_answered_by_a_sleeping_room(bench):
    """Else `share doctor` says that there is no edge, and a client that was away too long says no hello."""
    bench.step_until(is_awake=False)
    bench.keeper.handle(ping(BOB))
    bench.keeper.step()
    assert bench.is_awake is False
    ((peer, frames),) = bench.sent
    pong = decode([bytes(f) for f in frames])
    assert peer == peer_id(BOB.run_id)
    assert isinstance(pong, Pong)
    assert (pong.sequence, pong.sent_ns, pong.session) == (1, 1, NO_SESSION)


def test_who_has_gone_before_it_woke_up_does_not_come_in(bench, monkeypatch):
    """They would be present, and keep those of their names out who have started again meanwhile."""
    bench.step_until(is_awake=False)
    bench.is_failing = True
    monkeypatch.setattr(room_keeper, "_REPEATED_S", 0.2)
    bench.keeper.handle(hello(BOB))
    assert line_of(bench)
    time.sleep(0.3)
    bench.is_failing = False
    while bench.is_awake is not True:  # not more than can wait
        if not bench.keeper._messages or bench.keeper._messages[-1][0] < time.monotonic() - 0.1:
            bench.keeper.handle(hello(ANN))
        bench.keeper.step()
        time.sleep(0.005)
    assert {event.peer_id for event in bench.rooms[1].handled} == {peer_id(ANN.run_id)}


@pytest.mark.parametrize("is_waking", [False, True])
def test_a_disk_that_hangs_is_said_while_a_room_falls_asleep_or_wakes_up(bench, monkeypatch, is_waking):
    """Nobody can enter meanwhile."""
    monkeypatch.setattr(room_keeper, "_SLOW_S", 0.1)
    answers = threading.Event()
    opened, close = MapStore.open, bench.rooms[0].close_file
    if is_waking:
        bench.step_until(is_awake=False)
        monkeypatch.setattr(MapStore, "open", lambda path: answers.wait(20.0) and opened(path))
    else:
        bench.rooms[0].close_file = lambda timeout_s: answers.wait(20.0) and close(timeout_s)
        bench.keeper.step()
    bench.keeper.handle(hello())
    deadline = time.monotonic() + 20.0
    while not bench.keeper.report()["trouble"]:
        assert time.monotonic() < deadline
        bench.keeper.step()
        time.sleep(0.005)
    assert "the map file has taken 0 s so far" in bench.keeper.report()["trouble"][0]
    answers.set()
    bench.step_until(is_awake=True)
    assert bench.keeper.report()["trouble"] == ["the solver: died"]


def test_only_the_thread_looks_at_the_disk(bench, monkeypatch):
    threads, stamp_of = [], room_jobs.file_stamp
    monkeypatch.setattr(
        room_jobs, "file_stamp", lambda path: threads.append(threading.get_ident()) or stamp_of(path)
    )
    bench.step_until(is_awake=False)
    bench.keeper.handle(hello())
    bench.step_until(is_awake=True)
    assert len(threads) == 2
    assert threading.get_ident() not in threads


def test_series_of_who_does_not_come_back_are_kept(bench):
    empty = {"t_s": [], "qoe": []}
    bench.rooms[0].evaluations = {"ann": {"t_s": [1.0], "qoe": [3.0]}, "bob": {"t_s": [2.0], "qoe": [4.0]}}
    before = dict(bench.keeper.series())
    for number in (1, 2):
        bench.step_until(is_awake=False)
        assert bench.keeper.series() == before
        bench.keeper.handle(hello())
        bench.step_until(is_awake=True)
        bench.rooms[number].evaluations = {"ann": empty, "bob": empty}  # as of all runs in the file
        assert bench.keeper.series() == before
    bench.rooms[2].evaluations = {"ann": {"t_s": [9.0], "qoe": [5.0]}, "bob": empty}
    assert bench.keeper.series() == {"ann": {"t_s": [9.0], "qoe": [5.0]}, "bob": before["bob"]}


@pytest.mark.parametrize("part", ["end_processes", "close_file"])
def test_an_error_of_the_thread_does_not_keep_it_asleep_for_ever(bench, part):
    work = getattr(bench.rooms[0], part)

    def fails(*arguments: Any) -> None:
        work()
        raise RuntimeError("can't start new thread")

    setattr(bench.rooms[0], part, fails)
    bench.step_until(is_awake=False)
    assert "RuntimeError: can't start new thread" in "".join(map(str, (*bench.lines, bench.rooms[0].reason)))
    bench.keeper.handle(hello())
    bench.step_until(is_awake=True)


@pytest.mark.parametrize("part", ["handle_answers", "finish"])
def test_an_error_while_it_falls_asleep_does_not_keep_the_file(bench, tmp_path, part):
    def fails(*arguments: Any) -> None:
        raise RuntimeError("a mistake")

    setattr(bench.rooms[0], part, fails)
    bench.keeper.step()
    with pytest.raises(RuntimeError):
        bench.step_until(is_awake=False)
    bench.step_until(is_awake=False)
    assert not is_locked(tmp_path / "room.sqlite")
    bench.keeper.handle(hello())


def lose(bench: Bench, room: FakeRoom) -> None:
    room.loss = "machine 10.0.0.2 is gone"
    bench.keeper.step()


def test_a_room_whose_machine_is_gone_is_opened_anew_at_once(bench, tmp_path):
    """Though nobody calls it; who is in it sends on."""
    first = bench.rooms[0]
    first.is_idle = False
    bench.keeper.handle(hello())
    lose(bench, first)
    bench.keeper.handle(ping(ANN))
    bench.step_until(is_awake=True)
    second = bench.rooms[1]
    assert first.is_ended
    assert is_locked(tmp_path / "room.sqlite")
    assert [event.peer_id for event in second.handled] == [peer_id(ANN.run_id)]
    assert not second.is_unchanged  # the directory may know keyframes that are lost
    assert bench.lines[0].startswith("machine 10.0.0.2 is gone; the room is opened anew")
    assert bench.keeper.report()["trouble"][0] == bench.lines[0]


def test_a_room_that_loses_machine_after_machine_waits_longer_and_longer(bench):
    for number in range(3):
        bench.rooms[number].is_idle = False
        lose(bench, bench.rooms[number])
        began = time.monotonic()
        bench.step_until(is_awake=True)
        assert time.monotonic() - began >= (0.0, 2.0, 4.0)[number] - 0.1
    assert len(bench.rooms) == 4


def test_a_room_for_which_no_machine_has_a_place_waits_and_says_so(bench):
    def full(path: Path) -> Any:
        raise ShareError("no machine has room for it")

    opens = bench.keeper._open_room
    bench.keeper._open_room = full
    lose(bench, bench.rooms[0])
    deadline = time.monotonic() + 20.0
    while len(bench.lines) < 2:
        assert time.monotonic() < deadline
        bench.keeper.step()
    assert bench.keeper.report()["trouble"][-1] == "no machine has room for it"
    bench.keeper._open_room = opens
    bench.step_until(is_awake=True)
