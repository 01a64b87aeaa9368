"""A mapper that keeps dying: the edge goes on, pauses grow, a map that it dies of is set aside."""

from __future__ import annotations

import os
import sqlite3
import threading
import time
import types
from collections import deque
from pathlib import Path

import numpy as np
import pytest
from helpers.map_changes import ANN, BOB, small_map
from helpers.map_files import is_locked

from share.config import Config, EdgeConfig, with_policy
from share.errors import StoreError
from share.mapping.corrections import MapEvent
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import RemoveKeyframes, RemoveRun, StoredMap
from share.net.transport import IncomingMessage
from share.protocol.client_service import ClientService
from share.protocol.edge import EdgeProtocol
from share.protocol.edge_events import (
    ChangesSaved,
    MapperResult,
    PeerMessageReceived,
    SaveChanges,
    SendToPeer,
    TrackerLost,
)
from share.runtime import edge as edge_module
from share.runtime import mapper_process, mapper_supervision, room_session
from share.runtime.blinding import NoBlinding
from share.runtime.edge import EdgeRun
from share.runtime.edge_observer import EdgeObservers
from share.runtime.map_writer import MapWriter
from share.runtime.mapper_process import MapperReport, MapRestored, RestoreBegun, RestoreMap
from share.runtime.mapper_supervision import MapperProgress, MapperRestarts
from share.runtime.served_room import ServedRoom
from share.runtime.worker_process import END
from share.store import map_store
from share.store.map_store import MapStore
from share.store.schema import PAGE_BYTES
from share.wire.messages import public_tag


class Link:
    """A link without agents."""

    endpoint = "nowhere"

    def receive(self, timeout_ms):
        time.sleep(min(timeout_ms, 5) / 1e3)

    def send(self, peer, frames): ...
    def refusals(self):
        return []

    def agent_names(self, key): ...
    def trouble(self): ...
    def expect_growth(self, is_expected): ...
    def wake(self): ...
    def close(self): ...


def dies_of_a_map(inbox, answer):
    """A mapper that cannot take in any keyframe."""
    while (message := inbox.get()) is not END:
        if isinstance(message, RestoreMap):
            answer(RestoreBegun())
            if message.stored_map.keyframes:
                os._exit(3)
            answer(MapRestored())


def dies_later(inbox, answer):
    """A mapper that dies of what comes after its map."""
    while (message := inbox.get()) is not END:
        if isinstance(message, RestoreMap):
            answer(MapRestored())
            time.sleep(0.1)
            os._exit(3)


@pytest.fixture
def path(tmp_path):
    with MapStore.open(tmp_path / "room.sqlite") as store:
        store.write(small_map())
    return tmp_path / "room.sqlite"


@pytest.fixture
def edge(path, monkeypatch):
    """Makes an edge of a mapper, whose pauses are a hundredth as long."""
    runs = []

    def make(mapper):
        monkeypatch.setattr(mapper_process, "run_mapper", mapper)
        failed = MapperRestarts.record_failure
        monkeypatch.setattr(
            MapperRestarts, "record_failure", lambda self: pauses.append(failed(self)) or pauses[-1] / 100
        )
        pauses, events = [], []
        run = EdgeRun(Config(), Link(), None, events.append, MapStore.open(path))
        thread = threading.Thread(target=run.run)
        runs.append((run, thread))
        thread.start()
        return run, pauses, events

    yield make
    for run, thread in runs:
        run.stop()
        thread.join(30)
        assert not thread.is_alive()


def until(condition, seconds=120):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def reasons(events, name):
    return [event["reason"] for event in events if event["event"] == name]


@pytest.mark.long
def test_a_map_that_mappers_die_of_is_set_aside(edge, path):
    before = path.read_bytes()
    run, pauses, events = edge(dies_of_a_map)
    until(lambda: reasons(events, "map"))
    assert pauses == [1, 2, 4]
    assert len(reasons(events, "mapper died")) == 3
    assert "its process ended with exit code 3; restarted in" in reasons(events, "mapper died")[0]
    reason = "3 mappers in a row have died while restoring it"
    line = f"the map file is renamed to room.sqlite.damaged-1: {reason}; a new one is started"
    assert reasons(events, "map") == [line]
    assert path.with_name("room.sqlite.damaged-1").read_bytes() == before
    until(lambda: any(text.startswith("the mapper: its process ended") for text in run.report()["trouble"]))
    time.sleep(0.5)
    assert len(pauses) == 3  # the next lives
    assert path.exists()  # and has a new map file
    with MapStore.read(path.with_name("room.sqlite.damaged-1")) as old:
        assert len(old.load().keyframes) == 40


