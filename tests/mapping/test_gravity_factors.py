"""Gravity factors in the pose graph."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.rooms import Room, simulate

from share.geometry import se3
from share.mapping.graph import gravity
from share.mapping.graph.solver import CAUCHY_WIDTH, GraphSolution, GraphUpdate, PoseGraphSolver
from share.types import F64

SIGMA = float(np.radians(0.1))


def gravity_factors_of(room: Room, seed: int) -> dict[int, F64]:
    """A factor of each pose, with errors of `SIGMA` about both horizontal axes."""
    rng = np.random.default_rng(seed)
    noise = np.column_stack([rng.normal(0, SIGMA, (len(room), 2)), np.zeros(len(room))])
    up = (se3.so3_exp(noise) @ room.truth[:, :3, :3])[:, 2, :3]
    return dict(enumerate(up / SIGMA))


def solved(
    room: Room, lines: dict[int, F64] | None, wanted: list[int], cauchy_width: float = CAUCHY_WIDTH
) -> GraphSolution:
    solver = PoseGraphSolver(cauchy_width)
    edges = [(i, edge, False) for i, edge in enumerate(room.chain)]
    loops = [(10**6 + i, edge, True) for i, edge in enumerate(room.closures)]
    solver.update(GraphUpdate.from_edges(dict(enumerate(room.guess)), edges + loops, gravity_factors=lines))
    return solver.solve(0, wanted)


def tilted(room: Room, degrees: float) -> Room:
    """The room by an agent whose initial up direction was wrong."""
    tilt = se3.exp(np.radians([0.6 * degrees, -0.8 * degrees, 0, 0, 0, 0]))
    about = room.guess[0]
    return replace(room, guess=about @ tilt @ se3.inverse(about) @ room.guess)


def test_gradient_and_hessian_are_those_of_the_cost() -> None:
    rng = np.random.default_rng(3)
    poses = se3.exp(rng.normal(0, 0.4, (5, 6)))
    lines = np.concatenate([rng.normal(0, 1, (4, 3)), np.zeros((1, 3))])
    slope, curvature = gravity.gravity_equations(poses, lines)
    step, numeric = 1e-5, np.zeros((5, 6))
    for k in range(5):
        for j in range(6):
            there, back = poses.copy(), poses.copy()
            xi = step * np.eye(6)[j]
            there[k], back[k] = poses[k] @ se3.exp(xi), poses[k] @ se3.exp(-xi)
            numeric[k, j] = (gravity.gravity_cost(there, lines) - gravity.gravity_cost(back, lines)) / (
                4 * step
            )
    assert slope == pytest.approx(numeric, abs=1e-8)
    assert np.linalg.eigvalsh(curvature).min() > -1e-12
    assert not slope[4].any() and not curvature[4].any()


def up_error_deg(poses: F64, truth: F64) -> float:
    """Angle between the poses' up directions and the true ones, of all poses together."""
    up = (poses[:, :3, :3] @ np.swapaxes(truth[:, :3, :3], 1, 2))[:, :2, 2].mean(0)
    return float(np.degrees(np.linalg.norm(up)))


def test_a_map_keeps_the_tilt_that_it_began_with_and_turns_upright_slowly() -> None:
    room = tilted(simulate(300, 3, 1), 2.0)
    found = solved(room, gravity_factors_of(room, 1), [])
    assert np.array_equal(found.poses[0, :3, 3], room.guess[0, :3, 3])
    turned = se3.rotation_angle(room.guess[0, :3, :3].T @ found.poses[0, :3, :3])
    assert np.degrees(turned) == pytest.approx(0.001, abs=1e-6)
    assert up_error_deg(found.poses, room.truth) > 1.5
    alone = solved(room, None, [])
    assert np.array_equal(alone.poses[0], room.guess[0])
    factors = np.array(list(gravity_factors_of(room, 1).values()))
    upright = [gravity.turned_upright(poses, factors, 0) for poses in (found.poses, alone.poses)]
    assert up_error_deg(upright[0], room.truth) < 0.03
    assert spread(upright[0], room.truth) < spread(upright[1], room.truth)


def spread(poses: F64, truth: F64) -> float:
    """RMS error of the height, m, with the first pose aligned; mostly caused by tilt."""
    return float(np.sqrt(((poses[:, 2, 3] - truth[:, 2, 3]) ** 2).mean()))


@pytest.mark.long
def test_gravity_factors_reduce_the_covariances_consistently() -> None:
    """NEES of a late pose over 20 rooms, by an upper bound: not over 6."""
    nees, surer = [], []
    exact = 1e6
    for seed in range(20):
        room = simulate(60, 2, 100 + seed)
        solution = solved(room, gravity_factors_of(room, seed), [58], exact)
        factors = np.array(list(gravity_factors_of(room, seed).values()))
        upright = gravity.turned_upright(solution.poses, factors, 0)
        xi = se3.log(se3.inverse(upright[58]) @ room.truth[58])
        nees.append(xi @ np.linalg.solve(solution.covariances[0], xi))
        without = solved(room, None, [58], exact).covariances[0]
        surer.append(np.trace(solution.covariances[0][:3, :3]) / np.trace(without[:3, :3]))
    assert 3.5 < np.mean(nees) < 7.2
    assert np.mean(surer) < 0.6


def test_without_gravity_factors_the_anchor_stays_to_the_bit() -> None:
    room = simulate(60, 2, 5)
    found = solved(room, dict.fromkeys(range(60), np.zeros(3)), [58])
    assert np.array_equal(found.poses[0], room.guess[0])
    same = solved(room, None, [58])
    assert found.poses.tobytes() == same.poses.tobytes()
    assert found.covariances.tobytes() == same.covariances.tobytes()
