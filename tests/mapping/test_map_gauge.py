"""The gauge of a map: what those in it are shown of a solution that moves it as a whole."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.atlas_sim import Walker, loop, near_loops, settle

from share.config import MergeConfig
from share.geometry import se3
from share.mapping.atlas import Atlas
from share.mapping.localisation_gate import AHEAD_M
from share.mapping.map_gauge import MapGauge, SolvedPose
from share.types import F64

ANN, BOB, ROBOT = range(3)  # segments; the map is ann's
BODIES = {ANN: np.array([0.0, 0, 1.5]), BOB: np.array([4.0, 0, 1.5]), ROBOT: np.array([2.0, 3, 0.2])}


def place(segment: int, T: F64, sigma_m: float = 0.01, step_m: float = 0.003) -> SolvedPose:
    """The segment's place, moved by T (4, 4) in the map."""
    T_odom_body = se3.from_rt(se3.so3_exp(np.array([0, 0, float(segment)])), BODIES[segment])
    return SolvedPose(T, T_odom_body, sigma_m, step_m**2)


def moved(yaw: float = 0.0, *t: float, axis: tuple[float, float, float] = (0, 0, 1)) -> F64:
    return se3.from_rt(se3.so3_exp(yaw * np.array(axis)), np.array([*t, 0.0, 0.0, 0.0][:3]))


def ways(shown: dict[int, F64], before: dict[int, F64]) -> dict[int, float]:
    """By how much each body, and what is ahead of it, was shown to move, m."""
    out = {}
    for s, T in shown.items():
        T_odom_body = place(s, T).T_odom_body
        xi = se3.log(se3.inverse(before[s] @ T_odom_body) @ T @ T_odom_body)
        out[s] = float(np.linalg.norm(xi[3:]) + AHEAD_M * np.linalg.norm(xi[:3]))
    return out


STAY = {s: np.eye(4) for s in BODIES}


@pytest.fixture
def gauge() -> MapGauge:
    """Ann and bob are in the map, at the identity."""
    gauge = MapGauge()
    shown = gauge.publish(ANN, {s: place(s, np.eye(4)) for s in (ANN, BOB)})
    for T in shown.values():
        np.testing.assert_array_equal(T, np.eye(4))
    return gauge


def test_a_map_that_moves_as_a_whole_stays_where_it_was_shown(gauge: MapGauge) -> None:
    for T in (moved(0.0, 0.004, -0.002, 0.003), moved(0.001, 0.002), moved(-0.0005, 0.0, 0.003)):
        shown = gauge.publish(ANN, {s: place(s, T) for s in (ANN, BOB)})
        assert max(ways(shown, STAY).values()) < 1e-5


def test_a_drift_beyond_what_is_uncertain_is_corrected(gauge: MapGauge) -> None:
    shown = gauge.publish(ANN, {s: place(s, moved(0.0, 0.05)) for s in (ANN, BOB)})
    assert ways(shown, STAY) == {s: pytest.approx(0.04 - 0.005) for s in (ANN, BOB)}
    shown = gauge.publish(ANN, {s: place(s, moved(0.0, 0.05), sigma_m=0.002) for s in (ANN, BOB)})
    assert ways(shown, STAY) == {s: pytest.approx(0.048 - 0.002) for s in (ANN, BOB)}


def test_an_agent_that_is_alone_is_corrected_too(gauge: MapGauge) -> None:
    gauge = MapGauge()
    gauge.publish(ANN, {ANN: place(ANN, np.eye(4))})
    way = ways(gauge.publish(ANN, {ANN: place(ANN, moved(0.02))}), STAY)[ANN]
    assert way == pytest.approx(0.045, rel=0.02)


def test_where_agents_move_against_each_other_the_surer_one_moves_less(gauge: MapGauge) -> None:
    solved = {ANN: place(ANN, np.eye(4), 0.05), BOB: place(BOB, moved(0, 0, 0, 0.02), 0.05, step_m=0.001)}
    way = ways(gauge.publish(ANN, solved), STAY)
    assert way[BOB] == 0.0  # a tenth of the way is left to it, less than it may be off
    assert way[ANN] == pytest.approx(0.9 * 0.02 - 0.005, rel=0.01)