@pytest.mark.long
def test_a_mapper_that_dies_of_something_else_keeps_its_map(edge, path):
    _, pauses, events = edge(dies_later)
    until(lambda: len(pauses) >= 5)
    assert pauses[:5] == [1, 2, 4, 8, 16]
    assert not reasons(events, "map")
    assert not path.with_name("room.sqlite.damaged-1").exists()


def test_forgotten_runs_are_known_from_the_file_and_after_a_restart(edge, path, monkeypatch):
    with MapStore.open(path) as store:
        store.write([RemoveKeyframes(tuple(KeyframeKey(ANN, i) for i in range(20))), RemoveRun(ANN)])
    given = []
    init = EdgeProtocol.__init__
    monkeypatch.setattr(
        EdgeProtocol,
        "__init__",
        lambda self, *args, forgotten=None, **rest: (
            given.append(dict(forgotten)) or init(self, *args, forgotten=forgotten | {"00": 7}, **rest)
        ),
    )
    edge(dies_later)
    until(lambda: len(given) >= 2)
    of_the_file = {public_tag(1): 20}
    assert given[:2] == [of_the_file, of_the_file | {"00": 7}]  # what a session has forgotten, the next knows


def test_answers_to_an_earlier_session_are_discarded(edge, monkeypatch):
    """A ticket of the earlier map writer would acknowledge what the new one has not written."""
    writers, handled = [], []
    handle = EdgeProtocol.handle

    class Writer(MapWriter):
        """Answers each change once more when its session is over."""

        def __init__(self, store, on_saved, notify):
            super().__init__(store, on_saved, notify)
            writers.append(self)
            self._answer = on_saved

        def drain(self, timeout_s):
            self._answer(ChangesSaved(10**6))
            return super().drain(timeout_s)

    monkeypatch.setattr(room_session, "MapWriter", Writer)
    monkeypatch.setattr(
        EdgeProtocol, "handle", lambda self, event, now: handled.append(event) or handle(self, event, now)
    )
    edge(dies_later)
    until(lambda: len(writers) > 2)
    assert ChangesSaved(10**6) not in handled


def test_a_mistake_costs_one_message_and_is_said(edge, monkeypatch):
    """A message that the room could not take ended the edge."""
    handle = ServedRoom.handle

    def fails(self, event):
        if isinstance(event, PeerMessageReceived):
            raise KeyError("none")
        handle(self, event)

    monkeypatch.setattr(ServedRoom, "handle", fails)
    monkeypatch.setattr(
        Link, "receive", lambda self, timeout_ms: time.sleep(0.01) or IncomingMessage(b"1", [])
    )
    run, _, events = edge(dies_of_a_map)
    until(lambda: "internal error: a message: KeyError" in " ".join(run.report().get("trouble", [])))
    until(lambda: reasons(events, "mapper died"))  # its steps go on
    assert len(reasons(events, "internal error")) == 1


class Store:
    def __init__(self, load, writable=True):
        self.rows, self.writable, self.asides = load, writable, 0
        self.path, self.problems, self.read_only_reason = Path("m"), (), "" if writable else "read-only"

    def set_aside(self, forgotten):
        self.asides += 1
        return Path("m.damaged-1")

    def outline(self):
        return StoredMap()


def raises(error):
    def load():
        raise error

    return load


@pytest.mark.parametrize("error", [np.linalg.LinAlgError("no pose"), ValueError("x"), RecursionError("deep")])
def test_a_map_that_cannot_be_interpreted_is_set_aside(error):
    said, store = [], Store(raises(error))
    assert MapperRestarts(store, 0.05, said.append).load_map() == (None, [])
    assert store.asides == 1
    aside = f"the map file is renamed to m.damaged-1: {type(error).__name__}: {error}; a new one is started"
    assert said == [aside]


def restarts_of(path):
    with MapStore.open(path) as store:
        restarts = MapperRestarts(store, 0.05, print)
        restarts.load_map()
        return restarts.losses


