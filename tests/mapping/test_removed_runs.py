"""With any number of runs of a name the map, its file and the edge stay bounded."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.hellos import hello_of

from share.config import Config
from share.geometry import se3
from share.mapping.corrections import map_assignment
from share.mapping.forgetting import DAY_S
from share.mapping.loops import KeyframeKey, Loop
from share.mapping.map_changes import RemoveKeyframes, RemoveRun
from share.mapping.mapper import Mapper
from share.protocol import edge_events as ed
from share.protocol.common_events import Tick
from share.protocol.edge import EdgeProtocol
from share.protocol.peer import restored_runs
from share.store.map_store import MapStore
from share.types import F64, Keyframe, View
from share.wire import messages as m
from share.wire.codec import decode, encode

S = 1_000_000_000
EMPTY = View(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 32), np.uint8))
MOST = 60
CONFIG = replace(Config(), edge=replace(Config().edge, max_keyframes=MOST, keep_days=1.0))
NOW_S = 1_800_000_000.0


def at(x: float) -> F64:
    return se3.from_rt(np.eye(3), np.array([x, 0.0, 0.0]))


class Session:
    """An edge, its mapper, and the map's file."""

    def __init__(self, store: MapStore, session: int = 7) -> None:
        kept = store.load()
        self.store, self.mapper = store, Mapper(CONFIG)
        restored = restored_runs(kept, 0.05)
        self.edge = EdgeProtocol(CONFIG, session, True, restored, forgotten=kept.forgotten)
        if kept.runs:
            self.mapper.restore(kept)
        self.sent: list[m.Message] = []
        self.left_out: list[type] = []  # changes that the disk loses
        self.now_ns = S

    def handle(self, event: ed.EdgeEvent) -> None:
        for effect in self.edge.handle(event, self.now_ns):
            match effect:
                case ed.SendToPeer():
                    self.sent.append(decode([bytes(f) for f in effect.frames]))
                case ed.AddRun():
                    self.mapper.add_run(effect.key, effect.hello)
                case ed.SetPresence():
                    self.mapper.set_present(effect.key, effect.is_present)
                case ed.DropRun():
                    self.mapper.remove_run(effect.key)
                case ed.AddKeyframe():
                    self.mapper.add_keyframe(effect.key, effect.keyframe)
                case ed.SaveChanges():
                    self.store.write([c for c in effect.changes if type(c) not in self.left_out])
                    self.handle(ed.ChangesSaved(effect.ticket))
        changes, emptied = self.mapper.take_changes(), self.mapper.take_empty_runs()
        if changes or emptied:
            self.handle(ed.MapperResult((), changes, emptied))

    def tell(self, run_id: int, message: m.Message) -> None:
        self.handle(ed.PeerMessageReceived(m.peer_id(run_id), [bytes(f) for f in encode(message)]))

    def run(self, name: str, run_id: int, count: int, stays: bool = False) -> None:
        """A run with `count` keyframes, 1 m apart, which leaves unless it `stays`."""
        self.tell(run_id, hello_of(name, run_id))
        for k in range(count):
            step = at(k) if k == 0 else at(1.0)
            up = np.zeros(3)
            self.tell(run_id, Keyframe(k, k - 1, k * S, step, 1e-6 * np.eye(6), at(k), up, 0.0, EMPTY, k - 1))
        if not stays:
            self.tell(run_id, m.Bye())
        self.now_ns += 10 * S
        self.tell(1, m.Ping(0, 0))  # ann is still there
        self.handle(Tick())

    def held(self) -> Counter[str]:
        return Counter(key.agent.partition("-")[0] for key in self.mapper.current_poses().keys)


def crowded(store: MapStore, runs: int = 30) -> Session:
    """30 keyframes of ann, and small runs of eve, one after the other."""
    session = Session(store)
    session.run("ann", 1, 30, stays=True)
    for k in range(runs):
        session.run("eve", 100 + k, 8)
    return session


