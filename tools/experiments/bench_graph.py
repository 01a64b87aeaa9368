"""Time of the pose graph by its size. Prints JSON: CPU time of one thread, in ms.

    python tools/experiments/bench_graph.py [--poses 100 300 1000 2000 5000] [--density 1.0] [--steps 200] \\
        [--gtsam]

The graphs are simulated: agents walk in a room of 9 x 6 m with a keyframe every 0.25 m, every second of which
has one to three loops (`--density` is the share of those that have any). `warm` is the steady state: three
new keyframes and one new loop on a solved graph.
"""

from __future__ import annotations

import argparse
import json
import pickle
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
import pytest  # noqa: E402

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

from helpers.exact_solver import make_exact  # noqa: E402
from helpers.gtsam_graph import solve  # noqa: E402
from helpers.rooms import Room, simulate  # noqa: E402

from share.mapping.graph.covariance import CovariancePaths  # noqa: E402
from share.mapping.graph.solver import (  # noqa: E402
    GraphSolution,
    GraphUpdate,
    PoseGraphSolver,
)
from share.types import F64  # noqa: E402

NEW = 3  # keyframes a step
FIRST_LOOP = 10**6  # odometry edges have the ids of the keyframes that they lead to


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--poses", type=int, nargs="*", default=[100, 300, 1000, 2000, 5000])
    parser.add_argument("--density", type=float, default=1.0)
    parser.add_argument("--steps", type=int, default=200, help="steps of the warm graph")
    parser.add_argument("--gtsam", action="store_true", help="also solve it once by gtsam")
    options = parser.parse_args()
    rest = options.density, options.steps, options.gtsam
    bench(100, 1.0, 3, False)  # warm-up, for imports
    print(json.dumps({f"{n}_poses": bench(n, *rest) for n in options.poses}, indent=2))


def bench(n: int, density: float, steps: int, by_gtsam: bool) -> dict[str, Any]:
    agents = min(24, max(3, n // 330))
    room = simulate(n, agents, 0, density)
    report = {"agents": agents, "loops": len(room.closures)} | cold(room, agents) | roads(room)
    report |= warm(n, agents, density, steps)
    return report | (gtsam(room, agents) if by_gtsam else {})


def cpu_ms(work: Callable[[], Any]) -> tuple[float, Any]:
    start = time.process_time()
    done = work()
    return 1e3 * (time.process_time() - start), done


def cold(room: Room, agents: int) -> dict[str, float]:
    """Time a solution from dead reckoning, and sending the graph to another process."""
    n = len(room)
    news = change(room, range(n), dict(enumerate(room.guess)), room.closures)
    times, pickling = [], []
    for _ in range(5):
        solver = PoseGraphSolver()
        times.append(cpu_ms(lambda s=solver: (s.update(news), s.solve(0, range(n - agents, n))))[0])
        pickling.append(cpu_ms(lambda: pickle.loads(pickle.dumps(news, protocol=5)))[0])
    return {"cold": round(np.median(times), 1), "pickle": round(np.median(pickling), 2)}


def warm(n: int, agents: int, density: float, wanted: int) -> dict[str, float]:
    """Time steps that add the last tenth of each of several graphs."""
    steps = min(wanted, max(1, n // (10 * NEW)))
    runs = [one_warm(n, agents, density, seed, steps) for seed in range(1, 1 + -(-wanted // steps))]
    times, off = (np.concatenate([run[k] for run in runs]) for k in (0, 1))
    return {
        "warm_p50": round(float(np.median(times)), 1),
        "warm_p99": round(float(np.percentile(times, 99)), 1),
        "off_mm_p50": round(float(np.median(off)), 3),
        "off_mm_max": round(float(off.max()), 3),
    }


def one_warm(n: int, agents: int, density: float, seed: int, steps: int) -> tuple[F64, F64]:
    """Return times [ms], and the distance of every pose from the minimum [mm] at the end."""
    room = simulate(n, agents, seed, density)
    first = n - steps * NEW
    solver = PoseGraphSolver()
    loops = [edge for edges in room.loops[:first] for edge in edges]
    solver.update(change(room, range(first), dict(enumerate(room.guess[:first])), loops))
    solution, known, times = solver.solve(0), loops, []
    for k in range(first, n, NEW):
        poses = laid_on(room, solution, range(k, k + NEW))
        loop = [edge for edges in room.loops[k : k + NEW] for edge in edges][:1]
        news = change(room, range(k, k + NEW), poses, loop, FIRST_LOOP + len(known))
        known = known + loop
        wanted = range(k + NEW - agents, k + NEW)
        spent, solution = cpu_ms(lambda c=news, w=wanted: (solver.update(c), solver.solve(0, w))[1])
        times.append(spent)
    exact = PoseGraphSolver()
    exact.update(change(room, range(n), dict(enumerate(solution.poses)), known))
    with pytest.MonkeyPatch.context() as patch:
        make_exact(patch)
        off = np.linalg.norm((exact.solve(0).poses - solution.poses)[:, :3, 3], axis=1)
    return np.array(times), 1e3 * off


def laid_on(room: Room, solution: GraphSolution, new: range) -> dict[int, F64]:
    """Return poses of new keyframes by their odometry, as the mapper initialises them."""
    poses = dict(zip(solution.pose_ids.tolist(), solution.poses, strict=True))
    for i in new:
        edge = room.odometry[i]
        assert edge is not None
        poses[i] = poses[edge.a] @ edge.T_a_b
    return {i: poses[i] for i in new}


def change(
    room: Room, numbers: range, poses: dict[int, F64], loops: list[Any], first_loop: int = FIRST_LOOP
) -> GraphUpdate:
    odometry = [(i, edge, False) for i in numbers if (edge := room.odometry[i]) is not None]
    return GraphUpdate.from_edges(
        poses, odometry + [(first_loop + k, edge, True) for k, edge in enumerate(loops)]
    )


def roads(room: Room) -> dict[str, float]:
    """Time the covariance paths to eight poses from one: after an edge was added, and without a change."""
    net, n, rng = CovariancePaths(), len(room), np.random.default_rng(0)
    edges = room.chain + room.closures
    adding = cpu_ms(lambda: [net.add(edge) for edge in edges])[0] / len(edges)
    fresh, kept = [], []
    for k in range(40):
        net.remove(edges[-1 - k])
        net.add(edges[-1 - k])
        for times in (fresh, kept):
            goals = rng.choice(n, 8).tolist()
            times.append(cpu_ms(lambda g=goals: net.covariances_from(n - 1, g, room.guess))[0])
    return {
        "edge_added_us": round(1e3 * adding, 1),
        "known_from_after_news": round(float(np.median(fresh)), 2),
        "known_from": round(float(np.median(kept)), 2),
    }


def gtsam(room: Room, agents: int) -> dict[str, float]:
    n = len(room)
    last = list(range(n - agents, n))
    args = (room.guess, room.chain, room.closures, [0])
    return {
        "gtsam_cold": round(cpu_ms(lambda: solve(*args))[0], 1),
        "gtsam_cold_with_covariances": round(cpu_ms(lambda: solve(*args, covariances_of=last))[0], 1),
    }


if __name__ == "__main__":
    main()
