"""Number of agents that one edge can serve, in virtual time with modelled mapping.

    python tools/experiments/simulate_scale.py [--agents 3 6 12 24 50] [--rooms-of 10x5] \\
        [--policies covins-g share] \\
        [--link wifi5] [--seeds 401:403] [--set SECTION.NAME=VALUE] [--workers 2] [--json FILE]

Two headsets per robot walk for a minute in a warehouse that grows with their number, or equally many in each
of several distant rooms of one edge. Every agent has its own link. Prints a Markdown table, means over seeds:
latency of headsets; corrections, median and 95 %; load of the edge's mapper and solver; share of keyframes
never looked up; merges a metre; errors in the map.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from keyframe_making import make_unseen  # noqa: E402
from keyframe_set import AgentKeyframes, KeyframeSet, Spacing  # noqa: E402
from measure_joins import configured  # noqa: E402
from modelled_room import SIMULATED, Row, mean, play  # noqa: E402
from tool_main import exit_code, line, seed_range  # noqa: E402

from share.config import with_policy  # noqa: E402
from share.errors import UsageError  # noqa: E402
from share.lab.emulate.recipe import SessionRecipe  # noqa: E402
from share.spawning import SPAWN_CONTEXT  # noqa: E402

KINDS = ("ar", "ar", "robot")
APART_M = 1000.0  # between rooms
HEAD = ("agents", "policy", "AR latency ms", "corrections: p50, p95 ms", "a second", "mapper", "solver")
HEAD += ("passed over", "merges a metre", "error cm: headsets, robots", "maps")
Size = tuple[int, int]  # rooms, agents in each
Job = tuple[Size, int, tuple[str, ...], str, tuple[str, ...]]  # size, seed, policies, link, settings


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--agents", nargs="*", type=int, default=[3, 6, 12, 24, 50], help="in one room")
    parser.add_argument("--rooms-of", nargs="*", default=["10x5"], metavar="ROOMSxAGENTS")
    parser.add_argument("--policies", nargs="+", choices=SIMULATED, default=["covins-g", "share"])
    parser.add_argument("--link", default="wifi5")
    parser.add_argument("--seeds", type=seed_range, default="401:403", metavar="FIRST:END")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.NAME=VALUE")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    return exit_code("simulate_scale", lambda: simulate(options))


def simulate(options: argparse.Namespace) -> None:
    """Run every size by every policy, seed by seed."""
    seeds, sizes = options.seeds, [(1, n) for n in options.agents] + list(map(_size, options.rooms_of))
    jobs: list[Job] = [
        (size, seed, tuple(options.policies), options.link, tuple(options.set))
        for size in sizes
        for seed in seeds
    ]
    print("\n".join(line(cells) for cells in (HEAD, ["---"] * len(HEAD))), flush=True)
    rows: list[Row] = []
    with ProcessPoolExecutor(options.workers, SPAWN_CONTEXT) as pool:
        played = pool.map(_played, jobs)
        for size in sizes:
            runs = [next(played) for _ in seeds]
            for of_policy in zip(*runs, strict=True):
                print(line(cells_of(size, of_policy)), flush=True)
                rows += [{"rooms": size[0], "each": size[1], **row} for row in of_policy]
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


def _size(text: str) -> Size:
    rooms, _, each = text.partition("x")
    if not (rooms.isdecimal() and each.isdecimal()):
        raise UsageError(f"'{text}': expected ROOMSxAGENTS, such as 10x5")
    return int(rooms), int(each)


def _played(job: Job) -> list[Row]:
    """Return a run by each policy."""
    (rooms, each), seed, policies, link, settings = job
    made, config = apart([_room(seed + 1000 * k, each) for k in range(rooms)]), configured(settings)
    return [play(made, with_policy(config, policy), link, seed) for policy in policies]


def _room(seed: int, agents: int) -> KeyframeSet:
    """Return a room with about the same area per agent, within a warehouse's limits."""
    kinds = [KINDS[k % len(KINDS)] for k in range(agents)]
    motions = tuple(f"{kind}{k}={'walk' if kind == 'ar' else 'robot'}:" for k, kind in enumerate(kinds))
    side = max(8.0, 3.0 * agents**0.5 + 3)
    width = min(side, 20.0)
    size = side**2 / width, width, 4.0
    return make_unseen(SessionRecipe("warehouse", motions, 60.0, seed=seed, size=size), Spacing())


def apart(rooms: Sequence[KeyframeSet]) -> KeyframeSet:
    """Return all rooms in one world, out of sight of each other; agents get their room's name if there are
    several rooms. Recipe, spacing and size are those of the first."""
    agents = {}
    for k, made in enumerate(rooms):
        for name, agent in made.agents.items():
            own = name if len(rooms) == 1 else f"{name}of{k}"
            agents[own] = _moved(agent, own, k * APART_M)
    return replace(rooms[0], agents=agents)


def _moved(agent: AgentKeyframes, name: str, metres: float) -> AgentKeyframes:
    T = agent.T_world_body.copy()
    T[:, 0, 3] += metres
    return replace(agent, hello=replace(agent.hello, name=name), T_world_body=T)


def cells_of(size: Size, runs: Sequence[Row]) -> list[str]:
    """Return the cells of one size and policy; runs: one a seed."""

    def average(figure: str, kind: str = "") -> float:
        values = [a[figure] for run in runs for name, a in run["agents"].items() if name.startswith(kind)]
        return float(np.nanmean(values)) if values else float("nan")

    sent = [sum(a["sent"] for a in run["agents"].values()) for run in runs]
    late = [run["corrected_ms"] for run in runs]
    return [
        str(size[1]) if size[0] == 1 else f"{size[0]} × {size[1]}",
        runs[0]["policy"],
        f"{average('latency_ms', 'ar'):.1f}",
        f"{mean([ms['p50'] for ms in late]):.0f}, {mean([ms['p95'] for ms in late]):.0f}",
        f"{mean([ms['n'] for ms in late]) / 60:.1f}",
        f"{mean([run['busy'] for run in runs]):.2f}",
        f"{mean([run['solving'] for run in runs]):.2f}",
        f"{mean([run['passed_over'] / n for run, n in zip(runs, sent, strict=True)]):.2f}",
        f"{mean([run['done'] / run['metres'] for run in runs]):.1f}",
        f"{average('error_cm', 'ar'):.2f}, {average('error_cm', 'robot'):.2f}",
        f"{mean([run['maps'] for run in runs]):.1f}",
    ]


if __name__ == "__main__":
    sys.exit(main())
