from typing import Any

import numpy as np
import pytest
from helpers.rooms import LOOP, Room, simulate
from helpers.walking import covariance_between, surest
from scipy.sparse.csgraph import dijkstra

from share.mapping.graph.covariance import CovariancePaths
from share.mapping.graph.edges import PoseEdge
from share.mapping.graph.shortest_paths import ShortestPaths


def paths_of(room: Room, seed: int) -> tuple[CovariancePaths, list[PoseEdge]]:
    """No two edges are equally certain, so that one path is the shortest."""
    rng = np.random.default_rng(seed)
    edges = [PoseEdge(e.a, e.b, e.T_a_b, e.cov * rng.uniform(0.5, 2)) for e in (*room.chain, *room.closures)]
    paths = CovariancePaths()
    for edge in edges:
        paths.add(edge)
    return paths, edges


def agree(paths: CovariancePaths, edges: list[PoseEdge], room: Room, start: int, goals: list[int]) -> None:
    """`covariances_from` equals the composition edge by edge."""
    for goal, cov in zip(goals, paths.covariances_from(start, goals, room.guess), strict=True):
        path = surest(edges, start, goal)
        assert (path is None) == (cov is None)
        if path is not None and cov is not None:
            walked = covariance_between(path, start, room.guess)
            assert np.abs(cov - walked).max() <= 1e-9 * np.abs(walked).max()


@pytest.mark.parametrize("seed", [0, 1])
def test_one_search_gives_the_covariances_along_all_paths(seed: int) -> None:
    room = simulate(300, 3, seed)
    paths, edges = paths_of(room, seed)
    rng = np.random.default_rng(seed)
    for start in (0, 7, 299):
        agree(paths, edges, room, start, [*rng.choice(300, 8).tolist(), start])


def test_edges_come_and_go() -> None:
    room = simulate(200, 3, 2)
    paths, edges = paths_of(room, 2)
    rng = np.random.default_rng(2)
    out: list[PoseEdge] = []
    for k in range(60):
        edge = edges.pop(int(rng.integers(len(edges))))
        paths.remove(edge)
        out.append(edge)
        if k % 3 == 2:
            back = out.pop(0)
            paths.add(back)
            edges.append(back)
        if k % 5 == 0:
            agree(paths, edges, room, 199 - k, rng.choice(200, 6).tolist())
    with pytest.raises(KeyError):
        paths.remove(out[0])
    with pytest.raises(ValueError, match="was added before"):
        paths.add(edges[0])


def test_of_parallel_edges_the_most_certain_counts() -> None:
    T = np.eye(4)
    paths = CovariancePaths()
    loose, sure = PoseEdge(4, 9, T, 4 * LOOP), PoseEdge(9, 4, T, LOOP)
    poses = {4: T, 9: T}
    paths.add(loose)
    paths.add(sure)
    assert paths.covariances_from(4, [9], poses)[0] == pytest.approx(LOOP)
    paths.remove(sure)
    assert paths.covariances_from(4, [9], poses)[0] == pytest.approx(4 * LOOP)
    paths.remove(loose)
    assert paths.covariances_from(4, [9, 4], poses)[0] is None


def test_without_a_path_there_is_no_covariance() -> None:
    paths = CovariancePaths()
    assert paths.covariances_from(3, [], {}) == []
    cov = paths.covariances_from(3, [3, 5], {3: np.eye(4), 5: np.eye(4)})
    assert np.array_equal(cov[0], np.zeros((6, 6))) and cov[1] is None


def test_a_goal_that_cannot_be_reached_ends_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """From a small part of the graph, after a search nearby: the reach grows no further than it helps."""
    searches = 0

    def counted(*given: Any, **options: Any) -> Any:
        nonlocal searches
        searches += 1
        assert searches < 10
        return dijkstra(*given, **options)

    monkeypatch.setattr("scipy.sparse.csgraph.dijkstra", counted)
    a = np.array([0, *range(10, 99)])
    paths = ShortestPaths(100, a, a + 1, np.ones(len(a)))
    assert paths.predecessors_of(0, np.array([1]))[1] == 0
    assert (paths.predecessors_of(0, np.array([1, 50]))[[1, 50]] == [0, -9999]).all()
