"""Odometry over several keyframes in the map graph: what enters it, what leaves it, what it gains."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.atlas_sim import EMPTY, UP, UP_SIGMA, Walker, answer, error, loop, near_loops, settle
from helpers.hellos import hello_of

from share.config import MergeConfig
from share.earlier_poses import EarlierPoses
from share.geometry import se3
from share.mapping.atlas import Atlas
from share.mapping.keyframe_removal import remove_keyframe
from share.mapping.map_changes import SaveKeyframe, SaveRun
from share.mapping.map_graph import MapGraph
from share.store.map_store import MapStore
from share.types import F64, Keyframe

BACK = 13, 7, 3  # keyframes, oldest first
DRIFT = np.diag([0.0003**2] * 3 + [0.001**2] * 3)  # of odometry, a keyframe
JITTER = np.diag([0.003**2] * 3 + [0.008**2] * 3)  # of a keyframe against all earlier ones, when it is sent
Spans = Callable[[int, int, F64, F64], tuple[F64, F64]]  # of keyframe and earlier one: what is said


def honest(k: int, before: int, T: F64, cov: F64) -> tuple[F64, F64]:
    return T, cov


def spanning(name: str, seed: int, say: Spans | None = honest, phase: float = 0.0) -> Walker:
    """A walker whose keyframes also tell the motion since earlier ones: a keyframe has one error of its own
    against all of them, and odometry drifts little, so that a chain of steps adds up what a span has once.

    say: changes the spans; None: there are none."""
    walker, rng = Walker(name, seed, phase=phase), np.random.default_rng(seed + 100)
    n = len(walker.truth)
    drift, jitter = (rng.multivariate_normal(np.zeros(6), cov, n) for cov in (DRIFT, JITTER))
    keyframes: list[Keyframe] = []

    def seen(k: int, before: int) -> tuple[F64, F64]:
        T = np.eye(4)
        for i in range(before + 1, k + 1):
            T = T @ se3.inverse(walker.truth[i - 1]) @ walker.truth[i] @ se3.exp(drift[i])
        return T @ se3.exp(jitter[k]), (k - before) * DRIFT + JITTER

    for k, sent in enumerate(walker.keyframes):
        if k:
            T, cov = seen(k, k - 1)
            sent = replace(sent, T_ref_body=T, cov=cov, T_odom_body=keyframes[-1].T_odom_body @ T)
            if say is not None and (back := [k - d for d in BACK if d <= k]):
                told = [say(k, before, *seen(k, before)) for before in back]
                sent = replace(sent, earlier=earlier_poses(back, told))
        keyframes.append(sent)
    walker.keyframes, walker.T_odom_body = keyframes, [one.T_odom_body for one in keyframes]
    return walker


def earlier_poses(ids: Sequence[int], told: Sequence[tuple[F64, F64]]) -> EarlierPoses:
    T, cov = zip(*told, strict=True)
    return EarlierPoses(np.array(ids), np.array(T, np.float32), np.array(cov, np.float32))


def atlas_of(*walkers: Walker) -> Atlas:
    """Keyframes come in turns."""
    atlas = Atlas(MergeConfig())
    for k in range(len(walkers[0].keyframes)):
        for walker in walkers:
            atlas.add_keyframe(walker.name, walker.keyframes[k])
    return atlas


def spans(graph: MapGraph) -> set[tuple[str, int, int]]:
    """(agent, earlier keyframe, keyframe)."""
    nodes = graph.odometry.nodes
    ends = ((graph.edges.by_id[n].a, graph.edges.by_id[n].b) for n in graph.edges.spans)
    return {(nodes[a].key.agent, nodes[a].key.id, nodes[b].key.id) for a, b in ends}


def all_spans(name: str, n: int = 60) -> set[tuple[str, int, int]]:
    return {(name, k - d, k) for k in range(n) for d in BACK if d <= k}


def mean_error(walkers: Sequence[Walker], others: Sequence[Walker] = ()) -> float:
    """Error, m, of the walkers in a map with loops between all of them; `others` are in it too."""
    everybody = [*walkers, *others]
    atlas, rng = atlas_of(*everybody), np.random.default_rng(5)
    for i, a in enumerate(everybody):
        for b in everybody[i:]:
            for found in near_loops(a, b, rng, every=12):
                atlas.propose(found)
    settle(atlas)
    assert len(atlas.map_sizes()) == 1
    poses = dict(zip(map(tuple, atlas.all_poses().keys), atlas.all_poses().T_map_body, strict=True))
    mine = np.array([poses[w.name, k] for w in walkers for k in range(len(w.truth))])
    return error(mine, np.concatenate([w.truth for w in walkers]))


def test_a_map_with_spans_is_more_accurate() -> None:
    with_spans, without = (
        np.mean(
            [
                mean_error([spanning("ann", seed, say), spanning("bob", seed + 50, say, 0.7)])
                for seed in (1, 2)
            ]
        )
        for say in (honest, None)
    )
    assert with_spans < 0.8 * without


def test_spans_connect_the_keyframes_of_a_segment() -> None:
    atlas = atlas_of(spanning("ann", 1), spanning("bob", 2))
    assert spans(atlas.graph) == all_spans("ann") | all_spans("bob")


@pytest.mark.parametrize("ids", [(40, 59), (7, 9)], ids=["unknown", "of the segment before"])
def test_a_span_to_a_keyframe_that_its_segment_does_not_have_is_left_out(ids: tuple[int, int]) -> None:
    atlas, T, cov = Atlas(MergeConfig()), np.eye(4), 1e-6 * np.eye(6)
    for k in range(14):
        before = -1 if k in (0, 10) else k - 1
        atlas.add_keyframe("ann", Keyframe(k, before, k * 10**8, T, cov, T, UP, UP_SIGMA, EMPTY))
    atlas.add_keyframe("bob", Keyframe(11, -1, 0, T, cov, T, UP, UP_SIGMA, EMPTY))
    earlier = earlier_poses([*ids, 11], [(T, cov)] * 3)
    atlas.add_keyframe("ann", Keyframe(60, 13, 10**10, T, cov, T, UP, UP_SIGMA, EMPTY, earlier=earlier))
    assert spans(atlas.graph) == {("ann", 11, 60)}


def test_a_span_to_a_removed_keyframe_is_left_out() -> None:
    ann, atlas = spanning("ann", 1), Atlas(MergeConfig())
    for keyframe in ann.keyframes[:20]:
        atlas.add_keyframe("ann", keyframe)
    assert [out.node_id for out in atlas.remove_keyframes([7])] == [7]
    atlas.add_keyframe("ann", ann.keyframes[20])
    assert {earlier for _, earlier, k in spans(atlas.graph) if k == 20} == {13, 17}


def test_spans_go_with_either_keyframe_and_its_step_and_loops_move_as_before() -> None:
    ann, plain, rng = spanning("ann", 1), spanning("ann", 1, None), np.random.default_rng(0)
    bob = Walker("bob", 2, phase=0.7)
    removed = []
    for walker in (ann, plain):
        graph = MapGraph()
        for one in (walker, bob):
            for keyframe in one.keyframes:
                graph.add_spans(graph.add_keyframe(one.name, keyframe, keyframe.cov, keyframe.up), keyframe)
        graph.add_loop(loop(ann, 30, bob, 20, rng))
        removed.append((graph, remove_keyframe(graph, 30)))
    (graph, with_spans), (_, without) = removed
    assert spans(graph) == {one for one in all_spans("ann") if 30 not in one}
    assert with_spans.link is not None and without.link is not None
    np.testing.assert_allclose(with_spans.link.T_ref_body, without.link.T_ref_body, atol=1e-12)
    np.testing.assert_allclose(with_spans.link.cov, without.link.cov, rtol=1e-9)
    assert [moved.a for moved in with_spans.moved_loops] == [moved.a for moved in without.moved_loops]
    touched = {end for edge in graph.edges.by_id.values() for end in (edge.a, edge.b)}
    assert 30 not in touched


def test_spans_shorten_covariance_paths_and_count_less_than_they_say() -> None:
    """They share measurements with the steps: half of their information."""
    ann = spanning("ann", 1)
    T, cov = np.array(ann.keyframes[40].earlier.T_earlier_body[0], np.float64), 13 * DRIFT + JITTER
    (bound,) = atlas_of(ann).graph.relative_estimates(27, [40]).cov
    (of_steps,) = atlas_of(spanning("ann", 1, None)).graph.relative_estimates(27, [40]).cov
    assert cov.trace() < bound.trace() < 0.6 * of_steps.trace()
    assert bound.trace() == pytest.approx(2 * cov.trace(), rel=0.3)
    assert np.isfinite(T).all()


def test_the_solver_has_spans_under_the_robust_kernel_and_reports_them_as_no_loops() -> None:
    ann = spanning("ann", 1)
    atlas = atlas_of(ann)
    for found in near_loops(ann, ann, np.random.default_rng(5)):
        atlas.graph.add_loop(found)
    edges = atlas.graph.edges
    job, solution = answer(atlas, "ann/0")
    assert set(job.change.edge_ids[job.change.is_loop].tolist()) == edges.spans | edges.loops.keys()
    assert edges.spans and edges.loops
    done = atlas.solving.apply(job, solution)
    assert f"60 poses, {len(edges.loops)} loops solved" in done.reason
    assert spans(atlas.graph) == all_spans("ann")


def test_spans_are_rescaled_with_their_agent_only_and_later_ones_too() -> None:
    ann, bob = spanning("ann", 1), spanning("bob", 2)
    atlas = atlas_of(ann, bob)
    graph = atlas.graph
    before = {n: graph.edges.by_id[n] for n in graph.edges.spans}
    at = {(edge.a, edge.b): edge for edge in before.values()}
    graph.rescale_odometry("ann", 0.1, 4.0)
    assert spans(graph) == all_spans("ann") | all_spans("bob")
    for n in graph.edges.spans:
        edge = graph.edges.by_id[n]
        old = at[edge.a, edge.b]
        scaled = graph.odometry.nodes[edge.a].key.agent == "ann"
        np.testing.assert_allclose(edge.T_a_b[:3, 3], old.T_a_b[:3, 3] * (np.exp(-0.1) if scaled else 1))
        np.testing.assert_allclose(edge.T_a_b[:3, :3], old.T_a_b[:3, :3])
        np.testing.assert_allclose(edge.cov, old.cov * (4.0 if scaled else 1))
    late = replace(ann.keyframes[-1], id=60, reference=59)  # with the same spans
    node = graph.add_keyframe("ann", late, late.cov, late.up)
    graph.add_spans(node, late)
    by_ends = {(edge.a, edge.b): edge for edge in map(graph.edges.by_id.__getitem__, graph.edges.spans)}
    for before in (92, 104, 112):  # nodes of keyframes 46, 52 and 56 of ann
        np.testing.assert_allclose(by_ends[before, node].T_a_b, by_ends[before, 118].T_a_b)
        np.testing.assert_allclose(by_ends[before, node].cov, by_ends[before, 118].cov, rtol=0.01)


def test_spans_come_back_after_a_restart_of_the_edge(tmp_path: Path) -> None:
    ann, atlas = spanning("ann", 1), Atlas(MergeConfig())
    changes = [SaveRun("ann", hello_of("ann", 1))]
    for keyframe in ann.keyframes:
        atlas.add_keyframe("ann", keyframe)
        changes.append(SaveKeyframe("ann", keyframe))
    for out in atlas.remove_keyframes([20, 21, 33]):
        changes += out.changes
    with MapStore.open(tmp_path / "map.db") as store:
        store.write([*changes, atlas.all_poses()])
    with MapStore.open(tmp_path / "map.db") as store:
        kept = store.load()
    again = Atlas(MergeConfig())
    again.restore(kept, [0] * len(kept.segments))
    gone = {20, 21, 33}
    assert (
        spans(again.graph)
        == spans(atlas.graph)
        == {one for one in all_spans("ann") if not gone & set(one[1:])}
    )
    covs = [
        sorted(graph.edges.by_id[n].cov.trace() for n in graph.edges.spans)
        for graph in (again.graph, atlas.graph)
    ]
    np.testing.assert_allclose(*covs)


def off_by(xi: Sequence[float], cov: float | None = None) -> Spans:
    wrong = se3.exp(np.array(xi))

    def say(k: int, before: int, T: F64, stated: F64) -> tuple[F64, F64]:
        return T @ wrong, stated if cov is None else cov * np.eye(6)

    return say


def error_beside(said: Spans | None) -> float:
    """Mean error, m, of two whose spans are right, beside a third that says this."""
    good = [spanning("ann", 5), spanning("bob", 55, phase=2.0)]
    return mean_error(good, [spanning("eve", 11, said, phase=1.4)])


@pytest.fixture(scope="module")
def usual_m() -> float:
    return error_beside(None)


@pytest.mark.parametrize(
    "lie",
    [
        off_by([0, 0, 0, 0.5, 0, 0]),
        off_by([0, 0, 0, 0.5, 0, 0], 0.0),
        off_by([0, 0, 0.3, 0, 0, 0], 0.0),
        off_by([0, 0, 0.01, 0.03, 0, 0], 0.0),
        off_by([0, 0, 0, 0, 0, 0], 0.0),
    ],
    ids=["half a metre", "and certain", "turned", "a little, and certain", "right, and certain"],
)
def test_spans_that_contradict_their_steps_or_claim_to_be_exact_do_not_bend_others(
    lie: Spans, usual_m: float
) -> None:
    assert error_beside(lie) < 1.2 * usual_m