def test_a_map_is_said_to_be_loaded_until_the_mapper_has_it(path):
    with MapStore.open(path) as store:
        restarts = MapperRestarts(store, 0.05, print)
        assert restarts.loading() == {}
        restore, _ = restarts.load_map()
        count = len(restore.rows.tables["keyframe"])
        assert count and restarts.loading() == {"loading": f"loading the map: {count} keyframes"}
        restarts.record_restored()
        assert restarts.loading() == {}


def test_a_damaged_map_stays_a_loss_until_its_copy_is_moved_away(path):
    assert restarts_of(path) == []
    content = bytearray(path.read_bytes())
    content[3 * PAGE_BYTES : 5 * PAGE_BYTES] = bytes(2 * PAGE_BYTES)
    path.write_bytes(content)
    kept = "room.sqlite.damaged-1"
    repaired = f"the file was damaged; it is kept as {kept}, and its intact rows were taken over"
    assert restarts_of(path)[0] == f"map room.sqlite: {repaired}"
    later = f"earlier files are kept as {kept}: see what they hold, move them away"
    assert restarts_of(path) == [later]
    path.with_name(kept).rename(path.with_name("seen"))
    assert restarts_of(path) == []


def test_damage_that_a_restart_meets_is_said(tmp_path):
    path, said = tmp_path / "room.sqlite", []
    with MapStore.open(path) as store:
        restarts = MapperRestarts(store, 0.05, said.append)
        store.write(small_map(300, 60))
        store.compact()
        restarts.load_map()
        assert (said, restarts.losses) == ([], [])
        with path.open("r+b") as file:
            for page in range(40, 90, 3):
                file.seek(page * PAGE_BYTES)
                file.write(b"\xa5" * PAGE_BYTES)
        restore, known = restarts.load_map()
        lost = 600 - len(restore.rows.tables["keyframe"])
        assert lost and len(known) == 2
        assert said[0].startswith("the file was damaged; it is kept as room.sqlite.damaged-1")
        assert f"{lost} keyframes could not be read" in said
        assert restarts.losses == [f"map room.sqlite: {line}" for line in said]
        restarts.load_map()
        assert len(said) == len(restarts.losses)


def test_a_long_list_of_kept_files_is_one_line(path):
    for number in range(1, 6):
        path.with_name(f"room.sqlite.damaged-{number}").touch()
    (line,) = restarts_of(path)
    assert "room.sqlite.damaged-3 and 2 more: " in line


def test_a_map_that_was_set_aside_is_a_loss():
    restarts = MapperRestarts(Store(raises(ValueError("x"))), 0.05, print)
    restarts.load_map()
    assert restarts.losses == ["the map file is renamed to m.damaged-1: ValueError: x; a new one is started"]


def test_a_map_that_was_set_aside_is_a_loss_where_the_new_one_fails_too(path, monkeypatch):
    """As on a full disk: the next try takes up the new one, which is empty."""

    def fails(*arguments):
        raise sqlite3.OperationalError("database or disk is full")

    with MapStore.open(path) as store:
        restarts = MapperRestarts(store, 0.05, print)
        monkeypatch.setattr(MapStore, "rows", lambda self: raises(ValueError("x"))())
        monkeypatch.setattr(map_store, "add_forgotten", fails)
        with pytest.raises(StoreError):
            restarts.load_map()
        kept = "room.sqlite.damaged-1: see what they hold, move them away"
        assert restarts.losses == [f"earlier files are kept as {kept}"]


def test_a_read_only_map_is_a_loss():
    restarts = MapperRestarts(Store(raises(ValueError("x")), writable=False), 0.05, print)
    assert restarts.losses == ["map m: read-only; nothing new is stored"]
    restarts.load_map()
    assert restarts.losses == ["the map file is no longer used: ValueError: x; nothing is saved"]


def test_a_map_that_is_closed_at_the_end_is_no_loss(path):
    """The last report, edge.json, is made after that."""
    with MapStore.open(path) as store:
        restarts = MapperRestarts(store, 0.05, print)
    assert not store.writable and restarts.losses == []


class BusyLink(Link):
    """200 messages that have arrived at once."""

    def __init__(self):
        self.waiting = deque(IncomingMessage(bytes([k]), [b"nonsense"]) for k in range(200))

    def receive(self, timeout_ms):
        return self.waiting.popleft() if self.waiting else super().receive(timeout_ms)


