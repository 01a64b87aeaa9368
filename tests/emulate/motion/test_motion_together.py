from itertools import pairwise

import numpy as np
import pytest
from motion_sim import SECONDS, every, floor

from share.errors import UsageError
from share.lab.emulate.motion import crowd as crowds
from share.lab.emulate.motion import paper, walk
from share.lab.emulate.motion.crowd import Member, Present, crowd, length_of, present_of
from share.lab.emulate.motion.route import SPACING, Network, arc_length, smooth
from share.lab.emulate.motion.schedule import STEP_S, Limits, Other, schedule, smoothed, speed_limit
from share.lab.emulate.motion.together import Ground, Wish


def straight(length=10.0):
    xy = np.column_stack([np.arange(0, length, SPACING), np.zeros(round(length / SPACING))])
    return walk.Way(xy, arc_length(xy), np.zeros(len(xy)), np.zeros(len(xy)))


@pytest.mark.parametrize("seed", range(3))
def test_tours_keep_off_things_and_are_smooth(seed):
    ground = floor()
    legs = Network(ground, 0.3).tour(40.0, np.random.default_rng(seed))
    assert all(np.allclose(a[-1], b[0]) for a, b in pairwise(legs))
    way = smooth(ground, np.concatenate(legs), 0.3)
    assert arc_length(way)[-1] > 30 and ground.at(way).min() > 0.25
    assert np.linalg.norm(np.diff(way, 2, axis=0), axis=1).max() < 0.7 * SPACING


def test_a_tour_stays_where_it_can_get_to():
    split = floor(blocks=((4, 0, 5, 6),))
    for seed in range(5):
        way = np.concatenate(Network(split, 0.3).tour(10.0, np.random.default_rng(seed)))
        assert len(set((way[:, 0] > 4.5).tolist())) == 1


def test_one_waits_for_another_who_crosses():
    way, wanted = straight(), np.full(60, 1.0)
    most = speed_limit(way, Limits(1.2, 2, 2, 1))
    t = np.arange(0, 13, STEP_S / 2)
    crossing = Other(np.column_stack([np.full(len(t), 5.0), (t - 5.0) * 0.5]), 0.8)
    alone, polite = (schedule(way, most, wanted, others) for others in ((), (crossing,)))
    gone = smoothed(polite, t[:-10])
    apart = np.linalg.norm(np.column_stack([gone, 0 * gone]) - crossing.xy[:-10], axis=1)
    assert apart.min() > 0.65
    rude = np.column_stack([smoothed(alone, t[:-10]), 0 * gone])
    assert np.linalg.norm(rude - crossing.xy[:-10], axis=1).min() < 0.5
    assert (np.diff(polite) >= 0).all() and polite[-1] > 7


def test_nobody_passes_through_one_who_stands_in_the_way():
    way = straight()
    found = schedule(way, np.ones(len(way.gone)), np.full(60, 1.0), (Other(np.array([[3.0, 0.0]]), 0.6),))
    assert found[-1] < 2.45
    assert (
        schedule(way, np.ones(len(way.gone)), np.full(9, 1.0), (Other(np.array([[0.1, 0.0]]), 0.6),)) is None
    )


def test_one_goes_as_far_as_asked_and_slows_down_in_bends():
    way = straight(30.0)
    most = speed_limit(way, Limits(1.5, 2, 2, 1))
    assert schedule(way, most, np.full(100, 1.0), (), 24.0)[-1] == pytest.approx(24.0, abs=0.3)
    bend = np.where(np.abs(way.gone - 15) < 0.5, 2.0, 0.0)
    v = speed_limit(walk.Way(way.xy, way.gone, way.heading, bend), Limits(1.5, 1.0, 2.0, 1.0))
    assert v[len(v) // 2] == pytest.approx(0.5) and v.max() == 1.5
    assert (np.diff(v**2) / np.diff(way.gone) < 2.001).all()


def test_two_people_and_a_robot_keep_apart_and_off_one_who_is_there():
    ground = Ground(floor())
    wishes = [Wish("person", 1.0, 2.0), Wish("person", 0.7, 2.0), Wish("robot", 0.3, 2.0)]
    members = [Member(str(k), wish, 1.7 if wish.look == "person" else 0.35) for k, wish in enumerate(wishes)]
    there = Present(np.array([[2.5, 3.0, 1.5]]), 0.6)
    things = np.array([[1.0, 1.0, 1.0]])
    paths = crowd(ground, members, [there], things, SECONDS, (5,))
    bodies = [p.poses(every(p, 20))[:, :2, 3] for p in paths]
    apart = [np.linalg.norm(a - b, axis=1).min() for i, a in enumerate(bodies) for b in bodies[:i]]
    assert apart[0] >= 0.6 and min(apart) >= 0.5
    assert min(np.linalg.norm(b - (2.5, 3.0), axis=1).min() for b in bodies) >= 0.5
    again = crowd(Ground(floor()), members, [there], things, SECONDS, (5,))
    assert all(np.array_equal(a.position.c, b.position.c) for a, b in zip(paths, again, strict=True))


def test_a_room_without_a_way_says_so(monkeypatch):
    monkeypatch.setattr(crowds, "_ATTEMPTS", 3)
    tight = Ground(floor(size=(1.8, 1.8), blocks=()))
    members = [Member(str(k), Wish("person", 0.8, 0.0), 1.7) for k in range(6)]
    with pytest.raises(UsageError, match="larger --size"):
        crowd(tight, members, [], np.zeros((0, 3)), 6.0, (1,))


@pytest.mark.slow
def test_an_experiment_of_the_paper_has_the_papers_lengths():
    members = paper.members(2)
    paths = crowd(Ground(floor()), members, [], np.array([[1.0, 1.0, 1.0]]), paper.SECONDS, (1,))
    lengths = [length_of(p) for p in paths]
    assert np.abs(np.array(lengths) / paper.LENGTHS_M[2] - 1).max() < 0.02
    bodies = [present_of(p, 0).xyz for p in paths]
    assert all(floor().at(b[:, :2]).min() > 0.1 for b in bodies)