def test_an_agent_stays_where_the_solution_may_as_well_be_wrong(gauge: MapGauge) -> None:
    near = {ANN: place(ANN, np.eye(4), 0.004), BOB: place(BOB, moved(0, 0, 0, 0.0039), 0.004)}
    for s, T in gauge.publish(ANN, near).items():
        np.testing.assert_allclose(T, STAY[s], atol=1e-12)
    surer = {s: place(s, solved.T_map_odom, 0.001) for s, solved in near.items()}
    way = ways(gauge.publish(ANN, surer), STAY)
    by_gauge, slack = 0.001, 0.001
    assert way == {ANN: 0.0, BOB: pytest.approx(0.0039 - by_gauge - slack, rel=0.01)}


def test_however_uncertain_the_map_an_agent_is_at_most_5_mm_off(gauge: MapGauge) -> None:
    T = moved(0, 0, 0, 0.2)
    for _ in range(3):
        shown = gauge.publish(ANN, {ANN: place(ANN, np.eye(4), 0.3), BOB: place(BOB, T, 0.3)})
    apart = se3.inverse(shown[ANN]) @ shown[BOB]
    assert np.linalg.norm(apart[:3, 3] - T[:3, 3]) <= 0.01 + 1e-9


def test_tilts_are_shown(gauge: MapGauge) -> None:
    tilt = moved(0.02, axis=(1, 0, 0))
    shown = gauge.publish(ANN, {s: place(s, tilt, sigma_m=1e-9) for s in (ANN, BOB)})
    for T in shown.values():
        np.testing.assert_allclose(T[:3, :3], tilt[:3, :3], atol=1e-8)


def test_agents_that_are_sure_are_shown_against_each_other_as_solved(gauge: MapGauge) -> None:
    solved = {ANN: moved(0.01, 0.02), BOB: moved(-0.02, 0.0, 0.04), ROBOT: moved(0.3, 1.0, 2.0, 3.0)}
    shown = gauge.publish(ANN, {s: place(s, T, sigma_m=1e-9) for s, T in solved.items()})
    for s in (BOB, ROBOT):
        np.testing.assert_allclose(
            se3.inverse(shown[ANN]) @ shown[s], se3.inverse(solved[ANN]) @ solved[s], atol=1e-8
        )


def test_who_enters_does_not_move_the_map(gauge: MapGauge) -> None:
    gauge.publish(BOB, {ROBOT: place(ROBOT, np.eye(4))})  # in a map of its own
    shown = gauge.publish(
        ANN, {**{s: place(s, np.eye(4)) for s in (ANN, BOB)}, ROBOT: place(ROBOT, moved(0.1, 0.5))}
    )
    assert max(ways(shown, STAY)[s] for s in (ANN, BOB)) < 1e-9


def test_a_segment_without_keyframes_is_forgotten(gauge: MapGauge) -> None:
    gauge.publish(ANN, {s: place(s, moved(0.0, 0.005)) for s in (ANN, BOB)})
    gauge.forget_all_but([])
    T = moved(0.0, 0.003)
    np.testing.assert_array_equal(gauge.publish(ANN, {ANN: place(ANN, T)})[ANN], T)


def test_corrections_place_agents_against_each_other_nearly_as_the_map_does() -> None:
    ann, bob, rng = Walker("ann", 0), Walker("bob", 1, phase=0.4), np.random.default_rng(2)
    atlas = Atlas(MergeConfig(enter_m=1.0))
    for k in range(60):
        for walker in (ann, bob):
            atlas.add_keyframe(walker.name, walker.keyframes[k])
    loops = near_loops(ann, bob, rng, every=6)
    for found in loops[: len(loops) // 2]:
        atlas.propose(found)
    (first,) = settle(atlas)[-1:]
    for found in loops[len(loops) // 2 :]:
        atlas.propose(found)
    atlas.propose(loop(ann, 0, bob, 59, rng))
    (then,) = settle(atlas)[-1:]
    assert first.corrections.keys() == then.corrections.keys() == {"ann", "bob"}
    T_ann, T_bob = (then.corrections[name].T_map_odom for name in ("ann", "bob"))
    solved = [atlas.T_map_odom(name) for name in ("ann", "bob")]
    assert solved[0] is not None and solved[1] is not None
    T_shown_bob, T_solved_bob = se3.inverse(T_ann) @ T_bob, se3.inverse(solved[0]) @ solved[1]
    off = se3.log(se3.inverse(T_solved_bob) @ T_shown_bob)
    # Either may be 5 mm off at 3 m, in a room of 6 m.
    assert np.linalg.norm(off[3:]) < 2 * 0.005 * (1 + 6.0 / AHEAD_M)
    assert np.abs(T_ann - solved[0]).max() > 1e-4  # the gauge differs