def test_every_message_of_a_burst_is_handled(monkeypatch):
    """The edge dropped each that came after 64 others."""
    handled, handle = [], EdgeProtocol.handle

    def noting(self, event, now):
        if isinstance(event, PeerMessageReceived):
            handled.append(event.peer_id[0])
        return handle(self, event, now)

    monkeypatch.setattr(EdgeProtocol, "handle", noting)
    run = EdgeRun(Config(), BusyLink(), None, lambda fields: None)
    thread = threading.Thread(target=run.run)
    thread.start()
    try:
        until(lambda: len(handled) >= 200)
        assert handled == list(range(200))
    finally:
        run.stop()
        thread.join(30)


def test_a_damaged_read_only_map_is_no_longer_used():
    said = []
    restarts = MapperRestarts(Store(raises(ValueError("x")), writable=False), 0.05, said.append)
    assert restarts.load_map() == (None, [])
    assert restarts.store is None
    assert said == ["the map file is no longer used: ValueError: x; nothing is saved"]


def test_runs_without_a_credential_are_unknown_to_an_edge_with_keys(path):
    """In `small_map`, a key acts for Ann."""
    for has_keys, bob in ((True, None), (False, "")):
        store = MapStore.read(path)
        kept, known = MapperRestarts(store, 0.05, print, has_keys).load_map()
        voices = {run.run_key: run.credential for run in kept.stored_map.runs}
        assert voices == {run.key: run.credential for run in known} == {ANN: "key of ann", BOB: bob}


def test_a_failing_disk_does_not_set_the_map_aside():
    store = Store(raises(StoreError("the map cannot be read: disk I/O error")))
    with pytest.raises(StoreError):
        MapperRestarts(store, 0.05, print).load_map()
    assert store.asides == 0


def test_the_edge_waits_for_a_disk_that_cannot_be_read(edge, monkeypatch):
    run, _, events = edge(dies_later)
    unreadable = StoreError("room: the map cannot be read: disk I/O error")
    with monkeypatch.context() as patch:
        patch.setattr(MapperRestarts, "load_map", lambda self, read: raises(unreadable)())
        until(lambda: len(reasons(events, "map")) > 1)
    assert reasons(events, "map")[0] == "room: the map cannot be read: disk I/O error; retried in 0.01 s"
    session = run.report()["session"]
    until(lambda: run.report()["session"] != session)


def serve(path, start_mapper):
    """A room around which is nothing."""
    given = host(), 0, MapStore.open(path), EdgeObservers(), NoBlinding(), False
    return ServedRoom(Config(), *given, start_mapper=start_mapper)


def host():
    names = ("wake", "send", "expect_growth", "record", "log_event")
    return types.SimpleNamespace(**{name: lambda *_: None for name in names})


class Process:
    """A mapper's process."""

    def send(self, message): ...
    def close(self): ...


@pytest.fixture
def quick(monkeypatch):
    """Pauses are a hundredth as long."""
    failed = MapperRestarts.record_failure
    monkeypatch.setattr(MapperRestarts, "record_failure", lambda self: failed(self) / 100)


def test_a_mapper_that_cannot_be_started_is_tried_again(path, quick):
    """The edge ended of too many open files when its mapper had died."""
    errors = [None, OSError(24, "Too many open files"), RuntimeError("can't start new thread"), None]

    def start(on_answer, on_death, delay_s):
        deaths.append(on_death)
        if (error := errors.pop(0)) is not None:
            raise error
        return Process()

    deaths: list = []
    room = serve(path, start)
    deaths[0]("was ended by SIGKILL")
    room.step()
    assert room.is_waiting
    until(lambda: room.step() or not room.is_waiting)
    assert not errors
    assert room.close() is None


def test_a_room_whose_map_is_loading_is_not_idle(path):
    """It would fall asleep, and be shown as loading for as long."""
    answers: list = []
    room = serve(path, lambda on_answer, on_death, delay_s: answers.append(on_answer) or Process())
    answers[0](MapperReport({}, is_idle=True))  # while the map is on its way to the mapper
    room.step()
    assert not room.is_idle
    answers[0](MapRestored())
    room.step()
    assert room.is_idle
    room.close()


