"""A room whose map file and mapper are on another machine, as its front sees it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.map_changes import ANN, as_values, keyframe, small_map
from helpers.map_files import is_locked
from helpers.worker_in_process import FakeMapper, NearWorker

from share.errors import ShareError, StoreError, UsageError
from share.runtime import remote_room, remote_worker
from share.runtime.map_writer import MapWriter
from share.runtime.mapper_process import RestoreMap
from share.runtime.remote_room import RemoteRooms, WorkerLostError
from share.store.map_store import MapStore


@pytest.fixture
def mappers(monkeypatch: pytest.MonkeyPatch) -> list[FakeMapper]:
    made: list[FakeMapper] = []

    def start(on_answer: Any, on_death: Any) -> FakeMapper:
        made.append(FakeMapper(on_answer, on_death))
        return made[-1]

    monkeypatch.setattr(remote_worker, "start_mapper_process", start)
    monkeypatch.setattr(remote_worker, "_POLL_S", 0.02)
    return made


def until(condition: Callable[[], Any]) -> None:
    deadline = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def opened(path: Path, changes: list[Any]) -> tuple[NearWorker, Any]:
    with MapStore.open(path) as store:
        store.write(changes)
    worker = NearWorker()
    return worker, RemoteRooms(lambda: worker).open_room(path)


def test_the_file_is_open_where_the_worker_is_and_says_the_same(tmp_path: Path) -> None:
    path = tmp_path / "room.sqlite"
    worker, room = opened(path, small_map())
    assert is_locked(path)
    assert room.store.path == path
    assert room.store.writable
    assert room.store.problems == ()
    assert len(room.store.rows().tables["keyframe"]) == 40
    room.store.close()
    assert worker.is_killed
    with MapStore.open(path) as store:
        here = store.outline()
    assert as_values(room.store.outline()) == as_values(here)


def test_what_the_loop_asks_for_was_fetched_when_the_file_was_opened(tmp_path: Path) -> None:
    worker, room = opened(tmp_path / "room.sqlite", small_map())
    worker.called.clear()
    room.store.outline()
    room.store.rows()
    assert not worker.called
    room.store.close()


def test_a_file_that_could_not_be_read_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The room waited for ever: the error was kept until a write, and a room that waits writes nothing."""
    _, room = opened(tmp_path / "room.sqlite", small_map())
    room.store.write([keyframe(ANN, 20)])
    with monkeypatch.context() as patch:
        patch.setattr(MapStore, "outline", lambda store: (_ for _ in ()).throw(StoreError("disk I/O error")))
        with pytest.raises(StoreError, match="disk I/O error"):
            room.store.outline()
    assert room.store.outline().next_ids[ANN] == 21
    room.store.close()


def test_changes_are_acknowledged_when_the_worker_has_written_them(tmp_path: Path) -> None:
    path = tmp_path / "room.sqlite"
    _, room = opened(path, small_map())
    room.store.write([keyframe(ANN, 20)])
    assert len(room.store.rows().tables["keyframe"]) == 41
    assert room.store.outline().next_ids[ANN] == 21
    room.store.close()
    with MapStore.open(path) as store:
        assert len(store.rows().tables["keyframe"]) == 41


@pytest.mark.usefixtures("mappers")
def test_a_mapper_restores_the_rows_of_which_the_front_was_told(
    tmp_path: Path, mappers: list[FakeMapper]
) -> None:
    """What is written meanwhile comes to it as messages."""
    _, room = opened(tmp_path / "room.sqlite", small_map())
    rows = room.store.rows()
    room.store.write([keyframe(ANN, 20)])
    mapper = room.start_mapper(print, print, 0.0)
    mapper.send(RestoreMap(rows, has_keys=True))
    until(lambda: mappers and mappers[0].got)
    (restore,) = mappers[0].got
    assert restore.has_keys
    assert len(restore.rows.tables["keyframe"]) == 40
    mapper.close()
    again = room.start_mapper(print, print, 0.0)
    again.send(RestoreMap(room.store.rows()))
    until(lambda: len(mappers) == 2 and mappers[1].got)
    assert len(mappers[1].got[0].rows.tables["keyframe"]) == 41
    again.close()
    room.store.close()


