from itertools import pairwise

import numpy as np
import pytest
from helpers.motion_sim import SECONDS, every, floor

from share.errors import UsageError
from share.lab.emulate.motion import crowd as crowds
from share.lab.emulate.motion import walk
from share.lab.emulate.motion.crowd import (
    FixedPath,
    FloorGraphs,
    MotionPreferences,
    SimulatedAgent,
    fixed_path,
    path_length,
    plan_crowd,
)
from share.lab.emulate.motion.motion_plan import PAPER_LENGTHS_M, PAPER_S, paper_agents
from share.lab.emulate.motion.route import POINT_SPACING_M, FloorGraph, arc_length, smooth_route
from share.lab.emulate.motion.schedule import (
    STEP_S,
    MotionLimits,
    MovingObstacle,
    plan_schedule,
    smooth_schedule,
    speed_limit,
)


def straight(length=10.0):
    xy = np.column_stack([np.arange(0, length, POINT_SPACING_M), np.zeros(round(length / POINT_SPACING_M))])
    return walk.Route(xy, arc_length(xy), np.zeros(len(xy)), np.zeros(len(xy)))


@pytest.mark.parametrize("seed", range(3))
def test_tours_keep_clear_of_obstacles_and_are_smooth(seed):
    ground = floor()
    legs = FloorGraph(ground, 0.3).random_tour(40.0, np.random.default_rng(seed))
    assert all(np.allclose(a[-1], b[0]) for a, b in pairwise(legs))
    way = smooth_route(ground, np.concatenate(legs), 0.3)
    assert arc_length(way)[-1] > 30 and ground.clearance_at(way).min() > 0.25
    assert np.linalg.norm(np.diff(way, 2, axis=0), axis=1).max() < 0.7 * POINT_SPACING_M


def test_a_tour_stays_in_the_connected_floor():
    split = floor(blocks=((4, 0, 5, 6),))
    for seed in range(5):
        way = np.concatenate(FloorGraph(split, 0.3).random_tour(10.0, np.random.default_rng(seed)))
        assert len(set((way[:, 0] > 4.5).tolist())) == 1


def test_a_schedule_waits_for_a_crossing_agent():
    way, wanted = straight(), np.full(60, 1.0)
    most = speed_limit(way, MotionLimits(1.2, 2, 2, 1))
    t = np.arange(0, 13, STEP_S / 2)
    crossing = MovingObstacle(np.column_stack([np.full(len(t), 5.0), (t - 5.0) * 0.5]), 0.8)
    alone, polite = (plan_schedule(way, most, wanted, others) for others in ((), (crossing,)))
    gone = smooth_schedule(polite, t[:-10])
    apart = np.linalg.norm(np.column_stack([gone, 0 * gone]) - crossing.xy[:-10], axis=1)
    assert apart.min() > 0.65
    rude = np.column_stack([smooth_schedule(alone, t[:-10]), 0 * gone])
    assert np.linalg.norm(rude - crossing.xy[:-10], axis=1).min() < 0.5
    assert (np.diff(polite) >= 0).all() and polite[-1] > 7


def test_no_schedule_passes_a_standing_agent():
    way = straight()
    found = plan_schedule(
        way, np.ones(len(way.distance)), np.full(60, 1.0), (MovingObstacle(np.array([[3.0, 0.0]]), 0.6),)
    )
    assert found[-1] < 2.45
    assert (
        plan_schedule(
            way, np.ones(len(way.distance)), np.full(9, 1.0), (MovingObstacle(np.array([[0.1, 0.0]]), 0.6),)
        )
        is None
    )


def test_a_schedule_has_its_length_and_slows_down_in_bends():
    way = straight(30.0)
    most = speed_limit(way, MotionLimits(1.5, 2, 2, 1))
    assert plan_schedule(way, most, np.full(100, 1.0), (), 24.0)[-1] == pytest.approx(24.0, abs=0.3)
    bend = np.where(np.abs(way.distance - 15) < 0.5, 2.0, 0.0)
    v = speed_limit(walk.Route(way.xy, way.distance, way.heading, bend), MotionLimits(1.5, 1.0, 2.0, 1.0))
    assert v[len(v) // 2] == pytest.approx(0.5) and v.max() == 1.5
    assert (np.diff(v**2) / np.diff(way.distance) < 2.001).all()


@pytest.mark.long
def test_simulated_agents_keep_their_distance_from_each_other_and_a_fixed_path():
    ground = FloorGraphs(floor())
    wishes = [
        MotionPreferences("person", 1.0, 2.0),
        MotionPreferences("person", 0.7, 2.0),
        MotionPreferences("robot", 0.3, 2.0),
    ]
    members = [
        SimulatedAgent(str(k), wish, 1.7 if wish.body_kind == "person" else 0.35)
        for k, wish in enumerate(wishes)
    ]
    there = FixedPath(np.array([[2.5, 3.0, 1.5]]), 0.6)
    things = np.array([[1.0, 1.0, 1.0]])
    paths = plan_crowd(ground, members, [there], things, SECONDS, (5,))
    bodies = [p.poses(every(p, 20))[:, :2, 3] for p in paths]
    apart = [np.linalg.norm(a - b, axis=1).min() for i, a in enumerate(bodies) for b in bodies[:i]]
    assert apart[0] >= 0.6 and min(apart) >= 0.5
    assert min(np.linalg.norm(b - (2.5, 3.0), axis=1).min() for b in bodies) >= 0.5
    again = plan_crowd(FloorGraphs(floor()), members, [there], things, SECONDS, (5,))
    assert all(np.array_equal(a.position.c, b.position.c) for a, b in zip(paths, again, strict=True))


@pytest.mark.long
def test_a_room_without_a_path_is_refused(monkeypatch):
    monkeypatch.setattr(crowds, "_ATTEMPTS", 3)
    tight = FloorGraphs(floor(size=(1.8, 1.8), blocks=()))
    members = [SimulatedAgent(str(k), MotionPreferences("person", 0.8, 0.0), 1.7) for k in range(6)]
    with pytest.raises(UsageError, match="larger --size"):
        plan_crowd(tight, members, [], np.zeros((0, 3)), 6.0, (1,))


@pytest.mark.slow
def test_an_experiment_of_the_paper_has_the_papers_lengths():
    members = paper_agents(2)
    paths = plan_crowd(FloorGraphs(floor()), members, [], np.array([[1.0, 1.0, 1.0]]), PAPER_S, (1,))
    lengths = [path_length(p) for p in paths]
    assert np.abs(np.array(lengths) / PAPER_LENGTHS_M[2] - 1).max() < 0.02
    bodies = [fixed_path(p, 0).xyz for p in paths]
    assert all(floor().at(b[:, :2]).min() > 0.1 for b in bodies)