@pytest.mark.parametrize("has_begun", [False, True])
def test_a_map_is_not_to_blame_where_a_mapper_dies_before_it_restores_it(path, quick, has_begun):
    """It was set aside when the machine had no memory, processes or threads three times."""
    started: list = []
    room = serve(
        path, lambda on_answer, on_death, delay_s: started.append((on_answer, on_death)) or Process()
    )
    for _ in range(6):
        on_answer, on_death = started[-1]
        if has_begun:
            on_answer(RestoreBegun())
        on_death("ended with exit code 1")
        room.step()
        until(lambda: room.step() or not room.is_waiting)
    room.close()
    assert path.with_name("room.sqlite.damaged-1").exists() is has_begun


def test_a_restart_that_fails_is_tried_again_after_a_pause(path, quick, monkeypatch):
    """An error that nobody expected was tried again in each step, with a line each."""
    started, tries = [], []
    room = serve(path, lambda on_answer, on_death, delay_s: started.append((on_death, delay_s)) or Process())
    load = MapperRestarts.load_map

    def failing(self, read):
        tries.append(time.monotonic())
        if len(tries) < 4:
            raise MemoryError
        return load(self, read)

    monkeypatch.setattr(MapperRestarts, "load_map", failing)
    started[0][0]("was ended by SIGKILL")
    until(lambda: room.step() or not (room.is_waiting or len(started) < 2))
    assert np.all(np.diff(tries) >= [0.005, 0.01, 0.02])  # pauses double
    assert [delay_s for _, delay_s in started] == [0.0, 0.0]  # it has waited
    assert room.close() is None


def test_a_room_that_waits_for_its_map_unlocks_the_file_at_the_end(path, quick, monkeypatch):
    started: list = []
    room = serve(path, lambda on_answer, on_death, delay_s: started.append(on_death) or Process())
    monkeypatch.setattr(room_session, "MapWriter", lambda *_: {}["none"])
    started[0]("was ended by SIGKILL")
    room.step()
    until(lambda: room.step() or "KeyError" in room.report()["trouble"][-1])
    assert "nothing is mapped or acknowledged until that is done" in room.report()["trouble"][-1]
    assert room.is_waiting
    assert is_locked(path)
    assert "keyframes not acknowledged are not in it" in (room.close() or "")
    assert not is_locked(path)


@pytest.mark.parametrize("is_answered", [False, True])
def test_a_room_that_is_closed_while_its_map_is_read_waits_for_that(path, quick, monkeypatch, is_answered):
    started: list = []
    room = serve(path, lambda on_answer, on_death, delay_s: started.append(on_death) or Process())
    may_read, rows = threading.Event(), MapStore.rows
    monkeypatch.setattr(MapStore, "rows", lambda store: may_read.wait() and rows(store))
    started[0]("was ended by SIGKILL")
    room.step()
    assert "the map file is read; nothing is mapped" in room.report()["trouble"][-1]
    for _ in range(3):
        time.sleep(0.02)
        room.step()  # does not wait
    room.end_processes()
    if is_answered:
        may_read.set()
    reason = room.close_file(0.05 if not is_answered else 60.0)
    assert ("still being read, or repaired" in (reason or "")) is not is_answered
    assert is_locked(path) is not is_answered
    may_read.set()
    room.finish(reason)


def test_what_is_found_while_a_map_is_read_at_the_end_is_said(path, quick, monkeypatch):
    started: list = []
    room = serve(path, lambda on_answer, on_death, delay_s: started.append(on_death) or Process())
    lines: list = []
    room._host.log_event = lambda event, text: lines.append(text)
    may_read = threading.Event()

    def found(store):
        may_read.wait()
        store.problems = ("3 keyframes could not be read",)
        raise StoreError("the disk fails")

    monkeypatch.setattr(MapStore, "rows", found)
    started[0]("was ended by SIGKILL")
    room.step()
    room.end_processes()
    may_read.set()
    reason = room.close_file()
    room.finish(reason)
    assert reason == "the disk fails: keyframes not acknowledged are not in it"
    assert lines[1:] == ["3 keyframes could not be read", reason]
    assert not is_locked(path)


