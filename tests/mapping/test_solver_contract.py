import numpy as np
import pytest
from helpers.exact_solver import make_exact, use_all_edges
from helpers.rooms import Room, simulate

from share.geometry import se3
from share.mapping.graph.edges import PoseEdge
from share.mapping.graph.solver import GraphSolution, GraphUpdate, PoseGraphSolver
from share.mapping.keyframe_removal import contract_pose
from share.types import F64


@pytest.fixture(autouse=True)
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    make_exact(monkeypatch)
    use_all_edges(monkeypatch)


def path(*steps: F64) -> list[F64]:
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ step)
    return poses


def random_edge(a: int, b: int, seed: int) -> PoseEdge:
    rng = np.random.default_rng(seed)
    root = rng.normal(0, 0.01, (6, 6))
    return PoseEdge(a, b, se3.exp(rng.normal(0, 0.5, 6)), root @ root.T + 1e-6 * np.eye(6))


def test_contracting_a_chain_composes_its_edges() -> None:
    first, second = random_edge(1, 2, 0), random_edge(2, 3, 1)
    (edge,), loops = contract_pose(2, [first, second], [])
    T = first.T_a_b @ second.T_a_b
    cov = se3.compose_cov(second.T_a_b, first.cov, second.cov)
    edge = edge if edge.a == 1 else edge.reverse()
    assert ((edge.a, edge.b), loops) == ((1, 3), [])
    assert edge.T_a_b == pytest.approx(T, abs=1e-12)
    assert edge.cov == pytest.approx(cov, rel=1e-9, abs=1e-15)
    ((backward,), _) = contract_pose(2, [first.reverse(), second.reverse()], [])
    backward = backward if backward.a == 1 else backward.reverse()
    assert backward.cov == pytest.approx(cov, rel=1e-9, abs=1e-15)


def test_loops_move_along_the_more_certain_edge_and_keep_their_direction() -> None:
    loose, tight = random_edge(1, 2, 0), random_edge(2, 3, 1)
    loose = PoseEdge(1, 2, loose.T_a_b, 100 * loose.cov)
    out, into, own = random_edge(2, 9, 2), random_edge(8, 2, 3), random_edge(3, 2, 4)
    odometry, (moved_out, moved_into, gone) = contract_pose(2, [loose, tight], [out, into, own])
    assert [(e.a, e.b) for e in odometry] == [(1, 3)]
    assert gone is None and moved_out is not None and moved_into is not None
    assert (moved_out.a, moved_out.b, moved_into.a, moved_into.b) == (3, 9, 8, 3)
    assert moved_out.T_a_b == pytest.approx(se3.inverse(tight.T_a_b) @ out.T_a_b, abs=1e-12)
    # half of the edge's information to odometry, a quarter to each of the two loops that move
    expected = se3.compose_cov(tight.T_a_b, into.cov, 4 * tight.cov)
    assert moved_into.cov == pytest.approx(expected, rel=1e-9, abs=1e-15)
    expected = se3.compose_cov(tight.T_a_b, loose.cov, 2 * tight.cov)
    assert odometry[0].cov == pytest.approx(expected, rel=1e-9, abs=1e-15)


def test_an_end_of_a_chain_is_dropped() -> None:
    last, loop = random_edge(4, 5, 0), random_edge(1, 5, 1)
    odometry, (moved,) = contract_pose(5, [last], [loop])
    assert odometry == [] and moved is not None
    assert (moved.a, moved.b) == (1, 4)
    assert moved.cov == pytest.approx(
        se3.compose_cov(se3.inverse(last.T_a_b), loop.cov, last.reverse().cov), rel=1e-9, abs=1e-15
    )
    assert contract_pose(5, [last], []) == ([], [])


def test_unrelated_edges_and_isolated_poses_are_refused() -> None:
    with pytest.raises(ValueError, match="no odometry edge"):
        contract_pose(5, [], [random_edge(1, 5, 0)])
    with pytest.raises(ValueError, match="does not end at it"):
        contract_pose(5, [random_edge(1, 2, 0)], [])


def thinned(room: Room, gone: list[int]) -> tuple[list[PoseEdge], list[PoseEdge]]:
    odometry, loops = room.chain, room.closures
    for x in gone:
        mine = [[e for e in edges if x in (e.a, e.b)] for edges in (odometry, loops)]
        new_odometry, moved = contract_pose(x, *mine)
        odometry = [e for e in odometry if e not in mine[0]] + new_odometry
        loops = [e for e in loops if e not in mine[1]] + [e for e in moved if e]
    return odometry, loops


def solved(
    poses: dict[int, F64], odometry: list[PoseEdge], loops: list[PoseEdge], wanted: list[int]
) -> GraphSolution:
    solver = PoseGraphSolver(1e6)
    edges = [*((e, False) for e in odometry), *((e, True) for e in loops)]
    solver.update(GraphUpdate.from_edges(poses, [(i, e, loop) for i, (e, loop) in enumerate(edges)]))
    return solver.solve(0, wanted)


@pytest.mark.parametrize("seed", [10, 11])
def test_half_of_a_room_contracted_claims_no_more_than_the_whole(seed: int) -> None:
    """Counting the shared odometry edge in full for each loop would claim 0.65 of the variance."""
    room = simulate(200, 3, seed)
    gone = np.random.default_rng(seed).permutation(np.arange(3, 200))[:100].tolist()
    left = sorted(set(range(200)) - set(gone))
    wanted = left[8::8]
    whole = solved(dict(enumerate(room.guess)), room.chain, room.closures, wanted)
    half = solved({i: room.guess[i] for i in left}, *thinned(room, gone), wanted)
    assert list(half.pose_ids) == left
    sigma = np.sqrt(np.trace(whole.covariances[:, 3:, 3:], axis1=1, axis2=2))
    off = np.linalg.norm((whole.poses[left] - half.poses)[8::8, :3, 3], axis=1)
    assert np.median(off / sigma) < 0.8 and (off / sigma).max() < 1.5
    growth = []
    for full, part in zip(whole.covariances, half.covariances, strict=True):
        root = np.linalg.inv(np.linalg.cholesky(full))
        ratio = np.linalg.eigvalsh(root @ part @ root.T)
        assert ratio[0] > 0.98
        growth.append(np.trace(part) / np.trace(full))
    assert np.median(growth) < 1.6
