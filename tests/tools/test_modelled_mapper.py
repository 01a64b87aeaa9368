"""The modelled mapper has the latencies and rates of the real one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from helpers.edge_sim import Person, walls
from helpers.experiments import experiment
from helpers.room_simulation import MS, tracked_frames

from share.config import NEAR_M, Config, EdgeConfig
from share.geometry import se3
from share.lab.evaluate.emulated_network import NETWORK_PRESETS
from share.lab.evaluate.processing_delays import ProcessingDelays
from share.lab.evaluate.simulation import Simulation
from share.protocol.agent_events import LocalisedPose
from share.types import F64

modelled_mapper = experiment("modelled_mapper")
ROOM = walls(1)
SECONDS = 6.0
USUAL = modelled_mapper.RecognitionModel()


def played(
    policy: str = "covins-g", seed: int = 0, model: object = USUAL, apart_m: float = 0.0
) -> Simulation:
    """Ann and Bob in one room, half a wall and apart_m apart. model: None for the real mapper."""
    people = {name: Person(name, ROOM, at, run) for name, at, run in (("ann", 0.0, 11), ("bob", 0.5, 22))}
    frames = {name: list(tracked_frames(person, SECONDS)) for name, person in people.items()}
    stamps_ns = {name: [f.arrival_ns for f in frames[name] if f.candidate] for name in people}
    config = Config(edge=EdgeConfig(policy=policy))
    rigs = {name: person.hello.rig for name, person in people.items()}
    there = {name: np.array(person.T_world_body) for name, person in people.items()}
    there["bob"][:, 0, 3] += apart_m
    truth = modelled_mapper.GroundTruth(NEAR_M, config.control.far_m, rigs, there)
    mapper = model and modelled_mapper.ModelledMapper(
        config, truth, lambda name, ns: stamps_ns[name].index(ns), model, seed
    )
    agents = [(p.hello, iter(frames[n]), NETWORK_PRESETS["wifi5"]) for n, p in people.items()]
    made = Simulation(config, agents, ProcessingDelays(), seed, mapper)
    made.run(SECONDS + 1.0)
    return made


def latencies_ms(room: Simulation) -> tuple[float, float]:
    """Return the mean latency of both agents, and of Ann's corrections."""
    reports = {name: log.report() for name, log in room.logs.items()}
    everyone = float(np.mean([one["latency_ms"]["mean"] for one in reports.values()]))
    return everyone, reports["ann"]["corrected_ms"]["mean"]


@pytest.mark.slow
def test_latencies_are_those_of_the_real_mapper() -> None:
    room = played()
    report = room.edge.report(room.mapper.report())
    assert list(report["maps"].values()) == [48]
    assert {name: agent["keyframes"] for name, agent in report["agents"].items()} == {"ann": 24, "bob": 24}
    assert report["merges"]["skipped"] == 0 < report["merges"]["done"]
    model_ms, real_ms = (
        np.mean([latencies_ms(played(seed=k, model=model)) for k in range(3)], axis=0)
        for model in (USUAL, None)
    )
    # Of all: fewer of Bob's are verified, where they share little.
    assert model_ms[0] == pytest.approx(real_ms[0], rel=0.25)
    assert model_ms[1] == pytest.approx(real_ms[1], rel=0.15)


def first_in_map(poses: Sequence[LocalisedPose], map_id: str | None, person: Person) -> F64:
    """T_map_world (4, 4) by an agent's first pose in this map."""
    first = next(pose for pose in poses if pose.map_id == map_id and pose.T_map_odom is not None)
    return first.T_map_odom @ first.T_odom_body @ se3.inverse(person.T_world_body[first.index // 5])


@pytest.mark.long
def test_a_corrected_pose_is_the_truth_plus_the_drawn_error() -> None:
    """The first in the map of the other: later ones follow the corrections, and average their errors."""
    sure = modelled_mapper.RecognitionModel(sigma_m=0.0, sigma_rad=0.0)
    for model, most_m in ((sure, 0.03), (replace(sure, sigma_m=0.5), 3.0)):
        room = played(model=model)
        people = {"ann": Person("ann", ROOM, 0.0, 11), "bob": Person("bob", ROOM, 0.5, 22)}
        for person in people.values():
            list(tracked_frames(person, SECONDS))
        (map_id,) = {poses[-1].map_id for poses in room.localised.values()}
        T_map_world = {
            name: first_in_map(poses, map_id, people[name]) for name, poses in room.localised.items()
        }
        off_m = np.linalg.norm((se3.inverse(T_map_world["ann"]) @ T_map_world["bob"])[:3, 3])
        assert off_m < most_m
        assert bool(off_m > 0.03) is (model is not sure)


@pytest.mark.long
def test_the_error_estimate_contains_the_drawn_sigma() -> None:
    for sigma_m in (0.006, 0.02):
        estimate = played(
            model=modelled_mapper.RecognitionModel(sigma_m=sigma_m, sigma_rad=0.0)
        ).edge.series()["ann"]["error_cm"][-1]
        sure = played(model=modelled_mapper.RecognitionModel(sigma_m=0.0, sigma_rad=0.0)).edge.series()[
            "ann"
        ]["error_cm"][-1]
        assert estimate == pytest.approx(np.hypot(100 * sigma_m * np.sqrt(3), sure), rel=0.05)


@pytest.mark.long
def test_views_below_the_required_overlap_are_never_merged() -> None:
    room = played(model=modelled_mapper.RecognitionModel(half_overlap=5.0, logistic_width=0.01))
    report = room.edge.report(room.mapper.report())
    assert report["merges"] == {"requested": 0, "skipped": 0, "done": 0}
    assert sorted(report["maps"].values()) == [24, 24]


@pytest.mark.long
def test_views_without_overlap_are_never_merged() -> None:
    room = played(model=modelled_mapper.RecognitionModel(half_overlap=-1.0), apart_m=1000.0)
    report = room.edge.report(room.mapper.report())
    assert report["merges"]["done"] > 0
    assert sorted(report["maps"].values()) == [24, 24]


@pytest.mark.long
def test_merge_gate_and_rates_are_those_of_the_policy() -> None:
    rooms = [played("share", seed) for seed in range(4)]
    reports = [room.edge.report(room.mapper.report()) for room in rooms]
    assert all(agent["rate_hz"] is not None for report in reports for agent in report["agents"].values())
    assert sum(report["merges"]["skipped"] for report in reports) > 0


@pytest.mark.long
def test_a_run_depends_on_its_seed_alone() -> None:
    first, again, other = (played(seed=seed) for seed in (1, 1, 2))
    assert latencies_ms(first) == latencies_ms(again) != latencies_ms(other)
    assert first.now_ns <= round((SECONDS + 1) * 1000) * MS