def test_what_changes_while_a_room_waits_is_not_kept(path, quick, monkeypatch):
    """It is not saved: an object that was removed then came back at the next start of the edge."""
    started: list = []
    room = serve(path, lambda on_answer, on_death, delay_s: started.append(on_death) or Process())
    kept = iter([["chair"], [], []])
    monkeypatch.setattr(ClientService, "kept_objects", lambda self: next(kept))
    rows, fails = MapStore.rows, deque([True, True, False])
    monkeypatch.setattr(
        MapStore, "rows", lambda store: raises(StoreError("full"))() if fails.popleft() else rows(store)
    )
    monkeypatch.setattr(EdgeProtocol, "__init__", noted := given_objects(EdgeProtocol.__init__))
    started[0]("was ended by SIGKILL")
    until(lambda: room.step() or not room.is_waiting)
    assert noted.objects == [["chair"]]
    room.close()


def given_objects(init):
    """A constructor that notes the objects which it is given."""

    def made(self, *given, **named):
        made.objects.append(given[5])
        init(self, *given[:5], (), **named)

    made.objects = []
    return made


def test_a_second_restart_waits_for_the_first(path, quick, monkeypatch):
    """Two threads read one file, and a mapper outlived the room."""
    started: list = []
    room = serve(path, lambda on_answer, on_death, delay_s: started.append(on_death) or Process())
    may_read, rows, readers = threading.Event(), MapStore.rows, []
    monkeypatch.setattr(
        MapStore, "rows", lambda store: readers.append(0) or (may_read.wait() and rows(store))
    )
    started[0]("was ended by SIGKILL")
    room.step()
    room._on_lost_effect("MemoryError")
    room.step()
    may_read.set()
    until(lambda: room.step() or not room.is_waiting)
    assert len(readers) == 1 and len(started) == 2
    room.close()


def test_a_change_that_is_lost_at_the_end_starts_no_mapper(path):
    """Its process would have outlived the room."""
    started: list = []
    room = serve(path, lambda on_answer, on_death, delay_s: started.append(on_death) or Process())
    room.end_processes()
    room._session.map_writer.submit = lambda request: {}["none"]
    room.execute([SaveChanges(1, (RemoveKeyframes((KeyframeKey("ann-0003", 7),)),))])
    assert len(started) == 1
    room.close_file()
    room.finish(None)


def test_a_map_is_not_to_blame_for_changes_that_are_lost_while_it_is_restored(path, quick):
    started: list = []
    room = serve(
        path, lambda on_answer, on_death, delay_s: started.append((on_answer, on_death)) or Process()
    )
    for n in range(5):
        started[-1][0](RestoreBegun())
        room.step()
        room._session.map_writer.submit = lambda request: {}["none"]
        room.execute([SaveChanges(n, (RemoveKeyframes((KeyframeKey("ann-0003", 7),)),))])
        until(lambda: room.step() or not room.is_waiting)
    assert len(started) == 6
    room.close()
    assert not path.with_name("room.sqlite.damaged-1").exists()


def test_an_edge_without_a_mapper_misses_no_report(monkeypatch):
    """Policy streamed was in trouble for ever, a minute after its start."""
    settings = with_policy(Config(), "streamed")
    room = ServedRoom(settings, host(), 0, None, EdgeObservers(), NoBlinding(), False)
    now_s = time.monotonic()
    monkeypatch.setattr(mapper_supervision.time, "monotonic", lambda: now_s + 100.0)
    assert room.report()["trouble"] == []
    room.close()


def test_a_session_goes_on_without_what_nobody_needs_only(path, quick):
    """An error in one effect of a message lost all later ones, among them what mapper and file build on."""
    room = serve(path, lambda *_: Process())
    sent: list = []
    room._host.send = lambda peer, frames: sent.append(frames) if frames else {}["none"]
    save = SaveChanges(1, (RemoveKeyframes((KeyframeKey("ann-0003", 7),)),))
    before = room.report()["session"]
    with pytest.raises(KeyError):
        room.execute([SendToPeer(b"ann", ()), SendToPeer(b"bob", (b"1",)), save])
    assert sent == [(b"1",)]
    assert room.report()["session"] == before
    room._session.map_writer.submit = lambda request: {}["none"]
    room.execute([save, SendToPeer(b"ann", (b"2",))])
    assert sent == [(b"1",)]  # such as an acknowledgement of what is not in the file
    until(lambda: room.step() or room.report()["session"] != before)
    assert "it lacks a change (KeyError: 'none'" in room.report()["trouble"][0]
    room.close()


