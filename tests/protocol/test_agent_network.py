"""The agent against a model edge over a network that loses, duplicates and reorders, in virtual time."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from helpers.model_edge import HELLO, MS, ModelEdge, Network, S, World, tracked
from hypothesis import example, given, settings
from hypothesis import strategies as st

from share.config import AgentConfig, Config
from share.geometry import se3
from share.protocol import agent_events as ev
from share.protocol.agent import AgentProtocol
from share.protocol.common_events import PrintLine
from share.types import Keyframe

FRAMES = 240  # 12 s at 20 Hz
STEP = 50 * MS
PATIENT = 600.0  # s of virtual time that the end may take: every loss is made good in it


def frames(seed: int) -> list[ev.FrameTracked]:
    """A walk whose odometry sometimes breaks; every third frame or so is a candidate."""
    rng = np.random.default_rng(seed)
    T, made = np.eye(4), []
    for k in range(FRAMES):
        T = se3.orthonormal(T @ se3.exp(rng.normal(scale=0.05, size=6)))
        candidate = bool(rng.random() < 0.3)
        made.append(tracked(k, T, candidate, new_stretch=candidate and rng.random() < 0.05))
    return made


def check_applied(applied: list[Keyframe], walk: list[ev.FrameTracked], begin: int = 0) -> None:
    """Check that keyframes are applied once and in order, and that their chain gives odometry's poses."""
    T_odom = {}
    assert all(earlier.id < later.id for earlier, later in pairwise(applied))
    for keyframe in applied:
        frame = walk[(keyframe.stamp_ns - 10**15) // STEP]
        assert frame.T_odom_body is not None
        if keyframe.reference < 0:
            assert keyframe.reference == -1
            T_odom[keyframe.id] = keyframe.T_ref_body
        elif keyframe.reference in T_odom:
            T_odom[keyframe.id] = T_odom[keyframe.reference] @ keyframe.T_ref_body
        else:  # what an edge with memory had applied in an earlier life
            assert keyframe.reference < begin
            T_odom[keyframe.id] = frame.T_odom_body
        np.testing.assert_allclose(T_odom[keyframe.id], frame.T_odom_body, atol=1e-9)


networks = st.fixed_dictionaries(
    {"loss": st.floats(0, 0.4), "twice": st.floats(0, 0.3), "delay_ms": st.floats(0, 400)}
)
seeds = st.integers(0, 2**32 - 1)


def world(walk_seed: int, network: dict[str, float], edge: ModelEdge | None, keep: int = 600) -> World:
    rng = np.random.default_rng(walk_seed)
    config = Config(agent=AgentConfig(keep_keyframes=keep, finish_s=PATIENT))
    return World(AgentProtocol(HELLO, config), edge, lambda: Network(rng, **network))


def finish(run: World) -> None:
    """Ends the run and lets virtual time pass until the agent stops."""
    run.step(run.now_ns + STEP, ev.InputFinished())
    while not run.stopped:
        run.step(run.now_ns + STEP)
        assert run.now_ns < 2 * PATIENT * S


@given(seeds, networks)
@settings(max_examples=6, deadline=None)
@pytest.mark.long
def test_over_a_bad_network_every_keyframe_is_applied_once_and_in_order(
    seed: int, network: dict[str, float]
) -> None:
    walk, edge = frames(seed), ModelEdge(1)
    run = world(seed, network, edge)
    for frame in walk:
        run.step(frame.done_ns, frame)
    finish(run)
    report = run.agent.report()
    assert [k.id for k in edge.applied] == list(range(report["keyframes"]))
    assert report["pending"] == 0
    assert report["acknowledged"] == report["keyframes"] == report["candidates"]
    check_applied(edge.applied, walk)


@pytest.mark.slow
@given(seeds, networks, st.integers(1, 12), st.integers(20, FRAMES - 20), st.integers(1, 150))
@settings(max_examples=15, deadline=None)
@pytest.mark.long
def test_an_outage_that_overflows_the_ledger_leaves_a_consistent_chain(
    seed: int, network: dict[str, float], keep: int, gone_at: int, gone_for: int
) -> None:
    walk, edge = frames(seed), ModelEdge(1)
    run = world(seed, network, edge, keep)
    for k, frame in enumerate(walk):
        if k == gone_at:
            run.replace_edge(None)
        if k == gone_at + gone_for:
            run.replace_edge(edge)
        run.step(frame.done_ns, frame)
        assert run.agent.report()["kept"] <= keep
    run.replace_edge(edge)
    finish(run)
    report = run.agent.report()
    assert report["pending"] == 0
    assert report["keyframes"] - len(edge.applied) <= report["drop_oldest"]
    assert edge.applied[-1].id == report["keyframes"] - 1
    check_applied(edge.applied, walk)


@example(  # a keyframe of before the restart arrives after it, and is never sent again
    seed=246,
    network={"loss": 0.012345321315789186, "twice": 0.2556000252531316, "delay_ms": 260.0},
    keep=34,
    kills=[(1, True), (195, False), (226, False)],
)
@given(
    seeds,
    networks,
    st.integers(1, 60),
    st.lists(st.tuples(st.integers(1, FRAMES - 1), st.booleans()), max_size=3),
)
@settings(max_examples=6, deadline=None)
@pytest.mark.long
def test_restarted_edges_get_missing_keyframes(
    seed: int, network: dict[str, float], keep: int, kills: list[tuple[int, bool]]
) -> None:
    walk, lives = frames(seed), [ModelEdge(1)]
    run = world(seed, network, lives[0], keep)
    deaths = dict(kills)
    for k, frame in enumerate(walk):
        if k in deaths:
            remembered = lives[-1].inorder.next_keyframe if deaths[k] else 0
            lives.append(ModelEdge(len(lives) + 1, remembered))
            run.replace_edge(lives[-1])
        run.step(frame.done_ns, frame)
        assert run.agent.report()["kept"] <= keep
    finish(run)
    for edge in lives:
        check_applied(edge.applied, walk, edge.next_keyframe)
    assert run.agent.report()["pending"] == 0
    if (
        run.agent.report()["edge_session"] == lives[-1].session and lives[-1].applied
    ):  # else the end came before it was noticed
        assert lives[-1].applied[-1].id == run.agent.report()["keyframes"] - 1


def test_an_edge_without_map_is_sent_all_kept_keyframes() -> None:
    walk = frames(3)
    run = world(3, {}, ModelEdge(1))
    for frame in walk[:200]:
        run.step(frame.done_ns, frame)
    run.step(run.now_ns + 2 * MS)
    run.step(run.now_ns + 2 * MS)
    held = run.agent.report()["keyframes"]
    assert held > 40
    assert run.agent.report()["pending"] == 0
    run.replace_edge(second := ModelEdge(2))
    for frame in walk[200:]:
        run.step(frame.done_ns, frame)
    assert [k.id for k in second.applied[:held]] == list(range(held))
    check_applied(second.applied, walk)
    lines = [effect.text for effect in run.effects if isinstance(effect, PrintLine)]
    assert lines[0] == "connected to the edge"
    assert lines[1].startswith("the edge has restarted; ")


def odometry(run: World) -> list[bytes]:
    """All poses of odometry that a user gets, bit for bit."""
    return [
        b"%d %d %b" % (effect.index, effect.stamp_ns, effect.T_odom_body.tobytes())
        for effect in run.effects
        if isinstance(effect, ev.LocalisedPose)
    ]


@given(seeds, networks)
@settings(max_examples=5, deadline=None)
@pytest.mark.long
def test_odometry_is_the_same_bits_with_and_without_an_edge(seed: int, network: dict[str, float]) -> None:
    walk = frames(seed)
    runs = [world(seed, network, edge) for edge in (ModelEdge(1), None, ModelEdge(1))]
    for k, frame in enumerate(walk):
        if k == FRAMES // 2:
            runs[2].replace_edge(None)
        for run in runs:
            run.step(frame.done_ns, frame)
    assert runs[0].agent.report()["corrections"] > 0
    assert odometry(runs[0]) == odometry(runs[1]) == odometry(runs[2])
    assert len(odometry(runs[0])) == FRAMES


def plain(effect: ev.AgentEffect) -> list[object]:
    """An effect in comparable form; arrays and frames as bytes."""
    values = [getattr(effect, field.name) for field in dataclasses.fields(effect)]
    return [type(effect), *(comparable(value) for value in values)]


def comparable(value: object) -> object:
    if isinstance(value, list):
        return [bytes(frame) for frame in value]
    return value.tobytes() if isinstance(value, np.ndarray) else value


def test_the_same_events_at_the_same_times_give_the_same_effects() -> None:
    traces = []
    for _ in range(2):
        run = world(9, {"loss": 0.2, "delay_ms": 200.0}, ModelEdge(1))
        for frame in frames(9):
            run.step(frame.done_ns, frame)
        finish(run)
        traces.append(([plain(effect) for effect in run.effects], run.agent.report()))
    assert traces[0] == traces[1]
