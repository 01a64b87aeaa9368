"""A mapper with a restored map has the same maps, and continues."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.edge_sim import Person, walls
from helpers.hellos import hello_of

from share.config import Config
from share.geometry import se3
from share.mapping.graph.solver import PoseGraphSolver
from share.mapping.map_changes import MapChange, RemoveKeyframes, SaveKeyframe, SaveRun, StoredMap
from share.mapping.mapper import Mapper
from share.mapping.recognition import verification
from share.protocol.peer import restored_runs
from share.store.map_store import MapStore
from share.types import AgentKind, Keyframe

ROOM = walls(1)
STEPS = 20


class Session:
    """A mapper, its solver, and the changes to store."""

    def __init__(self, config: Config) -> None:
        self.mapper, self.solver = Mapper(config), PoseGraphSolver()
        self.changes: list[MapChange] = []

    def join(self, person: Person) -> None:
        self.mapper.add_run(person.name, person.hello)
        self.changes.append(SaveRun(person.name, person.hello))

    def step(self, person: Person) -> None:
        """Add a keyframe of each, and run all steps."""
        before = person.T_odom_body[-1] if person.T_odom_body else None
        T, view = person.step()
        id = len(person.T_odom_body) - 1
        T_ref_body = T if before is None else se3.inverse(before) @ T
        keyframe = Keyframe(id, id - 1, id * 10**8, T_ref_body, 4e-6 * np.eye(6), T, np.zeros(3), 0.0, view)
        self.changes.append(SaveKeyframe(person.name, keyframe))
        self.mapper.add_keyframe(person.name, keyframe)
        self.work()

    def work(self) -> None:
        while (look := self.mapper.next_lookup()) is not None:
            self.mapper.finish_step(look, look.run(), 1.0)
        while (solve := self.mapper.next_solve()) is not None:
            self.mapper.finish_step(solve, solve.run(self.solver), 1.0)
        self.changes += self.mapper.take_changes()


def after_a_walk(config: Config, first: AgentKind = AgentKind.AR) -> tuple[Session, list[Person]]:
    people = [Person("ann", ROOM, 0.0, 11, first), Person("bob", ROOM, 0.3, 22)]
    session = Session(config)
    for person in people:
        session.join(person)
    for _ in range(STEPS):
        for person in people:
            session.step(person)
    return session, people


def restarted(session: Session, path: Path, config: Config) -> Session:
    with MapStore.open(path) as store:
        store.write([*session.changes, session.mapper.current_poses()])
    with MapStore.open(path) as store:
        kept = store.load()
    second = Session(config)
    second.mapper.restore(kept)
    for run, name in zip(restored_runs(kept, 0.05), ("ann", "bob"), strict=True):
        published = run.last_correction_event  # before the mapper has said anything, and the same as it would
        assert published is not None and published.correction is not None
        correction = published.correction
        assert (published.agent, correction.map_id) == (name, second.mapper.atlas.current_map_id(name))
        T_map_odom = second.mapper.atlas.T_map_odom(name)
        assert np.allclose(correction.T_map_odom, T_map_odom, atol=1e-9)
        T_odom_body = [found.keyframe.T_odom_body for found in kept.keyframes if found.run_key == name][-1]
        at_body = se3.compose_cov(T_odom_body, correction.cov, np.zeros((6, 6)))
        known_m = 0.0 if correction.map_id.startswith(name) else 0.05  # in its own map the pose is exact
        assert se3.position_sigma(at_body) == pytest.approx(known_m, abs=1e-9)
    return second


@pytest.mark.long
@pytest.mark.parametrize("most", [2000, 32])
def test_a_restored_mapper_has_the_same_maps_and_continues(tmp_path: Path, most: int) -> None:
    config = Config()
    config = replace(config, edge=replace(config.edge, max_keyframes=most))
    first, people = after_a_walk(config)
    second = restarted(first, tmp_path / "room.sqlite", config)
    report, before = second.mapper.report(), first.mapper.report()
    assert report["maps"] == before["maps"]
    assert report["loops"]["in_map"] == before["loops"]["in_map"] > 0
    assert sum(report["maps"].values()) <= 1.05 * most
    there, then = second.mapper.current_poses(), first.mapper.current_poses()
    assert (there.keys, there.map_ids) == (then.keys, then.map_ids)
    assert np.array_equal(there.T_map_body, then.T_map_body)
    solve = second.mapper.next_solve()  # everything is solved anew, from where it was
    assert solve is not None
    found = second.mapper.finish_step(solve, solve.run(second.solver), 1.0)
    published = {one.agent: one.correction.map_id for one in found if one.correction is not None}
    assert published == dict.fromkeys(("ann", "bob"), "ann/0")  # they are not back yet
    second.work()
    assert np.abs(second.mapper.current_poses().T_map_body - then.T_map_body).max() < 0.02
    for _ in range(6):
        for person in people:
            second.step(person)
    assert len(second.mapper.report()["maps"]) == len(before["maps"])
    assert second.mapper.report()["loops"]["accepted"] > 0


@pytest.mark.long
def test_keyframes_that_show_what_is_gone_are_removed_with_the_next_one(tmp_path: Path) -> None:
    """Also from the file; what a new keyframe stands for is compared only where it is from today."""
    session, people = after_a_walk(Config())
    second = restarted(session, tmp_path / "room.sqlite", Config())
    atlas, removed = second.mapper.atlas, [5, 6]
    keys = [atlas.key(n) for n in removed]
    second.work()
    atlas.renewal._outdated = dict.fromkeys(removed)
    second.step(people[0])
    assert not {*removed} & atlas.graph.poses.keys()
    changes = [change for change in second.changes if isinstance(change, RemoveKeyframes)]
    assert {key for change in changes for key in change.keys} == {*keys}
    assert atlas.overlap_check.is_earlier(7)
    assert not atlas.overlap_check.is_earlier(max(atlas.graph.poses))


@pytest.mark.long
@pytest.mark.parametrize(("first", "reference"), [(AgentKind.AR, "ann/0"), (AgentKind.ROBOT, "bob/0")])
def test_the_reference_segment_is_a_headsets_and_stays_after_a_restart(
    tmp_path: Path, first: AgentKind, reference: str
) -> None:
    """Also after a restart, whichever agent comes then."""
    session, _ = after_a_walk(Config(), first)
    assert list(session.mapper.report()["maps"]) == [reference]
    second = restarted(session, tmp_path / "room.sqlite", Config())
    assert list(second.mapper.report()["maps"]) == [reference]
    eve = Person("eve", ROOM, 0.6, 33)
    second.join(eve)
    for _ in range(STEPS):
        second.step(eve)
    assert list(second.mapper.report()["maps"]) == [reference]


@pytest.mark.slow
def test_maps_of_an_earlier_session_merge_as_those_of_one(tmp_path: Path) -> None:
    """The robot's map into the headset's, though it is older."""
    config = Config()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verification, "MIN_MATCHES", 10**6)  # no loop is verified
        session, people = after_a_walk(config, AgentKind.ROBOT)
    assert list(session.mapper.report()["maps"]) == ["ann/0", "bob/0"]
    second = restarted(session, tmp_path / "room.sqlite", config)
    for _ in range(STEPS):
        for person in people:
            second.step(person)
    assert list(second.mapper.report()["maps"]) == ["bob/0"]


def test_a_run_without_keyframes_is_restored(tmp_path: Path) -> None:
    config = Config()
    session = Session(config)
    session.join(Person("ann", ROOM, 0.0, 11))
    with MapStore.open(tmp_path / "room.sqlite") as store:
        store.write(session.changes)
        kept = store.load()
    Mapper(config).restore(kept)
    assert [run.last_correction_event for run in restored_runs(kept, 0.05)] == [None]


def test_a_segment_whose_run_was_lost_is_restored() -> None:
    """As a damaged file leaves it."""
    Mapper(Config()).restore(StoredMap(segments=("ann/0",)))


@pytest.mark.slow
@pytest.mark.long
def test_a_merge_whose_poses_were_not_stored_is_not_published_as_before(tmp_path: Path) -> None:
    """The edge is killed within seconds of a merge: loops are stored at once, poses periodically."""
    config = Config()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verification, "MIN_MATCHES", 10**6)  # no loop is verified
        apart, _ = after_a_walk(config)
    before = apart.mapper.current_poses()
    assert set(before.map_ids) == {"ann/0", "bob/0"}
    with MapStore.open(tmp_path / "room.sqlite") as store:
        store.write([*after_a_walk(config)[0].changes, before])
    with MapStore.open(tmp_path / "room.sqlite") as store:
        kept = store.load()
    assert len(kept.loops) > 0
    assert [run.last_correction_event for run in restored_runs(kept, 0.05)] == [None, None]


def test_runs_whose_keyframes_a_damaged_file_has_lost_are_reported():
    mapper = Mapper(Config())
    run = SaveRun("ann-1234", hello_of("ann", 1))
    mapper.restore(StoredMap(runs=(run,), segments=("ann-1234/0",)))
    assert mapper.report()["agents"]["ann-1234"]["map_id"] == "ann-1234/0"
    assert not mapper.report()["maps"]
