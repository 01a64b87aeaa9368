import pickle
import time

import numpy as np
import pytest
from helpers.drifting import loops_of_a_room, rms
from helpers.exact_solver import make_exact
from helpers.gtsam_graph import solve
from helpers.rooms import LOOP, Room, false_loops, simulate

from share.geometry import se3
from share.mapping.graph.edges import EdgeArrays, PoseEdge, jacobians, residuals
from share.mapping.graph.solver import CAUCHY_WIDTH, GraphUpdate, PoseGraphSolver
from share.types import F64

_GAUSSIAN = 1e6  # so wide a robust kernel that there is none


def change(
    poses: dict[int, F64], odometry: list[PoseEdge], loops: list[PoseEdge], first: int = 0
) -> GraphUpdate:
    """Edges are numbered from `first`, loops from there by a million."""
    edges = [(first + i, edge, False) for i, edge in enumerate(odometry)]
    return GraphUpdate.from_edges(
        poses, edges + [(first + 10**6 + i, edge, True) for i, edge in enumerate(loops)]
    )


def loaded(room: Room, cauchy_width: float = CAUCHY_WIDTH) -> PoseGraphSolver:
    solver = PoseGraphSolver(cauchy_width)
    solver.update(change(dict(enumerate(room.guess)), room.chain, room.closures))
    return solver


def test_jacobians_equal_finite_differences() -> None:
    rng = np.random.default_rng(0)
    poses = se3.exp(rng.normal(0, 0.7, (2, 4, 4))[:, 0, :1] * np.ones((2, 6)))
    near = se3.inverse(poses[0]) @ poses[1] @ se3.exp(rng.normal(0, 0.05, 6))
    edges = EdgeArrays.from_measurements(np.array([[0, 1]]), near[None], LOOP[None], np.array([True]))
    by_a, by_b = jacobians(residuals(poses, edges), edges)
    for place, J in ((0, by_a[0]), (1, by_b[0])):
        for k in range(6):
            up, down = poses.copy(), poses.copy()
            up[place] = poses[place] @ se3.exp(1e-6 * np.eye(6)[k])
            down[place] = poses[place] @ se3.exp(-1e-6 * np.eye(6)[k])
            slope = (residuals(up, edges).whitened - residuals(down, edges).whitened)[0] / 2e-6
            assert J[:, k] == pytest.approx(slope, abs=1e-3)


@pytest.mark.parametrize("size", [1e-12, 1e-5, 0.3, 2.0])
def test_residuals_are_the_logarithm(size: float) -> None:
    rng = np.random.default_rng(0)
    poses = se3.exp(rng.normal(0, size, (40, 6)))
    ends = np.column_stack([np.zeros(39, int), np.arange(1, 40)])
    edges = EdgeArrays.from_measurements(
        ends, np.tile(np.eye(4), (39, 1, 1)), np.tile(np.eye(6), (39, 1, 1)), ends[:, 0] > 0
    )
    assert residuals(poses, edges).xi == pytest.approx(se3.log(se3.inverse(poses[0]) @ poses[1:]), abs=1e-11)


@pytest.mark.parametrize(("n", "agents", "density"), [(300, 3, 1.0), (400, 12, 0.3)])
def test_agrees_with_gtsam(n: int, agents: int, density: float) -> None:
    room = simulate(n, agents, 4, density)
    solution = loaded(room).solve(0)
    theirs = solve(room.guess, room.chain, room.closures, [0], relative_tolerance=1e-10)
    off = np.linalg.norm((solution.poses - theirs.poses)[:, :3, 3], axis=1)
    assert rms(room.guess, room.truth) > 1.5 * rms(solution.poses, room.truth)
    assert np.median(off) < 0.001 and off.max() < 0.003
    assert np.array_equal(solution.poses[0], room.guess[0])
    assert np.array_equal(solution.pose_ids, np.arange(n))
    assert solution.loop_chi2 == pytest.approx(theirs.loop_chi2, rel=0.2, abs=1.0)
    assert np.abs(solution.poses - se3.orthonormal(solution.poses)).max() < 1e-12


