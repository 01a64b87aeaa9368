"""A room played in virtual time with modelled mapping: what each camera sees, and the errors of its agents.

Keyframes as in measure_load.py, odometry that drifts, frames at 30 Hz, evaluations with the true error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any

import numpy as np
from keyframe_set import AgentKeyframes, KeyframeSet
from modelled_mapper import GroundTruth, ModelledMapper, RecognitionModel

from share.config import NEAR_M, POLICY_NAMES, STREAMED, Config
from share.geometry.interpolation import Trajectory
from share.geometry.se3 import transform, umeyama
from share.lab.evaluate.emulated_network import LinkAssignment
from share.lab.evaluate.processing_delays import ProcessingDelays
from share.lab.evaluate.simulation import Simulation, TrackedFrame
from share.metrics.frame_log import summary as summarised
from share.metrics.local_error import LocalError
from share.protocol.agent_events import LocalisedPose
from share.types import F64, I64, OdometryKeyframe

# others have agents that send raw frames
SIMULATED = [policy for policy in POLICY_NAMES if policy != STREAMED]
FRAME_NS = 33_333_333

Row = dict[str, Any]


def play(made: KeyframeSet, config: Config, link: str, seed: int) -> Row:
    """Simulate one run, with a mapper that knows the true poses and needs no views. busy, solving: of the
    edge's mapper and solver, in seconds a second; passed_over: keyframes that were not looked up."""
    who = list(made.agents.values())
    seen, truth, seconds = frames_of_all(made, seed)
    known = truth_of(made, NEAR_M, config.control.far_m)
    mapper = ModelledMapper(config, known, which(truth), RecognitionModel(), seed)
    links = LinkAssignment.parse(link)
    links.check(made.agents, virtual=True)
    networks = [links.network_for(agent.hello.name) for agent in who]
    members = list(zip((a.hello for a in who), seen, networks, strict=True))
    world = Simulation(config, members, ProcessingDelays(), seed, mapper)
    world.run(seconds + 2.0)
    report = world.edge.report(world.mapper.report())
    agents = {}
    for agent in who:
        log, own = world.logs[agent.hello.name].report(), report["agents"][agent.hello.name]
        series = world.edge.series()[agent.hello.name]
        agents[agent.hello.name] = {
            **{
                part: log[part]["mean"] or float("nan") for part in ("latency_ms", "track_ms", "corrected_ms")
            },
            "corrected": log["corrected_ms"]["n"],
            "sent": own["keyframes"],
            "rate_hz": own["rate_hz"],
            "qoe": mean(series["qoe"]),
        }
    errors_cm = shared_errors(world.localised, truth)
    for name, row in agents.items():
        row["error_cm"] = errors_cm.get(name, float("nan"))
    metres = sum(float(np.linalg.norm(np.diff(a.T_world_body[:, :3, 3], axis=0), axis=1).sum()) for a in who)
    corrected_ms = np.concatenate([log.frames().corrected_ms for log in world.logs.values()])
    late_ms = corrected_ms[corrected_ms > 0]
    whole = {
        "metres": metres,
        "maps": len({own["map_id"] for own in report["agents"].values()}),
        "corrected_ms": summarised(late_ms).report(),
        "busy": world.mapper_busy_ns / world.now_ns,
        "solving": world.solver_busy_ns / world.now_ns,
        "passed_over": sum(own["queries_skipped"] for own in report["agents"].values()),
    }
    return {"policy": config.edge.policy, "seed": seed, "agents": agents, **report["merges"], **whole}


@lru_cache(1)  # runs in a room follow each other
def truth_of(made: KeyframeSet, near_m: float, far_m: float) -> GroundTruth:
    who = made.agents.items()
    return GroundTruth(near_m, far_m, {n: a.hello.rig for n, a in who}, {n: a.T_world_body for n, a in who})


def which(truth: dict[str, Trajectory]) -> Callable[[str, int], int]:
    """Return a function that gives the index of an agent's keyframe by its stamp."""
    at = {name: {ns: k for k, ns in enumerate(stamps_ns.tolist())} for name, (stamps_ns, _) in truth.items()}
    return lambda name, stamp_ns: at[name][stamp_ns]


