import numpy as np
import pytest
from rooms import LOOP, Room, simulate
from walking import covariance_between, surest

from share.mapping.graph.covariance import Roads
from share.mapping.graph.edges import Edge


def roads_of(room: Room, seed: int) -> tuple[Roads, list[Edge]]:
    """With no two edges equally sure, so that there is one surest path."""
    rng = np.random.default_rng(seed)
    edges = [Edge(e.a, e.b, e.T_a_b, e.cov * rng.uniform(0.5, 2)) for e in (*room.chain, *room.closures)]
    roads = Roads()
    for edge in edges:
        roads.add(edge)
    return roads, edges


def agree(roads: Roads, edges: list[Edge], room: Room, start: int, goals: list[int]) -> None:
    """`known_from` against the path that is walked edge by edge."""
    for goal, cov in zip(goals, roads.known_from(start, goals, room.guess), strict=True):
        path = surest(edges, start, goal)
        assert (path is None) == (cov is None)
        if path is not None and cov is not None:
            walked = covariance_between(path, start, room.guess)
            assert np.abs(cov - walked).max() <= 1e-9 * np.abs(walked).max()


@pytest.mark.parametrize("seed", [0, 1])
def test_one_search_tells_what_walking_each_path_tells(seed: int) -> None:
    room = simulate(300, 3, seed)
    roads, edges = roads_of(room, seed)
    rng = np.random.default_rng(seed)
    for start in (0, 7, 299):
        agree(roads, edges, room, start, [*rng.choice(300, 8).tolist(), start])


def test_edges_come_and_go() -> None:
    room = simulate(200, 3, 2)
    roads, edges = roads_of(room, 2)
    rng = np.random.default_rng(2)
    out: list[Edge] = []
    for k in range(60):
        edge = edges.pop(int(rng.integers(len(edges))))
        roads.remove(edge)
        out.append(edge)
        if k % 3 == 2:
            back = out.pop(0)
            roads.add(back)
            edges.append(back)
        if k % 5 == 0:
            agree(roads, edges, room, 199 - k, rng.choice(200, 6).tolist())
    with pytest.raises(KeyError):
        roads.remove(out[0])
    with pytest.raises(ValueError, match="is here already"):
        roads.add(edges[0])


def test_of_parallel_edges_the_surest_counts() -> None:
    T = np.eye(4)
    roads = Roads()
    loose, sure = Edge(4, 9, T, 4 * LOOP), Edge(9, 4, T, LOOP)
    poses = {4: T, 9: T}
    roads.add(loose)
    roads.add(sure)
    assert roads.known_from(4, [9], poses)[0] == pytest.approx(LOOP)
    roads.remove(sure)
    assert roads.known_from(4, [9], poses)[0] == pytest.approx(4 * LOOP)
    roads.remove(loose)
    assert roads.known_from(4, [9, 4], poses)[0] is None


def test_where_no_road_leads() -> None:
    roads = Roads()
    assert roads.known_from(3, [], {}) == []
    cov = roads.known_from(3, [3, 5], {3: np.eye(4), 5: np.eye(4)})
    assert np.array_equal(cov[0], np.zeros((6, 6))) and cov[1] is None