def test_tolerates_three_false_loops_in_ten() -> None:
    room = simulate(400, 3, 1)
    false = false_loops(room, len(room.closures) * 3 // 7, 1)
    clean = loaded(room).solve(0)
    solver = loaded(room)
    solver.update(change({}, [], false, first=10**7))
    solution = solver.solve(0)
    assert rms(solution.poses, room.truth) < 1.2 * rms(clean.poses, room.truth) + 0.002
    wrong = solution.loop_ids >= 10**7
    assert np.median(solution.loop_chi2[wrong]) > 1000 * np.median(solution.loop_chi2[~wrong])
    gaussian = loaded(room, _GAUSSIAN)
    gaussian.update(change({}, [], false, first=10**7))
    assert rms(gaussian.solve(0).poses, room.truth) > 10 * rms(solution.poses, room.truth)


def test_a_revisited_room_is_no_worse_than_by_gtsam() -> None:
    truth, guess, odometry, loops = loops_of_a_room(300, 1, 70)
    rng = np.random.default_rng(0)
    pairs = [rng.choice(300, 2, replace=False) for _ in range(30)]
    loops += [PoseEdge(int(a), int(b), se3.exp(rng.normal(0, [0.5] * 3 + [1.5] * 3)), LOOP) for a, b in pairs]
    solver = PoseGraphSolver()
    solver.update(change(dict(enumerate(guess)), odometry, loops))
    theirs = solve(guess, odometry, loops, [0])
    assert rms(solver.solve(0).poses, truth) < 1.05 * rms(theirs.poses, truth)


@pytest.mark.long
def test_incremental_solutions_converge_to_the_batch_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also a pose and a loop that were added and removed have no effect."""
    room = simulate(300, 3, 2)
    solver = PoseGraphSolver()
    for k in range(0, 300, 20):
        news = slice(k, k + 20)
        poses = {i: room.guess[i] for i in range(k, k + 20)}
        odometry = [edge for edge in room.odometry[news] if edge is not None]
        loops = [edge for edges in room.loops[news] for edge in edges]
        solver.update(change(poses, odometry, loops, first=1000 * k))
        solution = solver.solve(0)
    solver.update(change({999: np.eye(4)}, [], [PoseEdge(0, 999, np.eye(4), LOOP)], first=7))
    solver.solve(0)
    solver.update(GraphUpdate.from_edges({}, removed_poses=[999]))
    solution = solver.solve(0)
    make_exact(monkeypatch)
    at_once = loaded(room).solve(0)
    off = np.linalg.norm((solution.poses - at_once.poses)[:, :3, 3], axis=1)
    assert np.median(off) < 0.001 and off.max() < 0.003
    assert len(solver) == 300


def test_a_removed_loop_has_no_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    make_exact(monkeypatch)
    room = simulate(150, 3, 3)
    solver = loaded(room)
    before = solver.solve(0)
    solver.update(change({}, [], [PoseEdge(3, 140, np.eye(4), LOOP)], first=10**7))
    assert 10**7 + 10**6 in solver.solve(0).loop_ids
    solver.update(GraphUpdate.from_edges({}, removed_edges=[10**7 + 10**6]))
    after = solver.solve(0)
    assert after.poses == pytest.approx(before.poses, abs=1e-4)
    assert np.array_equal(after.loop_ids, before.loop_ids)


def test_a_merged_map_is_moved_and_solved() -> None:
    """The second agent's map is 3 m off until its first loop."""
    room = simulate(200, 2, 5)
    second = range(1, 200, 2)
    away = se3.exp(np.array([0, 0, 1.0, 3.0, 0, 0]))
    within = [e for e in room.closures if e.a % 2 == e.b % 2]
    between = [e for e in room.closures if e.a % 2 != e.b % 2]
    start = {i: away @ room.guess[i] if i % 2 else room.guess[i] for i in range(200)}
    solver = PoseGraphSolver()
    solver.update(change(start, room.chain, within))
    alone = solver.solve(1)
    assert list(alone.pose_ids) == list(second)
    assert np.array_equal(alone.poses[0], away @ room.guess[1])
    assert list(solver.solve(0).pose_ids) == list(range(0, 200, 2))
    elsewhere = {i: room.guess[i] for i in second}
    solver.update(change(elsewhere, [], between, first=10**7))
    solution = solver.solve(0, [199])
    assert len(solution.pose_ids) == 200
    assert rms(solution.poses, room.truth) < 0.5 * rms(room.guess, room.truth)
    assert solution.covariances.shape == (1, 6, 6)


def test_covariances_are_tight_upper_bounds() -> None:
    room = simulate(300, 3, 6)
    wanted = [297, 298, 299, 150, 0]
    solver = loaded(room)
    claimed = solver.solve(0, wanted).covariances
    exact = solve(room.guess, room.chain, room.closures, [0], wanted).covariances
    assert np.array_equal(claimed[-1], np.zeros((6, 6)))
    for ours, theirs in zip(claimed[:-1], exact, strict=False):
        root = np.linalg.inv(np.linalg.cholesky(theirs))
        ratio = np.linalg.eigvalsh(root @ ours @ root.T)
        assert ratio[0] > 0.97  # the weights are those of nearly the same poses
        assert np.trace(ours[3:, 3:]) < 1.3**2 * np.trace(theirs[3:, 3:])


@pytest.mark.long
def test_covariance_is_consistent() -> None:
    """NEES of a late pose over 40 rooms: 6 on average if exact, less for an upper bound."""
    nees = []
    for seed in range(40):
        room = simulate(60, 2, 100 + seed)
        solution = loaded(room, _GAUSSIAN).solve(0, [58])
        xi = se3.log(se3.inverse(solution.poses[58]) @ room.truth[58])
        nees.append(xi @ np.linalg.solve(solution.covariances[0], xi))
    assert 3.5 < np.mean(nees) < 7.2


def test_same_input_same_bytes() -> None:
    first, second = (loaded(simulate(120, 3, 7)).solve(0, [119]) for _ in range(2))
    assert first.poses.tobytes() == second.poses.tobytes()
    assert first.covariances.tobytes() == second.covariances.tobytes()


def test_a_single_pose_stays() -> None:
    solver = PoseGraphSolver()
    solver.update(GraphUpdate.from_edges({5: np.eye(4)}))
    solution = solver.solve(5, [5])
    assert (list(solution.pose_ids), solution.reason) == ([5], "")
    assert np.array_equal(solution.poses[0], np.eye(4))


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-12, 1e12])
def test_any_valid_covariance_is_solved(scale: float) -> None:
    room = simulate(60, 2, 8)
    odd = [PoseEdge(e.a, e.b, e.T_a_b, scale * e.cov) for e in room.chain[::3]]
    rest = [e for k, e in enumerate(room.chain) if k % 3]
    solver = PoseGraphSolver()
    solver.update(change(dict(enumerate(room.guess)), odd + rest, room.closures))
    solution = solver.solve(0, [59])
    assert solution.reason == ""
    assert rms(solution.poses, room.truth) < 1.0
    assert np.linalg.eigvalsh(solution.covariances[0])[0] > 0


