"""A mapper that keeps dying: the edge goes on, pauses grow, a map that it dies of is set aside."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.map_changes import ANN, BOB, small_map

from share.config import Config, EdgeConfig
from share.errors import StoreError
from share.protocol.edge_events import TrackerLost
from share.runtime import edge as edge_module
from share.runtime.edge import EdgeRun
from share.runtime.mapper_process import MapperReport, MapRestored, RestoreMap
from share.runtime.mapper_supervision import MapperRestarts
from share.runtime.worker_process import END
from share.store.map_store import MapStore


class Link:
    """Nobody is there."""

    endpoint = "nowhere"

    def receive(self, timeout_ms):
        time.sleep(min(timeout_ms, 5) / 1e3)

    def send(self, peer, frames): ...
    def refusals(self):
        return []

    def agent_names(self, key): ...
    def trouble(self): ...
    def wake(self): ...
    def close(self): ...


def dies_of_a_map(inbox, answer, settings):
    """A mapper that cannot take in any keyframe."""
    while (message := inbox.get()) is not END:
        if isinstance(message, RestoreMap):
            if message.stored_map.keyframes:
                os._exit(3)
            answer(MapRestored())


def dies_later(inbox, answer, settings):
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
        monkeypatch.setattr(edge_module, "run_mapper", mapper)
        died = MapperRestarts.record_death
        monkeypatch.setattr(
            MapperRestarts, "record_death", lambda self: pauses.append(died(self)) or pauses[-1] / 100
        )
        pauses, told = [], []
        run = EdgeRun(Config(), Link(), None, told.append, MapStore.open(path))
        runs.append(run)
        return run, pauses, told

    yield make
    for run in runs:
        run.stop()
        run.run()


def step_until(run, condition, seconds=30):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        run._step()


def events(told, name):
    return [event["reason"] for event in told if event["event"] == name]


@pytest.mark.long
def test_a_map_that_mappers_die_of_is_set_aside(edge, path):
    before = path.read_bytes()
    run, pauses, told = edge(dies_of_a_map)
    step_until(run, lambda: events(told, "map"))
    assert pauses == [1, 2, 4]
    assert len(events(told, "mapper died")) == 3
    assert "its process ended with exit code 3; restarted in" in events(told, "mapper died")[0]
    reason = "3 mappers in a row have died while restoring it"
    line = f"the map file is renamed to room.sqlite.damaged-1: {reason}; a new one is started"
    assert events(told, "map") == [line]
    assert path.with_name("room.sqlite.damaged-1").read_bytes() == before
    step_until(run, lambda: run._restarts._tries == 0 and run._mapper_process.pid is not None)
    run._update_report()
    assert any(text.startswith("the mapper: its process ended") for text in run.report()["trouble"])
    deadline = time.monotonic() + 0.5
    step_until(run, lambda: time.monotonic() > deadline)
    assert len(pauses) == 3  # the next lives
    assert run._restarts.writable
    with MapStore.read(path.with_name("room.sqlite.damaged-1")) as old:
        assert len(old.load().keyframes) == 40


@pytest.mark.long
def test_a_mapper_that_dies_of_something_else_keeps_its_map(edge, path):
    run, pauses, told = edge(dies_later)
    step_until(run, lambda: len(pauses) == 5)
    assert pauses == [1, 2, 4, 8, 16]
    assert not events(told, "map")
    assert not path.with_name("room.sqlite.damaged-1").exists()


def test_answers_to_an_earlier_session_are_discarded(edge):
    """A ticket of the earlier map writer would acknowledge what the new one has not written."""
    run, _, _ = edge(dies_later)
    run._post(edge_module.ChangesSaved(10**6))
    run._restart_mapping("its process was ended")
    run._handle_answers()
    assert run._state_machine._durability._saved_ticket == 0


class Store:
    def __init__(self, load, writable=True):
        self.load, self.writable, self.asides = load, writable, 0

    def set_aside(self):
        self.asides += 1
        return Path("m.damaged-1")


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


def test_a_damaged_read_only_map_is_no_longer_used():
    said = []
    restarts = MapperRestarts(Store(raises(ValueError("x")), writable=False), 0.05, said.append)
    assert restarts.load_map() == (None, [])
    assert restarts.store is None
    assert said == ["the map file is no longer used: ValueError: x; nothing is saved"]


def test_runs_without_a_credential_are_unknown_to_an_edge_with_keys(path):
    """Of the map of `small_map`, a key speaks for Ann."""
    for has_keys, bob in ((True, None), (False, "")):
        store = MapStore.read(path)
        kept, known = MapperRestarts(store, 0.05, print, has_keys).load_map()
        voices = {run.run_key: run.credential for run in kept.runs}
        assert voices == {run.key: run.credential for run in known} == {ANN: "key of ann", BOB: bob}


def test_a_failing_disk_does_not_set_the_map_aside():
    store = Store(raises(StoreError("the map cannot be read: disk I/O error")))
    with pytest.raises(StoreError):
        MapperRestarts(store, 0.05, print).load_map()
    assert store.asides == 0


def test_the_edge_waits_for_a_disk_that_cannot_be_read(edge, monkeypatch):
    run, _, told = edge(dies_later)
    found = run._restarts.load_map
    monkeypatch.setattr(
        run._restarts, "load_map", raises(StoreError("room: the map cannot be read: disk I/O error"))
    )
    run._restart_mapping("its process was ended")
    assert events(told, "map") == ["room: the map cannot be read: disk I/O error; retried in 0.01 s"]
    monkeypatch.setattr(run._restarts, "load_map", found)
    step_until(run, lambda: run._restart_due_s is None)
    assert run._mapper_process is not None


def counts(inbox, answer, settings):
    """A mapper that has looked up seven keyframes and dies."""
    answer(MapperReport({"loops": {"tried": 7, "accepted": 2}, "place_ms": {"n": 7}, "maps": {}}))
    time.sleep(0.1)
    os._exit(3)


@pytest.mark.long
def test_counters_continue_after_a_mapper_died(edge):
    run, _, told = edge(counts)
    for dead in range(1, 4):
        step_until(run, lambda dead=dead: len(events(told, "mapper died")) >= dead)
        run._update_report()
        assert run.report()["loops"] == {"tried": 7 * dead, "accepted": 2 * dead}
        assert run.report()["place_ms"]["n"] == 7 * dead


def test_a_dead_tracker_is_trouble_of_its_agent(monkeypatch):
    """Not the edge's: whoever could end one by its frames would have /health say 503."""
    settings = Config(edge=EdgeConfig(policy="streamed"))
    run = EdgeRun(settings, Link(), None, lambda fields: None)
    try:
        run._inbox.put(TrackerLost("ann-0001", 0, "was ended by SIGKILL"))
        run._step()
        run._update_report()
        assert run.report()["trouble"] == []
        assert run.report()["refused"] == ["agent's run ann-0001: its tracker was ended by SIGKILL"]
    finally:
        run.stop()
        run.run()


def test_a_failed_report_is_shown_as_stale(edge, monkeypatch):
    run, _, told = edge(dies_later)
    step_until(run, run.report)
    report = run._state_machine.report
    monkeypatch.setattr(run._state_machine, "report", lambda mapped: report({})["nobody"])
    monkeypatch.setattr(edge_module, "_STALE_REPORT_S", 0.2)
    step_until(run, lambda: any("stuck" in line for line in run.report()["trouble"]))
    assert [line["event"] for line in told].count("internal error") == 1
    monkeypatch.setattr(run._state_machine, "report", report)
    step_until(run, lambda: not any("stuck" in line for line in run.report()["trouble"]))