def frames_of_all(
    made: KeyframeSet, seed: int
) -> tuple[list[Iterator[TrackedFrame]], dict[str, tuple[I64, F64]], float]:
    """Return each agent's frames, its keyframes' times (N,), ns, and true poses (N, 4, 4) by name, and the
    duration, s. Cameras are not in step."""
    who = list(made.agents.values())
    first_ns = min(agent.keyframes[0].stamp_ns for agent in who)
    last_ns = max(agent.keyframes[-1].stamp_ns for agent in who)
    rng = np.random.default_rng((seed, 9))
    zeros_ns = [first_ns - int(rng.integers(FRAME_NS)) for _ in who]
    seen = [looks(agent, zero_ns, last_ns) for agent, zero_ns in zip(who, zeros_ns, strict=True)]
    truth = {
        a.hello.name: (np.array([k.stamp_ns - zero_ns for k in a.keyframes]), a.T_world_body)
        for a, zero_ns in zip(who, zeros_ns, strict=True)
    }
    return seen, truth, (last_ns - first_ns) / 1e9


def looks(agent: AgentKeyframes, first_ns: int, last_ns: int) -> Iterator[TrackedFrame]:
    """Yield frames at 30 Hz since `first_ns`; a keyframe replaces the frame that is due by then."""
    at_ns, error_before_cm = first_ns, None
    for stamp_ns, candidate, error_cm in offered(agent):
        T = candidate.T_odom_body
        while at_ns < stamp_ns - FRAME_NS // 2:
            yield TrackedFrame(at_ns - first_ns, T, error_before_cm)
            at_ns += FRAME_NS
        yield TrackedFrame(stamp_ns - first_ns, T, error_cm, candidate)
        at_ns, error_before_cm = stamp_ns + FRAME_NS, error_cm
    while at_ns < last_ns:
        yield TrackedFrame(at_ns - first_ns, agent.T_odom_body[-1], error_before_cm)
        at_ns += FRAME_NS


@lru_cache(64)
def offered(agent: AgentKeyframes) -> list[tuple[int, OdometryKeyframe, float | None]]:
    """Return every keyframe as its tracker publishes it, its stamp, and odometry's error (cm) by then."""
    stamps = np.array([k.stamp_ns for k in agent.keyframes])
    error = LocalError((stamps, agent.T_world_body))
    out = []
    for keyframe, T in zip(agent.keyframes, agent.T_odom_body, strict=True):
        up, fresh = (keyframe.up, keyframe.up_sigma), keyframe.reference < 0
        seen = keyframe.view, fresh, keyframe.image
        candidate = OdometryKeyframe(T, keyframe.T_ref_body, keyframe.cov, *up, *seen)
        out.append((keyframe.stamp_ns, candidate, error.update(keyframe.stamp_ns, T)))
    return out


def shared_errors(placed: dict[str, list[LocalisedPose]], truth: dict[str, Trajectory]) -> dict[str, float]:
    """Return, for each agent, the error (cm rms) of its localised poses in a map shared with others, at the
    stamps of `truth`. Every map is aligned to the ground truth once, for all agents in it."""
    by_map: dict[str, list[tuple[str, F64, F64]]] = {}
    for name, poses in placed.items():
        stamps_ns, T_world_body = truth[name]
        at = dict(zip(stamps_ns.tolist(), T_world_body[:, :3, 3], strict=True))
        for pose in poses:
            if pose.stamp_ns in at and pose.map_id is not None and pose.T_map_odom is not None:
                p = (pose.T_map_odom @ pose.T_odom_body)[:3, 3]
                by_map.setdefault(pose.map_id, []).append((name, p, at[pose.stamp_ns]))
    square: dict[str, list[float]] = {name: [] for name in placed}
    for rows in by_map.values():
        if len({name for name, _, _ in rows}) < 2:
            continue
        p, q = (np.array([row[i] for row in rows]) for i in (1, 2))
        for (name, _, _), off in zip(rows, ((transform(umeyama(p, q), p) - q) ** 2).sum(1), strict=True):
            square[name].append(float(off))
    return {name: 100 * float(np.sqrt(np.mean(squares))) for name, squares in square.items() if squares}


def mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else float("nan")
