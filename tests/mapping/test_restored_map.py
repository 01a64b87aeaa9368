"""A mapper that is given what an earlier life kept has the same maps, and goes on in them."""

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
from share.mapping.map_changes import MapChange, SaveKeyframe, SaveRun, StoredMap
from share.mapping.mapper import Mapper
from share.protocol.peer import restored_runs
from share.store.map_store import MapStore
from share.types import AgentKind, Keyframe

ROOM = walls(1)
STEPS = 36


class Life:
    """A mapper, its solver, and what it wanted kept."""

    def __init__(self, config: Config) -> None:
        self.mapper, self.solver = Mapper(config), PoseGraphSolver(config.graph)
        self.changes: list[MapChange] = []

    def join(self, person: Person) -> None:
        self.mapper.add_run(person.name, person.hello)
        self.changes.append(SaveRun(person.name, person.hello))

    def step(self, person: Person) -> None:
        """One keyframe on, and all that follows from it."""
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


def walked(config: Config, first: AgentKind = AgentKind.AR) -> tuple[Life, list[Person]]:
    people = [Person("ann", ROOM, 0.0, 11, first), Person("bob", ROOM, 0.3, 22)]
    life = Life(config)
    for person in people:
        life.join(person)
    for _ in range(STEPS):
        for person in people:
            life.step(person)
    return life, people


def again(life: Life, path: Path, config: Config) -> Life:
    with MapStore.open(path) as store:
        store.write([*life.changes, life.mapper.current_poses()])
    with MapStore.open(path) as store:
        kept = store.load()
    second = Life(config)
    second.mapper.restore(kept)
    for run, name in zip(restored_runs(kept, 0.05), ("ann", "bob"), strict=True):
        told = run.last_finding  # before the mapper has said anything, and the same as it would
        assert told is not None and told.correction is not None
        assert (told.agent, told.correction.map_id) == (name, second.mapper.atlas.current_map_id(name))
        T_map_odom = second.mapper.atlas.T_map_odom(name)
        assert np.allclose(told.correction.T_map_odom, T_map_odom, atol=1e-9)
        T_odom_body = [found.keyframe.T_odom_body for found in kept.keyframes if found.run_key == name][-1]
        at_body = se3.compose_cov(T_odom_body, told.correction.cov, np.zeros((6, 6)))
        known_m = 0.0 if told.correction.map_id.startswith(name) else 0.05  # the gauge is his, or another's
        assert se3.position_sigma(at_body) == pytest.approx(known_m, abs=1e-9)
    return second


@pytest.mark.parametrize("most", [2000, 60])
def test_a_restored_mapper_has_the_same_maps_and_continues(tmp_path: Path, most: int) -> None:
    config = Config()
    config = replace(config, edge=replace(config.edge, max_keyframes=most))
    first, people = walked(config)
    second = again(first, tmp_path / "room.sqlite", config)
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
    told = {one.agent: one.correction.map_id for one in found if one.correction is not None}
    assert told == dict.fromkeys(("ann", "bob"), "ann/0")  # they are not back yet
    second.work()
    assert np.abs(second.mapper.current_poses().T_map_body - then.T_map_body).max() < 0.02
    for _ in range(6):
        for person in people:
            second.step(person)
    assert len(second.mapper.report()["maps"]) == len(before["maps"])
    assert second.mapper.report()["loops"]["accepted"] > 0


@pytest.mark.parametrize(("first", "founder"), [(AgentKind.AR, "ann/0"), (AgentKind.ROBOT, "bob/0")])
def test_the_reference_segment_is_a_headsets_and_stays_after_a_restart(
    tmp_path: Path, first: AgentKind, founder: str
) -> None:
    """In a second life too, and whoever comes then."""
    life, _ = walked(Config(), first)
    assert list(life.mapper.report()["maps"]) == [founder]
    second = again(life, tmp_path / "room.sqlite", Config())
    assert list(second.mapper.report()["maps"]) == [founder]
    eve = Person("eve", ROOM, 0.6, 33)
    second.join(eve)
    for _ in range(STEPS):
        second.step(eve)
    assert list(second.mapper.report()["maps"]) == [founder]


@pytest.mark.slow
def test_maps_of_an_earlier_session_merge_as_those_of_one(tmp_path: Path) -> None:
    """The robot's to the headset's, though it is older."""
    config = Config()
    life, people = walked(replace(config, place=replace(config.place, min_inliers=10**6)), AgentKind.ROBOT)
    assert list(life.mapper.report()["maps"]) == ["ann/0", "bob/0"]
    second = again(life, tmp_path / "room.sqlite", config)
    for _ in range(STEPS):
        for person in people:
            second.step(person)
    assert list(second.mapper.report()["maps"]) == ["bob/0"]


def test_a_run_without_keyframes_is_restored(tmp_path: Path) -> None:
    config = Config()
    life = Life(config)
    life.join(Person("ann", ROOM, 0.0, 11))
    with MapStore.open(tmp_path / "room.sqlite") as store:
        store.write(life.changes)
        kept = store.load()
    Mapper(config).restore(kept)
    assert [run.last_finding for run in restored_runs(kept, 0.05)] == [None]


def test_a_segment_whose_run_was_lost_is_restored() -> None:
    """As a damaged file leaves it."""
    Mapper(Config()).restore(StoredMap(segments=("ann/0",)))


def test_a_merge_whose_poses_were_not_stored_is_not_published_as_before(tmp_path: Path) -> None:
    """The edge is killed within seconds of a join: loops are kept at once, poses now and then."""
    config = Config()
    apart, _ = walked(replace(config, place=replace(config.place, min_inliers=10**6)))
    before = apart.mapper.current_poses()
    assert set(before.map_ids) == {"ann/0", "bob/0"}
    with MapStore.open(tmp_path / "room.sqlite") as store:
        store.write([*walked(config)[0].changes, before])
    with MapStore.open(tmp_path / "room.sqlite") as store:
        kept = store.load()
    assert len(kept.loops) > 0
    assert [run.last_finding for run in restored_runs(kept, 0.05)] == [None, None]


def test_runs_whose_keyframes_a_damaged_file_has_lost_are_reported():
    mapper = Mapper(Config())
    run = SaveRun("ann-1234", hello_of("ann", 1))
    mapper.restore(StoredMap(runs=(run,), segments=("ann-1234/0",)))
    assert mapper.report()["agents"]["ann-1234"]["map_id"] == "ann-1234/0"
    assert not mapper.report()["maps"]