def test_messages_and_answers_keep_their_order_and_none_is_lost_at_the_end(
    tmp_path: Path, mappers: list[FakeMapper]
) -> None:
    _, room = opened(tmp_path / "room.sqlite", [])
    answers: list[int] = []
    mapper = room.start_mapper(answers.append, pytest.fail, 0.0)
    for i in range(500):
        mapper.send(i)
        if mappers:
            mappers[0].answer(i)
    until(lambda: mappers and len(mappers[0].got) == 500)
    assert mappers[0].got == list(range(500))
    mappers[0].answer(-1)
    mapper.close()
    assert mappers[0].is_closed
    assert answers == [*sorted(answers[:-1]), -1]
    room.store.close()


def test_a_mapper_that_dies_leaves_the_file_open(tmp_path: Path, mappers: list[FakeMapper]) -> None:
    _, room = opened(tmp_path / "room.sqlite", [])
    deaths: list[str] = []
    mapper = room.start_mapper(print, deaths.append, 0.0)
    until(lambda: mappers)
    mappers[0].die("was ended by SIGKILL")
    until(lambda: deaths)
    assert deaths == ["was ended by SIGKILL"]
    assert room.store.loss is None
    mapper.close()
    room.start_mapper(print, print, 0.0).close()
    assert len(mappers) == 2
    room.store.close()


@pytest.mark.usefixtures("mappers")
def test_a_machine_that_is_gone_is_said_once_and_ends_all_at_once(tmp_path: Path) -> None:
    worker, room = opened(tmp_path / "room.sqlite", small_map())
    deaths: list[str] = []
    mapper = room.start_mapper(print, deaths.append, 0.0)
    until(lambda: "receive" in worker.called)
    worker.lose()
    until(lambda: deaths)
    assert room.store.loss == "machine near is gone"
    assert deaths == ["ended: machine near is gone"]
    began = time.monotonic()
    mapper.close()
    with pytest.raises(StoreError, match="machine near is gone"):
        room.store.write([])
    room.store.close()
    assert time.monotonic() - began < 5.0
    assert len(deaths) == 1


def test_what_a_lost_machine_has_not_written_is_not_acknowledged(tmp_path: Path) -> None:
    from share.protocol.edge_events import SaveChanges

    worker, room = opened(tmp_path / "room.sqlite", small_map())
    saved: list[Any] = []
    said: list[str] = []
    writer = MapWriter(room.store, saved.append, said.append)
    writer.submit(SaveChanges(1, (keyframe(ANN, 20),)))
    until(lambda: saved)
    worker.lost.set()
    writer.submit(SaveChanges(2, (keyframe(ANN, 21),)))
    until(lambda: said)
    assert writer.close() is not None
    assert [one.ticket for one in saved] == [1]
    worker.lose()