def test_an_observer_that_fails_costs_nothing(path):
    room = serve(path, lambda *_: Process())
    sent: list = []
    room._host.send = lambda peer, frames: sent.append(frames)
    room._observer.add_effect = lambda effect: {}["none"]
    with pytest.raises(KeyError):
        room.execute([SendToPeer(b"ann", (b"1",)), SendToPeer(b"ann", (b"2",))])
    assert sent == [(b"1",), (b"2",)]
    room.close()


def test_a_mapper_that_never_reports_is_trouble(monkeypatch):
    progress = MapperProgress(start_delay_s=5.0)
    assert progress.stall() is None
    now_s = time.monotonic()
    monkeypatch.setattr(mapper_supervision.time, "monotonic", lambda: now_s + 64.0)
    assert progress.stall() is None
    monkeypatch.setattr(mapper_supervision.time, "monotonic", lambda: now_s + 70.0)
    assert "the mapper has not reported for 65 s since it was to start" in (progress.stall() or "")


def counts(inbox, answer):
    """A mapper that has looked up seven keyframes and dies."""
    answer(MapperReport({"loops": {"tried": 7, "accepted": 2}, "place_ms": {"n": 7}, "maps": {}}))
    time.sleep(0.1)
    os._exit(3)


@pytest.mark.slow
@pytest.mark.long
def test_counters_continue_after_a_mapper_died(edge):
    run, _, events = edge(counts)
    until(lambda: len(reasons(events, "mapper died")) >= 3)
    until(lambda: run.report().get("place_ms", {}).get("n", 0) >= 21)
    tried = run.report()["loops"]["tried"]
    assert tried % 7 == 0
    until(lambda: run.report()["loops"]["tried"] > tried)
    loops = run.report()["loops"]
    assert 2 * loops["tried"] == 7 * loops["accepted"]


def test_a_dead_tracker_is_trouble_of_its_agent(monkeypatch):
    """Not the edge's: else an agent could make /health 503 by its frames."""
    made = room_session.TrackerProcesses

    def with_a_dead_one(settings, on_answer):
        on_answer(TrackerLost("ann-0001", 0, "was ended by SIGKILL"))
        return made(settings, on_answer)

    monkeypatch.setattr(room_session, "TrackerProcesses", with_a_dead_one)
    run = EdgeRun(Config(edge=EdgeConfig(policy="streamed")), Link(), None, lambda fields: None)
    thread = threading.Thread(target=run.run)
    thread.start()
    try:
        until(lambda: run.report().get("refused"))
        assert run.report()["trouble"] == []
        assert run.report()["refused"] == ["agent's run ann-0001: its tracker was ended by SIGKILL"]
    finally:
        run.stop()
        thread.join(30)


def test_a_failed_report_is_shown_as_stale(edge, monkeypatch):
    run, _, events = edge(dies_later)
    until(run.report)
    monkeypatch.setattr(edge_module, "_STALE_REPORT_S", 0.2)
    with monkeypatch.context() as patch:
        patch.setattr(EdgeProtocol, "report", lambda self, mapper: {}["none"])
        until(lambda: any("no report can be made (KeyError" in line for line in run.report()["trouble"]))
        assert [line["event"] for line in events].count("internal error") == 1
    until(lambda: not any("no report" in line for line in run.report()["trouble"]))


def fails_to_solve(inbox, answer):
    """A mapper whose first solution fails."""
    reason = "map ann-1/0: solve: RuntimeError: no pivot"
    answer(MapperResult([MapEvent(None, "step failed", reason, map_id="ann-1/0")]))
    while inbox.get() is not END:
        pass


def test_a_failed_solution_is_shown_with_its_map(edge):
    """The page lists it; the edge itself is healthy."""
    run, _, events = edge(fails_to_solve)
    until(lambda: run.report().get("refused"))
    assert run.report()["refused"] == ["map ann-1/0: solve: RuntimeError: no pivot"]
    assert run.report()["trouble"] == []
    (line,) = [event for event in events if event["event"] == "step failed"]
    assert (line["agent"], line["map_id"]) == (None, "ann-1/0")
