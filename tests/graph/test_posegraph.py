from dataclasses import replace

import numpy as np
import pytest

from share.config import GraphConfig
from share.geometry import se3
from share.graph.path import Roads, covariance_between
from share.graph.posegraph import Edge, chi2, solve
from share.types import F64

CONFIG = GraphConfig()
ODOMETRY = np.diag([0.004**2] * 3 + [0.01**2] * 3)
LOOP = np.diag([0.005**2] * 3 + [0.02**2] * 3)


def noisy(T: F64, cov: F64, rng: np.random.Generator) -> F64:
    return T @ se3.exp(rng.multivariate_normal(np.zeros(6), cov))


def loops_of_a_room(n: int, seed: int, loop_count: int) -> tuple[F64, F64, list[Edge], list[Edge]]:
    """Truth (n, 4, 4) of three rounds through a room, dead reckoning, and the edges."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0, 6 * np.pi, n)
    t = np.column_stack([3 * np.cos(s), 2 * np.sin(s), 1.2 + 0.2 * np.sin(3 * s)])
    zero = np.zeros(n)
    truth = se3.compose(se3.so3_exp(np.column_stack([zero, zero, s])), t)
    step = se3.inverse(truth[:-1]) @ truth[1:]
    odometry = [Edge(i, i + 1, noisy(T, ODOMETRY, rng), ODOMETRY) for i, T in enumerate(step)]
    guess = [truth[0]]
    for edge in odometry:
        guess.append(guess[-1] @ edge.T_a_b)
    loops = []
    for _ in range(loop_count):
        a = int(rng.integers(0, n * 2 // 3))
        b = min(n - 1, a + n // 3 + int(rng.integers(-3, 4)))
        loops.append(Edge(a, b, noisy(se3.inverse(truth[a]) @ truth[b], LOOP, rng), LOOP))
    return truth, np.array(guess), odometry, loops


def rms(poses: F64, truth: F64) -> float:
    return float(np.sqrt(((poses - truth)[:, :3, 3] ** 2).sum(1).mean()))


def test_recovers_a_drifting_path() -> None:
    truth, guess, odometry, loops = loops_of_a_room(300, 0, 60)
    solved = solve(guess, odometry, loops, [0], CONFIG)
    assert rms(guess, truth) > 0.3
    assert rms(solved.poses, truth) < 0.5 * rms(guess, truth)
    assert np.array_equal(solved.poses[0], guess[0])
    # of 6 * 359 equations 6 * 299 are used up by the poses: chi-square of 6 * 60 is left
    assert 0.8 < (solved.odometry_chi2.sum() + solved.loop_chi2.sum()) / 360 < 1.25
    assert np.array_equal(solved.loop_chi2, chi2(solved.poses, loops))


def test_tolerates_three_false_loops_in_ten() -> None:
    truth, guess, odometry, loops = loops_of_a_room(300, 1, 70)
    rng = np.random.default_rng(0)
    false = []
    for _ in range(30):
        a, b = (int(x) for x in rng.choice(300, 2, replace=False))
        false.append(Edge(a, b, se3.exp(rng.normal(0, [0.5] * 3 + [1.5] * 3)), LOOP))
    clean = solve(guess, odometry, loops, [0], CONFIG)
    solved = solve(guess, odometry, loops + false, [0], CONFIG)
    gaussian = solve(guess, odometry, loops + false, [0], replace(CONFIG, cauchy=1e6))
    assert rms(solved.poses, truth) < 2 * rms(clean.poses, truth) + 0.02
    assert rms(gaussian.poses, truth) > 10 * rms(solved.poses, truth)
    assert solved.loop_chi2[70:].min() > 100 * np.median(solved.loop_chi2[:70])


def test_a_straight_chain_with_one_loop_in_closed_form() -> None:
    """Along x only: n equal odometry steps and one loop over all of them. The gap is shared out in
    proportion to variance: every step gets gap * s2 / (n s2 + l2)."""
    n, s2, l2, gap = 10, 0.01**2, 0.02**2, 0.05
    step = se3.exp(np.array([0, 0, 0, 1.0, 0, 0]))
    odometry = [Edge(i, i + 1, step, s2 * np.eye(6)) for i in range(n)]
    loop = Edge(0, n, se3.exp(np.array([0, 0, 0, n + gap, 0, 0])), l2 * np.eye(6))
    start = np.array([se3.exp(np.array([0, 0, 0, float(i), 0, 0])) for i in range(n + 1)])
    solved = solve(start, odometry, [loop], [0], replace(CONFIG, cauchy=1e6), covariances_of=[n])
    expected = np.arange(n + 1) * (1 + gap * s2 / (n * s2 + l2))
    assert solved.poses[:, 0, 3] == pytest.approx(expected, abs=1e-7)
    variance = 1 / (1 / (n * s2) + 1 / l2)
    assert solved.covariances[0][3, 3] == pytest.approx(variance, rel=1e-3)
    assert solved.loop_chi2[0] == pytest.approx((gap * l2 / (n * s2 + l2)) ** 2 / l2, rel=1e-4)


def test_covariance_is_consistent() -> None:
    """NEES of a late pose over 40 simulated graphs; 95 % band for the mean of 6 dof is 4.98 .. 7.12."""
    nees = []
    for seed in range(40):
        truth, guess, odometry, loops = loops_of_a_room(40, seed, 8)
        solved = solve(guess, odometry, loops, [0], replace(CONFIG, cauchy=1e6), covariances_of=[35])
        xi = se3.log(se3.inverse(solved.poses[35]) @ truth[35])
        nees.append(xi @ np.linalg.solve(solved.covariances[0], xi))
    assert 4.9 < np.mean(nees) < 7.2


def test_same_input_same_bytes() -> None:
    _, guess, odometry, loops = loops_of_a_room(60, 3, 10)
    first, second = (solve(guess, odometry, loops, [0], CONFIG, [59]) for _ in range(2))
    assert first.poses.tobytes() == second.poses.tobytes()
    assert first.covariances.tobytes() == second.covariances.tobytes()


def test_chain_without_loops_stays() -> None:
    _, guess, odometry, _ = loops_of_a_room(20, 4, 0)
    assert solve(guess, odometry, [], [0], CONFIG).poses == pytest.approx(guess, abs=1e-9)


def test_what_is_not_tied_down_is_refused() -> None:
    two = np.array([np.eye(4), np.eye(4)])
    with pytest.raises(ValueError, match="not joined to an anchor"):
        solve(two, [], [], [0], CONFIG)
    with pytest.raises(ValueError, match="there are 2 poses"):
        solve(two, [Edge(0, 2, np.eye(4), LOOP)], [], [0, 1], CONFIG)
    with pytest.raises(ValueError, match="anchors"):
        solve(two, [Edge(0, 1, np.eye(4), LOOP)], [], [7], CONFIG)
    with pytest.raises(ValueError, match="does not join two poses"):
        Edge(1, 1, np.eye(4), LOOP)


def test_surest_path_takes_the_loop_where_it_pays() -> None:
    step = se3.exp(np.array([0, 0, 0.1, 1.0, 0, 0]))
    poses = [np.eye(4)]
    roads = Roads()
    for i in range(10):
        poses.append(poses[-1] @ step)
        roads.add(Edge(i, i + 1, step, ODOMETRY))
    assert [e.b for e in roads.surest(2, 5) or []] == [3, 4, 5]
    assert [e.a for e in roads.surest(5, 2) or []] == [4, 3, 2]
    shortcut = Edge(9, 0, se3.inverse(poses[9]) @ poses[0], LOOP)
    roads.add(shortcut)
    assert roads.surest(0, 10) == [shortcut, *(roads.surest(9, 10) or [])]
    roads.remove(shortcut)
    assert len(roads.surest(0, 10) or []) == 10
    assert roads.surest(0, 99) is None
    assert roads.surest(3, 3) == []


def test_covariance_along_a_path_is_that_of_the_samples() -> None:
    rng = np.random.default_rng(0)
    steps = [se3.exp(rng.normal(0, 0.4, 6)) for _ in range(4)]
    poses = [np.eye(4)]
    for T in steps:
        poses.append(poses[-1] @ T)
    small = np.diag([0.002**2] * 3 + [0.005**2] * 3)
    # the third edge is stored the other way round
    edges = [Edge(i, i + 1, T, small) for i, T in enumerate(steps)]
    edges[2] = Edge(3, 2, se3.inverse(steps[2]), se3.inverse_cov(steps[2], small))
    claimed = covariance_between(edges, 0, poses)
    T = np.tile(np.eye(4), (4000, 1, 1))
    for step in steps:
        T = T @ step @ se3.exp(rng.multivariate_normal(np.zeros(6), small, 4000))
    samples = se3.log(se3.inverse(poses[4]) @ T)
    assert np.cov(samples.T) == pytest.approx(claimed, rel=0.15, abs=6e-6)