def test_a_worker_that_does_not_answer_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without power refuses nothing."""
    worker, room = opened(tmp_path / "room.sqlite", [])

    def hangs(method: str, *arguments: Any, timeout_s: float | None = None) -> Any:
        assert timeout_s is not None
        raise WorkerLostError(f"has not answered for {timeout_s:g} s")

    monkeypatch.setattr(worker, "call", hangs)
    deaths: list[str] = []
    mapper = room.start_mapper(print, deaths.append, 0.0)
    until(lambda: deaths)
    assert "has not answered for" in deaths[0]
    assert worker.is_killed
    mapper.close()
    worker.lose()


def test_a_room_without_a_map_file_has_a_worker_of_its_own(mappers: list[FakeMapper]) -> None:
    workers: list[NearWorker] = []

    def start() -> NearWorker:
        workers.append(NearWorker())
        return workers[-1]

    answers: list[Any] = []
    mapper = RemoteRooms(start).start_mapper(answers.append, pytest.fail, 0.0)
    until(lambda: mappers)
    mappers[0].answer(7)
    until(lambda: answers)
    mapper.close()
    assert answers == [7]
    assert workers[0].is_killed


def test_a_mapper_for_which_no_machine_has_room_has_died() -> None:
    def full() -> NearWorker:
        raise ShareError("no machine has room")

    deaths: list[str] = []
    mapper = RemoteRooms(full).start_mapper(print, deaths.append, 0.0)
    until(lambda: deaths)
    assert deaths == ["could not be started: no machine has room"]
    mapper.close()


def test_a_mapper_that_is_closed_before_its_time_never_starts() -> None:
    started = threading.Event()

    def start() -> NearWorker:
        started.set()
        return NearWorker()

    mapper = RemoteRooms(start).start_mapper(print, print, 3600.0)
    mapper.close()
    assert not started.is_set()


def test_errors_of_a_file_come_back_as_they_are(tmp_path: Path) -> None:
    notes = tmp_path / "notes.txt"
    notes.write_text("no map")
    worker = NearWorker()
    with pytest.raises(UsageError, match="is not a SHARE map"):
        RemoteRooms(lambda: worker).open_room(notes)
    assert worker.is_killed
    path = tmp_path / "room.sqlite"
    with MapStore.open(path), pytest.raises(StoreError, match="another edge uses this map"):
        RemoteRooms(NearWorker).open_room(path)


def test_a_map_that_cannot_be_interpreted_is_set_aside_by_its_worker(tmp_path: Path) -> None:
    path = tmp_path / "room.sqlite"
    _, room = opened(path, small_map())
    renamed = room.store.set_aside({"eve-0001": 7})
    assert renamed.exists()
    assert len(room.store.rows().tables["keyframe"]) == 0
    assert room.store.outline().forgotten["eve-0001"] == 7
    room.store.close()


def test_a_worker_of_another_version_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote_worker, "__version__", "0.0.1")
    request = remote_worker.request_bytes("greet", ())
    monkeypatch.undo()
    answer = remote_worker.RoomWorker().call(request)
    with pytest.raises(UsageError, match=r"has SHARE .*, the site 0\.0\.1: install the same on both"):
        remote_worker.read_answer(answer)


@pytest.mark.parametrize("error", [ValueError(np.zeros(3)), UnicodeDecodeError("utf-8", b"x", 0, 1, "no")])
def test_any_error_of_a_worker_becomes_a_line(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fails(self: Any) -> None:
        raise error

    monkeypatch.setattr(remote_worker.RoomWorker, "greet", fails)
    with pytest.raises(RuntimeError, match=type(error).__name__):
        NearWorker().call("greet")


def test_ray_is_not_imported_without_being_asked_for() -> None:
    import subprocess
    import sys

    code = "import sys, share.cli.site, share.runtime.edge; sys.exit('ray' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    assert remote_room.__name__ in sys.modules


def test_a_host_has_rooms_that_know_nothing_of_each_other(tmp_path: Path, mappers: list[FakeMapper]) -> None:
    host = remote_worker.RoomHost()

    def call(room: int, method: str, *arguments: Any) -> Any:
        return remote_worker.read_answer(host.call(room, remote_worker.request_bytes(method, arguments)))

    for room in (1, 2):
        call(room, "open_map", tmp_path / f"{room}.sqlite")
        call(room, "start_mapper")
    call(1, "write", small_map())
    assert call(2, "describe_map").keyframes == 0
    host.drop(1)
    host.drop(1)
    assert [one.is_closed for one in mappers] == [True, False]
    assert not is_locked(tmp_path / "1.sqlite")
    assert is_locked(tmp_path / "2.sqlite")
    host.drop(2)
