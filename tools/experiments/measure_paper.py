"""Whether the paper's experiments can always be planned. Prints JSON, one run a line, a summary last.

    python tools/experiments/measure_paper.py [--scene S] [--numbers 1-5] [--seeds 0-19] [--kept FILE]

In rooms of 9 x 6 x 4 m; nothing is drawn. Length errors (%), least distances (m) at any time: from things at
body height, of head or camera from anything, between agents; CPU time of planning. With --kept, runs are
added to FILE and those in it are not repeated, so it may be interrupted.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402

from share.errors import ShareError  # noqa: E402
from share.lab.emulate.motion.crowd import fixed_path, min_distance, path_length  # noqa: E402
from share.lab.emulate.motion.motion_plan import (  # noqa: E402
    PAPER_LENGTHS_M,
    PAPER_NAMES,
    PAPER_S,
    PlannedAgent,
    plan_motions,
)
from share.lab.emulate.motion.route import Floor  # noqa: E402
from share.lab.emulate.world.layout import Layout  # noqa: E402
from share.lab.emulate.world.occupancy import Occupancy  # noqa: E402
from share.lab.emulate.world.scenes import make_scene_layout  # noqa: E402

Row = dict[str, Any]
SIZE = (9.0, 6.0, 4.0)
BODY_M = (0.10, 1.95)  # heights above the floor where things are obstacles


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--scene", default="warehouse")
    parser.add_argument("--numbers", type=_span, default=range(1, 6), metavar="A-B")
    parser.add_argument("--seeds", type=_span, default=range(20), metavar="A-B")
    parser.add_argument("--kept", type=Path, metavar="FILE")
    options = parser.parse_args()
    jobs = list(product((options.scene,), options.numbers, options.seeds))
    print(json.dumps(summary_of_plans(list(measured(jobs, options.kept)))))


def _span(text: str) -> range:
    first, _, last = text.partition("-")
    return range(int(first), int(last or first) + 1)


def measured(jobs: list[tuple[str, int, int]], kept: Path | None) -> Iterator[Row]:
    """Yield a row a job (scene, number, seed), from the file if it is there."""
    lines = kept.read_text().splitlines() if kept and kept.exists() else []
    known = {tuple(row["job"]): row for row in map(json.loads, lines)}
    for job in jobs:
        if job not in known:
            known[job] = {"job": job} | of_plan(*job)
            print(json.dumps(known[job]), flush=True)
            if kept:
                with kept.open("a") as file:
                    file.write(json.dumps(known[job]) + "\n")
        yield known[job]


def of_plan(scene: str, number: int, seed: int) -> Row:
    """Plan one experiment in one room."""
    room = make_scene_layout(scene, seed, SIZE)
    began = time.process_time()
    try:
        agents = plan_motions([f"paper:{number}"], room, PAPER_S, seed).agents
    except ShareError as error:
        return {"failed": str(error)}
    cpu_s = time.process_time() - began
    wanted = PAPER_LENGTHS_M[number]
    off = [100 * (path_length(a.path) / length - 1) for a, length in zip(agents, wanted, strict=True)]
    return {"length_off": [_round(x) for x in off], "cpu_s": _round(cpu_s)} | distances(room, agents)


def distances(room: Layout, agents: Sequence[PlannedAgent]) -> Row:
    """Return least distances, m: of each agent from things at body height, of each head from anything,
    between agents."""
    xyz1, xyz2, xyz3 = xyz = [fixed_path(a.path, 0.0).xyz for a in agents]
    free = Occupancy.from_layout(room)
    floor = fine_floor(free)
    return {
        "floor_m": [_round(floor.clearance_at(p[:, :2]).min()) for p in xyz],
        "head_m": [_round(free.clearance(p).min()) for p in xyz],
        "people_m": _round(min_distance(xyz1, xyz2)),
        "robot_m": _round(min(min_distance(xyz1, xyz3), min_distance(xyz2, xyz3))),
    }


def fine_floor(free: Occupancy) -> Floor:
    """Return distances from obstacles at the occupancy's resolution."""
    clearance, origin, step = free.floor_clearance(*BODY_M)
    return Floor(clearance.astype(np.float64), step, float(origin[0]))


def summary_of_plans(rows: list[Row]) -> Row:
    """Return the worst of each figure, by agent where it has one."""
    done = [row for row in rows if "failed" not in row]
    cpu_s = [row["cpu_s"] for row in done]

    def least(key: str) -> dict[str, float]:
        return dict(zip(PAPER_NAMES, np.min([row[key] for row in done], axis=0).tolist(), strict=True))

    return {
        "runs": len(rows),
        "failures": len(rows) - len(done),
        "length_off_most_percent": _round(np.abs([row["length_off"] for row in done]).max()),
        "floor_least_m": least("floor_m"),
        "head_least_m": least("head_m"),
        "people_least_m": min(row["people_m"] for row in done),
        "robot_least_m": min(row["robot_m"] for row in done),
        "cpu_s_median": _round(np.median(cpu_s)),
        "cpu_s_most": max(cpu_s),
    }


def _round(value: Any) -> float:
    return round(float(value), 3)


if __name__ == "__main__":
    main()