@pytest.mark.long
def test_any_number_of_runs_take_no_keyframe_of_others_and_leave_nothing(tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = crowded(store)
        report = session.edge.report(session.mapper.report())
        assert session.held()["ann"] == 30
        assert len(session.mapper.current_poses().keys) <= 1.05 * MOST
        assert len(report["agents"]) == len(session.mapper.report()["agents"]) <= 6
        assert report["forgotten_runs"] + len(report["agents"]) == 31
        assert report["maps"].keys() == {f"{run}/0" for run in session.mapper.report()["agents"]}
        kept = store.load()
    assert {run.run_key for run in kept.runs} == session.mapper.report()["agents"].keys()
    assert {k.keyframe_key for k in kept.keyframes} == set(session.mapper.current_poses().keys)
    assert {name.rpartition("/")[0] for name in kept.segments} == {run.run_key for run in kept.runs}
    assert kept.problems == ()


@pytest.mark.long
def test_the_remaining_map_is_restored(tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = crowded(store)
    with MapStore.open(tmp_path / "room.sqlite") as store:
        second = Session(store, session=8)
        assert second.mapper.report()["maps"] == session.mapper.report()["maps"]
        for k in range(10):
            second.run("eve", 300 + k, 8)
        assert second.held()["ann"] == 30
        assert len(second.mapper.current_poses().keys) <= 1.05 * MOST


def keyframes_of(store: MapStore, run_id: int) -> set[int]:
    """Ids of eve's keyframes of this run in the file."""
    run = f"eve-{m.public_tag(run_id)[:4]}"
    return {k.keyframe_key.id for k in store.load().keyframes if k.run_key == run}


def returned(session: Session, run_id: int, count: int) -> list[m.Message]:
    """A run of eve says hello, sends its first `count` keyframes again, and two new ones. Return the
    answers."""
    session.sent.clear()
    session.tell(run_id, hello_of("eve", run_id))
    for k in range(count + 2):
        step, before = (at(k), -1) if k == 0 else (at(1.0), k - 1)
        own = Keyframe(k, before, k * S, step, 1e-6 * np.eye(6), at(k), np.zeros(3), 0.0, EMPTY, k - 1)
        session.tell(run_id, own)
    return session.sent


@pytest.mark.parametrize("restarts", [False, True])
def test_a_removed_run_that_returns_goes_on_with_new_keyframes(tmp_path: Path, restarts: bool) -> None:
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = Session(store)
        session.run("ann", 1, 2, stays=True)
        session.run("eve", 100, 8)
        emptied(session, 100)
        assert [run.hello.name for run in store.load().runs] == ["ann"]
        session = Session(store, session=8) if restarts else session
        session.now_ns += 100 * S
        answers = returned(session, 100, 8)
        assert m.Welcome(8 if restarts else 7, 8) in answers
        assert [one.next_keyframe for one in answers if isinstance(one, m.Ack)] == [8] * 8 + [9, 10]
        assert keyframes_of(store, 100) == {8, 9}
        held = {key.id for key in session.mapper.current_poses().keys if key.agent.startswith("eve")}
        assert held == {8, 9}
        assert store.load().problems == ()
        third = Session(store, session=9)
        third.now_ns += 200 * S
        assert m.Welcome(9, 10) in returned(third, 100, 10)
        assert keyframes_of(store, 100) == {8, 9, 10, 11}


def test_a_run_that_returned_and_left_without_a_keyframe_is_still_known(tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = Session(store)
        session.run("ann", 1, 2, stays=True)
        session.run("eve", 100, 8)
        emptied(session, 100)
        session.run("eve", 100, 0)
        for k in range(300):  # so that it is no longer among the runs that left without a keyframe
            session.run(f"n{k}", 1000 + k, 0)
        assert "eve" not in session.edge.report({})["agents"]
        assert m.Welcome(7, 8) in returned(session, 100, 8)


def test_a_connected_run_whose_keyframes_expired_is_known_after_a_restart(tmp_path: Path) -> None:
    """The file has its row, and no keyframe of it."""
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = Session(store)
        session.run("eve", 100, 8, stays=True)
        session.tell(100, m.Ping(0, 0))
        for late_s in (0, DAY_S):
            session.handle(ed.MapperResult(tuple(session.mapper.expire(NOW_S + late_s))))
        assert [run.hello.name for run in store.load().runs] == ["eve"]
        assert keyframes_of(store, 100) == set()
        second = Session(store, session=8)
        assert m.Welcome(8, 8) in returned(second, 100, 8)
        assert keyframes_of(store, 100) == {8, 9}


def test_removed_keyframes_at_the_end_of_a_run_are_not_requested_again(tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = Session(store)
        session.run("ann", 1, 2, stays=True)
        session.run("eve", 100, 20)
        session.run("eve", 101, 1)
        atlas, eve = session.mapper.atlas, f"eve-{m.public_tag(100)[:4]}"
        newest = {(eve, k) for k in range(8, 20)}
        session.mapper.remove_keyframes([n for n in atlas.graph.poses if atlas.key(n) in newest])
        session.handle(Tick())
        assert keyframes_of(store, 100) == set(range(8))
        second = Session(store, session=8)
        assert m.Welcome(8, 20) in returned(second, 100, 20)
        assert keyframes_of(store, 100) == {*range(8), 20, 21}
        assert second.edge.report({})["agents"]["eve"]["suspect_keyframes"] == 0


def test_a_forgotten_run_that_only_pings_is_asked_for_a_hello(tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = Session(store)
        session.run("ann", 1, 2, stays=True)
        session.run("eve", 100, 8)
        emptied(session, 100)
        for run_id in (100, 999):  # 999: never joined, as far as the edge knows
            session.tell(run_id, m.Ping(1, 0))
            pong = session.sent[-1]
            assert isinstance(pong, m.Pong) and pong.session == m.NO_SESSION
        returned(session, 100, 8)
        session.tell(100, m.Ping(2, 0))
        pong = session.sent[-1]
        assert isinstance(pong, m.Pong) and pong.session == 7


def test_corrections_of_a_run_that_returns_are_newer_than_those_before(tmp_path: Path) -> None:
    """Its agent has not noticed, and leaves out corrections that seem older."""
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = Session(store)
        session.run("ann", 1, 2, stays=True)
        assert revisions(session, 100, 3) == [1, 2, 3]
        session.tell(100, m.Bye())
        emptied(session, 100)
        session.now_ns += 100 * S
        assert revisions(session, 100, 1) == [4]


def revisions(session: Session, run_id: int, count: int) -> list[int]:
    """A run of eve comes with keyframes and is sent so many corrections. Return their revisions."""
    returned(session, run_id, 1)
    key = f"eve-{m.public_tag(run_id)[:4]}"
    for _ in range(count):
        session.handle(ed.MapperResult((map_assignment(key, f"{key}/0", np.eye(4), 2),)))
    return [one.revision for one in session.sent if isinstance(one, m.Correction)]


def test_a_run_that_returns_before_it_is_removed_continues(tmp_path: Path) -> None:
    """A report of the mapper from before its return has no effect."""
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = crowded(store, runs=6)
        gone = next(run for run in session.mapper.report()["agents"] if run.startswith("eve"))
        step = Keyframe(8, 7, 8 * S, at(1.0), 1e-6 * np.eye(6), at(8), np.zeros(3), 0.0, EMPTY, 7)
        number = next(k for k in range(6) if f"-{m.public_tag(100 + k)[:4]}" in gone)
        session.tell(100 + number, hello_of("eve", 100 + number))
        session.tell(100 + number, step)
        session.handle(ed.MapperResult((), (), (ed.KeyframeKey(gone, 7),)))
        session.tell(100 + number, m.Bye())
        session.handle(Tick())
        assert gone in session.mapper.report()["agents"]


def test_a_run_that_returns_is_reconnected_in_the_file_too(tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = Session(store)
        for name, run_id, count in (("ann", 1, 2), ("eve", 100, 20), ("eve", 101, 1)):
            session.run(name, run_id, count, stays=name == "ann")
        atlas = session.mapper.atlas
        key = next(key.agent for key in atlas.all_poses().keys if key.id == 19)
        newer = {(key, k) for k in range(8, 20)}
        session.mapper.remove_keyframes([n for n in atlas.graph.poses if atlas.key(n) in newer])
        session.handle(Tick())
        session.tell(100, hello_of("eve", 100))
        session.tell(
            100, Keyframe(20, 19, 20 * S, at(1.0), 1e-6 * np.eye(6), at(20), np.zeros(3), 0.0, EMPTY, 19)
        )
        kept = store.load()
        link = kept.links[ed.KeyframeKey(key, 20)]
        assert (link.reference, link.T_ref_body[0, 3]) == (7, 13.0)
        second = Session(store, session=8)
        assert np.allclose(
            second.mapper.current_poses().T_map_body, session.mapper.current_poses().T_map_body
        )
        covs = [
            one.atlas.graph.odometry_edge(*one.atlas.graph.odometry.segments[1].nodes[-2:]).cov
            for one in (session.mapper, second.mapper)
        ]
        assert np.allclose(covs[0], covs[1])


def test_a_run_is_removed_after_a_crash_before_its_removal(tmp_path: Path) -> None:
    """Its keyframes were removed from the file, the run itself was not."""
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = crowded(store, runs=2)
        gone = next(run for run in session.mapper.report()["agents"] if run.startswith("eve"))
        keys = tuple(k.keyframe_key for k in store.load().keyframes if k.run_key == gone)
        store.write([RemoveKeyframes(keys)])
        second = Session(store, session=8)
        assert gone in second.mapper.report()["agents"]
        second.handle(Tick())
        assert gone not in second.mapper.report()["agents"]
        assert gone not in {run.run_key for run in store.load().runs}
        store.write([RemoveRun(gone)])  # again: nothing happens
        assert len(store.load().runs) == 2


def test_a_run_left_by_such_a_crash_goes_on_with_new_keyframes(tmp_path: Path) -> None:
    """Its agent connects first, and sends the removed keyframes once more."""
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = crowded(store, runs=1)
        gone = next(run for run in session.mapper.report()["agents"] if run.startswith("eve"))
        store.write(
            [RemoveKeyframes(tuple(k.keyframe_key for k in store.load().keyframes if k.run_key == gone))]
        )
        second = Session(store, session=8)
        assert returned(second, 100, 8)[0] == m.Welcome(8, 8)
        assert keyframes_of(store, 100) == {8, 9}


def test_runs_without_a_keyframe_are_removed_from_the_mapper(tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = Session(store)
        session.run("ann", 1, 2, stays=True)
        for k in range(300):
            session.run(f"n{k}", 1000 + k, 0)
        assert len(session.mapper.report()["agents"]) <= 258


def test_a_restored_run_without_keyframes_is_removed(tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = Session(store)
        session.run("ann", 1, 30, stays=True)
        session.run("eve", 100, 5)
        session.run("eve", 101, 3)
        session = Session(store, session=8)
        for k in range(12):
            session.run("eve", 300 + k, 8)
        report = session.edge.report(session.mapper.report())
        held = {key.agent for key in session.mapper.current_poses().keys}
        kept = store.load()
    assert {run.run_key for run in kept.runs} == {agent["run"] for agent in report["agents"].values()}
    assert {run.run_key for run in kept.runs} - held <= {f"ann-{m.public_tag(1)[:4]}"}


def emptied(session: Session, run_id: int) -> None:
    """Remove all keyframes of a run of eve."""
    atlas, run = session.mapper.atlas, f"eve-{m.public_tag(run_id)[:4]}"
    session.mapper.remove_keyframes([n for n in atlas.graph.poses if atlas.key(n).agent == run])
    for _ in range(2):
        session.handle(Tick())


def test_a_run_that_returned_stays_the_current_one_of_its_name(tmp_path: Path) -> None:
    """Also when the later run of the name is removed: the edge ended with a KeyError."""
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = Session(store)
        session.run("ann", 1, 30, stays=True)
        session.run("eve", 100, 5)
        session.run("eve", 101, 3)
        session.tell(100, hello_of("eve", 100))
        emptied(session, 101)
        report = session.edge.report(session.mapper.report())
    assert report["agents"]["eve"]["run"] == f"eve-{m.public_tag(100)[:4]}"
    assert report["forgotten_runs"] == 1


def test_the_report_shows_the_run_before_a_removed_one(tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = Session(store)
        session.run("ann", 1, 30, stays=True)
        session.run("eve", 100, 5)
        session.tell(101, hello_of("eve", 101))
        for k in range(256):  # which have no keyframe either, so the oldest of all is forgotten
            session.tell(1000 + k, hello_of(f"n{k}", 1000 + k))
            session.tell(1000 + k, m.Bye())
            session.now_ns += 10 * S
            session.tell(1, m.Ping(0, 0))
            session.handle(Tick())
        session.tell(100, m.Bye())  # or it would not be listed: more names came later
        report = session.edge.report(session.mapper.report())
    assert report["agents"]["eve"]["run"] == f"eve-{m.public_tag(100)[:4]}"


def test_a_run_is_removed_only_with_its_last_segment(tmp_path: Path) -> None:
    """Two segments, of 9 and 3 keyframes; the newer is removed first."""
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = Session(store)
        session.run("ann", 1, 2, stays=True)
        session.tell(100, hello_of("eve", 100))
        for k in range(12):
            before, T = (-1, at(k)) if k in (0, 9) else (k - 1, at(1.0))
            own = Keyframe(k, before, k * S, T, 1e-6 * np.eye(6), at(k), np.zeros(3), 0.0, EMPTY, k - 1)
            session.tell(100, own)
        session.tell(100, m.Bye())
        session.run("eve", 101, 2)
        gone = next(key.agent for key in session.mapper.current_poses().keys if key.id == 11)

        def leave(ids: range) -> None:
            keys, atlas = {(gone, k) for k in ids}, session.mapper.atlas
            session.mapper.remove_keyframes([n for n in atlas.graph.poses if atlas.key(n) in keys])
            session.handle(Tick())
            session.handle(Tick())

        leave(range(9, 12))
        assert {k.keyframe_key.id for k in store.load().keyframes if k.run_key == gone} == set(range(9))
        assert gone in session.mapper.report()["agents"]
        leave(range(9))
        assert (
            gone not in {run.run_key for run in store.load().runs} | session.mapper.report()["agents"].keys()
        )


def test_a_run_that_returns_without_keyframes_is_sent_a_map_of_its_own(tmp_path: Path) -> None:
    """It was in ann's map; all its keyframes were removed while it was absent."""
    with MapStore.open(tmp_path / "room.sqlite") as store:
        session = Session(store)
        session.run("ann", 1, 20, stays=True)
        session.run("eve", 100, 5)
        atlas, mapper = session.mapper.atlas, session.mapper
        ann, eve = sorted({key.agent for key in mapper.current_poses().keys})
        atlas.graph.add_loop(Loop(KeyframeKey(ann, 3), KeyframeKey(eve, 3), np.eye(4), 1e-4 * np.eye(6), 50))
        assert atlas.current_map_id(eve) == f"{ann}/0"
        atlas.remove_keyframes([n for n in range(len(atlas)) if atlas.key(n).agent == eve])
        mapper.set_present(eve, True)
        own = Keyframe(5, 4, 5 * S, at(1.0), 1e-6 * np.eye(6), at(5), np.zeros(3), 0.0, EMPTY, 4)
        (map_event,) = mapper.add_keyframe(eve, own)
        assert map_event.correction is not None
        assert (map_event.agent, map_event.correction.map_id) == (eve, f"{eve}/0")
        assert np.allclose(map_event.correction.T_map_odom, np.eye(4))
        step = Keyframe(6, 5, 6 * S, at(1.0), 1e-6 * np.eye(6), at(6), np.zeros(3), 0.0, EMPTY, 5)
        assert mapper.add_keyframe(eve, step) == []