@pytest.mark.parametrize("seed", range(12))
def test_nothing_that_is_valid_raises(seed: int) -> None:
    """Covariances over 40 orders of magnitude, false loops, arbitrary poses."""
    rng = np.random.default_rng(seed)
    room = simulate(40, 3, seed)
    edges = [*room.chain, *room.closures, *false_loops(room, 10, seed)]
    scales = 10.0 ** rng.choice([-30, -12, -6, 0, 0, 0, 6, 12], len(edges))
    edges = [PoseEdge(e.a, e.b, e.T_a_b, e.cov * s) for e, s in zip(edges, scales, strict=True)]
    poses = dict(enumerate(room.guess.copy()))
    for i in rng.choice(np.arange(1, 40), 3, replace=False):
        poses[i][:3, 3] = rng.normal(0, 10.0 ** rng.choice([0, 3, 9, 60]), 3)
    solver = PoseGraphSolver()
    solver.update(change(poses, edges[: len(room.chain)], edges[len(room.chain) :]))
    solution = solver.solve(0, [39, 20])
    assert np.isfinite(solution.poses).all()
    assert all(np.linalg.eigvalsh(cov)[0] > 0 for cov in solution.covariances)


def test_a_pose_behind_an_edge_too_vague_to_count_is_at_an_unknown_place() -> None:
    """The information of the sure edge rounds that of the vague one away: the matrix is exactly singular."""
    T, eye = np.tile(np.eye(4), (3, 1, 1)), np.eye(6)
    chain = [PoseEdge(0, 1, np.eye(4), 1e12 * eye), PoseEdge(1, 2, np.eye(4), 1e-12 * eye)]
    solver = PoseGraphSolver()
    solver.update(change(dict(enumerate(T)), chain, []))
    solution = solver.solve(0, [1, 2])
    assert not solution.reason
    assert (solution.covariances.diagonal(axis1=1, axis2=2) >= 1e6).all()


