"""Policies in virtual time: real machines of agents, edge and mapper; how long things take is drawn.

    python tools/simulate.py [--policies covins-g share] [--link wifi5] [--seeds 0:3] \\
        [--set control.attribution=true]

Two headsets and a robot, a minute in an emulated warehouse (keyframes as in tools/measure_load.py, odometry
that drifts, frames at 30 Hz, evaluations with the true error). Prints a Markdown table: means over seeds of
latency (as docs/evaluation.md has it) and its parts, keyframes sent, merges, the joint ATE of keyframes in
the largest map.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from share import process

process.prepare()

import numpy as np  # noqa: E402
from keyframe_set import AgentKeyframes, KeyframeSet  # noqa: E402
from load_room import room  # noqa: E402
from measure_joins import configured  # noqa: E402
from tool_main import exit_code, line  # noqa: E402

from share.config import POLICIES, Config  # noqa: E402
from share.core.world import Costs, Seen, World  # noqa: E402
from share.io.transport.shaped import network  # noqa: E402
from share.metrics.ate import joint_ate  # noqa: E402
from share.metrics.local_error import LocalError  # noqa: E402
from share.types import Candidate  # noqa: E402

FRAME_NS = 33_333_333
HEAD = ("policy", "agent", "latency ms", "frames ms", "corrected ms", "n", "sent", "Hz told", "QoE")

Row = dict[str, Any]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--policies", nargs="*", choices=POLICIES, default=["covins-g", "share"])
    parser.add_argument("--link", default="wifi5")
    parser.add_argument("--seeds", default="0:3", metavar="FIRST:END")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.NAME=VALUE")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    return exit_code("simulate", lambda: simulate(options))


def simulate(options: argparse.Namespace) -> None:
    """Every policy, seed by seed."""
    config, made = configured(options.set), room()
    first, end = map(int, options.seeds.split(":"))
    rows = []
    print("\n".join(line(cells) for cells in (HEAD, ["---"] * len(HEAD))), flush=True)
    for policy in options.policies:
        chosen = replace(config, edge=replace(config.edge, policy=policy))
        runs = [play(made, chosen, options.link, seed) for seed in range(first, end)]
        rows += runs
        for name in runs[0]["agents"]:
            print(line(cells_of(policy, name, [run["agents"][name] for run in runs])))
        print(summary(policy, runs), flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2) + "\n")


def play(made: KeyframeSet, config: Config, link: str, seed: int) -> Row:
    """One run."""
    began = time.monotonic()
    who = list(made.agents.values())
    first_ns = min(agent.keyframes[0].stamp_ns for agent in who)
    last_ns = max(agent.keyframes[-1].stamp_ns for agent in who)
    rng = np.random.default_rng((seed, 9))
    zeros_ns = [first_ns - int(rng.integers(FRAME_NS)) for _ in who]  # cameras do not keep step
    seen = [looks(agent, zero_ns, last_ns) for agent, zero_ns in zip(who, zeros_ns, strict=True)]
    world = World(config, list(zip((a.hello for a in who), seen, strict=True)), network(link), Costs(), seed)
    world.run((last_ns - first_ns) / 1e9 + 2.0)
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
    ate_cm, joined = accuracy(who, zeros_ns, world)
    metres = sum(float(np.linalg.norm(np.diff(a.T_world_body[:, :3, 3], axis=0), axis=1).sum()) for a in who)
    whole = {"metres": metres, "ate_cm": ate_cm, "joined": joined, "took_s": time.monotonic() - began}
    return {"policy": config.edge.policy, "seed": seed, "agents": agents, **report["merges"], **whole}


def looks(agent: AgentKeyframes, first_ns: int, last_ns: int) -> Iterator[Seen]:
    """Frames at 30 Hz since `first_ns`; a keyframe takes the place of the frame that is due by then."""
    stamps = np.array([k.stamp_ns for k in agent.keyframes])
    error = LocalError((stamps, agent.T_world_body))
    at_ns, error_cm = first_ns, None
    for keyframe, T in zip(agent.keyframes, agent.T_odom_body, strict=True):
        while at_ns < keyframe.stamp_ns - FRAME_NS // 2:
            yield Seen(at_ns - first_ns, T, error_cm)
            at_ns += FRAME_NS
        error_cm = error.after(keyframe.stamp_ns, T)
        fresh = keyframe.reference < 0
        up = keyframe.up, keyframe.up_sigma
        candidate = Candidate(T, keyframe.T_ref_body, keyframe.cov, *up, keyframe.view, fresh)
        yield Seen(keyframe.stamp_ns - first_ns, T, error_cm, candidate)
        at_ns = keyframe.stamp_ns + FRAME_NS
    while at_ns < last_ns:
        yield Seen(at_ns - first_ns, agent.T_odom_body[-1], error_cm)
        at_ns += FRAME_NS


def accuracy(who: list[AgentKeyframes], zeros_ns: list[int], world: World) -> tuple[float, int]:
    """Joint ATE (cm) of the keyframes of the largest map at the end, and how many agents are in it."""
    kept = world.mapper.poses()
    largest = Counter(kept.maps).most_common(1)[0][0]
    pairs = {}
    for agent, zero_ns in zip(who, zeros_ns, strict=True):
        name = agent.hello.name
        own = [i for i, key in enumerate(kept.keys) if key.agent.startswith(f"{name}-")]
        mine = [i for i in own if kept.maps[i] == largest]
        if mine:
            stamps = np.array([world.stamps_ns[kept.keys[i]] for i in mine])
            true = np.array([k.stamp_ns - zero_ns for k in agent.keyframes]), agent.T_world_body
            pairs[name] = (stamps, kept.T_map_body[mine]), true
    return 100 * joint_ate(pairs).joint.rmse, len(pairs)


def summary(policy: str, runs: list[Row]) -> str:
    names = ("requested", "skipped", "done", "metres", "ate_cm", "joined", "took_s")
    told = {name: mean([run[name] for run in runs]) for name in names}
    agents = len(runs[0]["agents"])
    return (
        f"{policy}: merges requested {told['requested']:.0f}, skipped {told['skipped']:.0f}, done "
        f"{told['done']:.0f} ({told['done'] / told['metres']:.2f} a metre); {told['joined']:.1f} of {agents} "
        f"in one map, joint ATE {told['ate_cm']:.2f} cm; {told['took_s']:.0f} s a run"
    )


def cells_of(policy: str, name: str, runs: list[Row]) -> list[str]:
    figures = {key: mean([run[key] for run in runs]) for key in runs[0] if key != "rate_hz"}
    rates = [run["rate_hz"] for run in runs if run["rate_hz"] is not None]
    return [
        policy,
        name,
        *(f"{figures[key]:.1f}" for key in ("latency_ms", "track_ms", "corrected_ms")),
        f"{figures['corrected']:.0f}",
        f"{figures['sent']:.0f}",
        f"{mean(rates):.1f}" if rates else "–",
        f"{figures['qoe']:.2f}",
    ]


def mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


if __name__ == "__main__":
    sys.exit(main())
