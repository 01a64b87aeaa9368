"""Removal of redundant keyframes from the graph."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection

import numpy as np
import pytest
from helpers.atlas_sim import Walker, error, loop, near_loops

from share.config import MergeConfig
from share.geometry import se3
from share.mapping import keyframe_removal
from share.mapping.atlas import Atlas
from share.mapping.graph.solver import PoseGraphSolver
from share.mapping.keyframe_removal import remove_keyframe
from share.mapping.loops import KeyframeKey
from share.mapping.map_graph import MapGraph
from share.mapping.redundancy import redundant, run_without_pause
from share.types import F64

CONFIG = MergeConfig()


def graph_of(*walkers: Walker) -> MapGraph:
    graph = MapGraph()
    for walker in walkers:
        for keyframe in walker.keyframes:
            graph.add_keyframe(walker.name, keyframe, keyframe.cov, keyframe.up)
    return graph


def at(x: float, yaw: float = 0.0) -> F64:
    return se3.exp(np.array([0, 0, yaw, 0, 0, 0])) + np.array([[0, 0, 0, x]] + [[0.0] * 4] * 3)


def chosen(poses: F64, may_go: Collection[int], count: int, below: float = np.inf) -> list[int]:
    whose = ["ann" if k in may_go else None for k in range(len(poses))]
    return run_without_pause(redundant(poses, whose, Counter(ann=count), below))


def test_of_similar_poses_one_stays() -> None:
    poses = np.array([at(0), at(0.05), at(1), at(2), at(2.01), at(3)])
    assert sorted(chosen(poses, range(6), 2)) in ([0, 4], [1, 4], [0, 3], [1, 3])
    assert 4 in chosen(poses, range(6), 1) or 3 in chosen(poses, range(6), 1)


def test_a_rotated_pose_is_not_similar() -> None:
    poses = np.array([at(0), at(0.01, yaw=2.0), at(0.3), at(0.6)])
    assert chosen(poses, range(4), 1)[0] != 1


def test_only_removable_poses_are_chosen() -> None:
    poses = np.array([at(0.001 * k) for k in range(6)])
    assert sorted(chosen(poses, [1, 4], 5)) == [1, 4]


def test_poses_beyond_the_distance_stay() -> None:
    poses = np.array([at(0), at(0.05), at(1), at(2), at(2.01), at(3)])
    assert len(chosen(poses, range(6), 6, below=0.5)) == 2
    assert len(chosen(poses, range(6), 6)) == 6
    assert chosen(poses[:1], [0], 1) == [0]
    assert chosen(poses[:1], [0], 1, below=0.5) == []


def test_each_name_gives_its_quota() -> None:
    poses = np.array([at(0.01 * k) for k in range(12)])
    due = Counter(ann=2, bob=1)
    gone = run_without_pause(redundant(poses, ["ann", "bob", "eve"] * 4, due))
    assert Counter(k % 3 for k in gone) == {0: 2, 1: 1}
    assert due.total() == 0


def test_removing_a_keyframe_connects_its_neighbours() -> None:
    ann = Walker("ann", 1)
    graph = graph_of(ann)
    out = remove_keyframe(graph, 30)
    assert out.key == KeyframeKey("ann", 30)
    assert out.link is not None
    assert (out.link.key, out.link.reference) == (KeyframeKey("ann", 31), 29)
    assert out.link.T_ref_body == pytest.approx(se3.inverse(ann.T_odom_body[29]) @ ann.T_odom_body[31])
    assert len(graph.edges.by_id) == 58
    (known,) = graph.relative_estimates(29, [31])
    twice = se3.compose_cov(ann.keyframes[31].T_ref_body, ann.keyframes[30].cov, ann.keyframes[31].cov)
    assert known.cov == pytest.approx(twice)


def test_ambiguous_places_are_forgotten_with_their_keyframes() -> None:
    ann, atlas = Walker("ann", 1), Atlas(CONFIG)
    for keyframe in ann.keyframes:
        atlas.add_keyframe("ann", keyframe)
    atlas.loop_acceptance.ambiguous_nodes.update({20, 30})
    assert [out.node_id for out in atlas.remove_keyframes([20, 21])] == [20, 21]
    assert atlas.loop_acceptance.ambiguous_nodes == {30}


def test_after_forgetting_keyframes_no_redundant_one_of_before_is_removed() -> None:
    ann, atlas = Walker("ann", 1, n=120), Atlas(CONFIG)
    for keyframe in ann.keyframes:
        atlas.add_keyframe("ann", keyframe)
    assert len(atlas.culling.next_nodes(100)) == 2  # of 20 that were chosen
    atlas.forget_keyframes(range(40))
    assert len(atlas) == 80
    assert atlas.culling.next_nodes(100) == []


def test_without_its_first_keyframe_a_segment_begins_with_the_next() -> None:
    ann = Walker("ann", 1)
    graph = graph_of(ann)
    out = remove_keyframe(graph, 0)
    assert out.link is not None
    assert out.link.reference == -1
    assert out.link.T_ref_body == pytest.approx(ann.T_odom_body[1], abs=1e-9)


def test_loops_move_to_the_neighbour() -> None:
    ann, bob = Walker("ann", 1), Walker("bob", 2, phase=0.7)
    graph = graph_of(ann, bob)
    graph.add_loop(loop(ann, 20, bob, 10, np.random.default_rng(0)))
    out = remove_keyframe(graph, 20)
    (moved,) = out.moved_loops
    assert moved.a in (KeyframeKey("ann", 19), KeyframeKey("ann", 21))
    assert moved.b == KeyframeKey("bob", 10)
    wanted = se3.inverse(ann.truth[moved.a.id]) @ bob.truth[10]
    assert np.abs(moved.T_a_b - wanted).max() < 0.1
    assert list(graph.edges.loops.values()) == [moved]


def test_the_last_loop_between_two_segments_stays_whatever_the_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(keyframe_removal, "MAX_LOOPS", 0)
    ann, bob = Walker("ann", 1), Walker("bob", 2, phase=0.7)
    graph = graph_of(ann, bob)
    graph.add_loop(loop(ann, 20, bob, 10, np.random.default_rng(0)))
    out = remove_keyframe(graph, 20)
    assert len(out.moved_loops) == 1
    graph.update_maps()
    assert graph.reference_segments == [0, 0]


def settle(atlas: Atlas, solver: PoseGraphSolver) -> None:
    while atlas.solving.due_maps():
        job = atlas.solving.make_job(atlas.solving.due_maps()[0])
        if job.is_reset:
            solver.clear()
        solver.update(job.change)
        atlas.solving.apply(job, solver.solve(job.anchor, job.covariance_nodes))


def test_a_culled_map_is_solved_as_well_and_continues() -> None:
    walkers = Walker("ann", 1, n=200), Walker("bob", 2, n=200, phase=0.4)
    rng, atlas, solver = np.random.default_rng(0), Atlas(CONFIG), PoseGraphSolver()
    for k in range(150):
        for w in walkers:
            atlas.add_keyframe(w.name, w.keyframes[k])
    loops = near_loops(*walkers, rng, every=3)
    for x in loops:
        if max(x.a.id, x.b.id) < 150:
            atlas.propose(x)
    settle(atlas, solver)
    assert len(atlas.map_sizes()) >= 1
    before = {name: atlas.pose(KeyframeKey(name, 149)) for name in ("ann", "bob")}
    gone = {out.key for out in atlas.remove_keyframes(atlas.culling.choose(len(atlas) - 120))}
    assert len(atlas) == 120
    assert {KeyframeKey("ann", 0), KeyframeKey("ann", 149), KeyframeKey("bob", 149)}.isdisjoint(gone)
    assert atlas.map_sizes() == {"ann/0": 120}
    for name, T in before.items():
        assert np.array_equal(atlas.pose(KeyframeKey(name, 149)), T)
    for k in range(150, 200):
        for w in walkers:
            atlas.add_keyframe(w.name, w.keyframes[k])
    for x in loops:
        if not {x.a, x.b} & gone and max(x.a.id, x.b.id) >= 150:
            atlas.propose(x)
    settle(atlas, solver)
    left = [(w, k) for w in walkers for k in range(200) if KeyframeKey(w.name, k) not in gone]
    poses = np.array([atlas.pose(KeyframeKey(w.name, k)) for w, k in left])
    assert error(poses, np.array([w.truth[k] for w, k in left])) < 0.08
    for key in gone:
        with pytest.raises(ValueError, match="is not known"):
            atlas.pose(key)


def test_keyframes_removed_while_the_map_is_solved() -> None:
    walkers = Walker("ann", 1), Walker("bob", 2, phase=0.4)
    rng, atlas, solver = np.random.default_rng(0), Atlas(CONFIG), PoseGraphSolver()
    for k in range(60):
        for w in walkers:
            atlas.add_keyframe(w.name, w.keyframes[k])
    for x in near_loops(walkers[1], walkers[1], rng):
        atlas.propose(x)
    job = atlas.solving.make_job("bob/0")
    solver.update(job.change)
    solution = solver.solve(job.anchor, job.covariance_nodes)
    (gone,) = atlas.remove_keyframes([atlas.graph.odometry.node_id(KeyframeKey("bob", 30))])
    for x in near_loops(*walkers, rng):
        if gone.key not in (x.a, x.b):
            atlas.propose(x)
    assert atlas.map_sizes() == {"ann/0": 119}
    assert "due again" in atlas.solving.apply(job, solution).reason
    settle(atlas, solver)
    assert (
        error(np.array([atlas.pose(KeyframeKey("ann", k)) for k in range(0, 60, 59)]), walkers[0].truth[::59])
        < 0.2
    )