def test_poses_without_a_finite_cost_are_returned_unchanged() -> None:
    far = np.eye(4)
    far[0, 3] = 1e200
    solver = PoseGraphSolver()
    solver.update(change({0: np.eye(4), 1: far}, [PoseEdge(0, 1, np.eye(4), LOOP)], []))
    solution = solver.solve(0, [1])
    assert "not finite" in solution.reason
    assert np.array_equal(solution.poses[1], far)
    assert solution.covariances.shape == (0, 6, 6)


def test_invalid_updates_are_refused_and_change_nothing() -> None:
    solver = PoseGraphSolver()
    edge = PoseEdge(0, 1, np.eye(4), LOOP)
    solver.update(GraphUpdate.from_edges({0: np.eye(4), 1: np.eye(4)}, [(3, edge, False)]))
    for wrong, why in (
        (GraphUpdate.from_edges({}, [(3, edge, False)]), "edge 3 is known already"),
        (
            GraphUpdate.from_edges({2: np.eye(4)}, [(4, edge, True), (4, edge, True)]),
            "edge 4 is known already",
        ),
        (
            GraphUpdate.from_edges({2: np.eye(4)}, [(4, PoseEdge(0, 9, np.eye(4), LOOP), True)]),
            "pose 9 is not known",
        ),
        (GraphUpdate.from_edges({2: np.eye(4)}, removed_edges=[8]), "edge 8 is not known"),
        (GraphUpdate.from_edges({2: np.eye(4)}, removed_poses=[8]), "pose 8 is not known"),
        (GraphUpdate.from_edges({2: np.eye(4)}, [(4, edge, True)], removed_poses=[1]), "pose 1 is not known"),
    ):
        with pytest.raises(ValueError, match=why):
            solver.update(wrong)
        assert len(solver) == 2
    with pytest.raises(ValueError, match="pose 7 is not known"):
        solver.solve(7)
    with pytest.raises(ValueError, match="pose 7 is not connected to 0"):
        solver.solve(0, [7])
    with pytest.raises(ValueError, match="poses"):
        GraphUpdate.from_edges({0: np.eye(3)})


def test_a_change_pickles_quickly() -> None:
    room = simulate(500, 3, 9)
    whole = change(dict(enumerate(room.guess)), room.chain, room.closures)
    times = []
    for _ in range(20):
        start = time.process_time()
        again = pickle.loads(pickle.dumps(whole, protocol=5))
        times.append(time.process_time() - start)
    assert np.array_equal(again.covs, whole.covs) and not again.covs.flags.writeable
    assert np.median(times) < 0.003


def test_a_straight_chain_with_one_loop_in_closed_form(monkeypatch: pytest.MonkeyPatch) -> None:
    """Along x only: n equal odometry steps and one loop over all of them. The gap is shared out in
    proportion to variance: every step gets gap * s2 / (n s2 + l2)."""
    make_exact(monkeypatch)
    n, s2, l2, gap = 10, 0.01**2, 0.02**2, 0.05
    step = se3.exp(np.array([0, 0, 0, 1.0, 0, 0]))
    edges = [(i, PoseEdge(i, i + 1, step, s2 * np.eye(6)), False) for i in range(n)]
    loop = PoseEdge(0, n, se3.exp(np.array([0, 0, 0, n + gap, 0, 0])), l2 * np.eye(6))
    start = {i: se3.exp(np.array([0, 0, 0, float(i), 0, 0])) for i in range(n + 1)}
    solver = PoseGraphSolver(_GAUSSIAN)
    solver.update(GraphUpdate.from_edges(start, [*edges, (n, loop, True)]))
    solved = solver.solve(0, [n])
    assert solved.poses[:, 0, 3] == pytest.approx(np.arange(n + 1) * (1 + gap * s2 / (n * s2 + l2)), abs=1e-7)
    assert solved.covariances[0][3, 3] == pytest.approx(1 / (1 / (n * s2) + 1 / l2), rel=1e-3)
    assert solved.loop_chi2[0] == pytest.approx((gap * l2 / (n * s2 + l2)) ** 2 / l2, rel=1e-4)


def test_an_edge_needs_two_poses() -> None:
    with pytest.raises(ValueError, match="needs two different poses"):
        PoseEdge(1, 1, np.eye(4), LOOP)
