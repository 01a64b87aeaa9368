"""Whether the paper's experiments can always be planned, and which agents see each other. Prints JSON, one
run a line, a summary last.

    python tools/experiments/measure_paper.py [--scene S] [--numbers 1-5] [--seeds 0-19] [--kept FILE]
    python tools/experiments/measure_paper.py --sights [--scene S] [--numbers 1-5] [--seeds 0-2] [--kept FILE]

In rooms of 9 x 6 x 4 m; nothing is drawn. Length errors (%), least distances (m) at any time: from things at
body height, of head or camera from anything, between agents; CPU time of planning. With --sights: share of
user1's pictures that show user2, or the robot. With --kept, runs are added to FILE and those in it are not
repeated, so it may be interrupted.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from measure_emulation import first_hits, scene_of  # noqa: E402

from share.errors import ShareError  # noqa: E402
from share.geometry import se3  # noqa: E402
from share.geometry.camera import Camera, rays  # noqa: E402
from share.lab.emulate.motion.avatars import Avatar, avatar_shapes  # noqa: E402
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
from share.lab.emulate.world.ray_casting import RayCaster  # noqa: E402
from share.lab.emulate.world.scenes import make_scene_layout  # noqa: E402
from share.sensors.profile import load_profile  # noqa: E402
from share.types import F64, I64  # noqa: E402

Row = dict[str, Any]
SIZE = (9.0, 6.0, 4.0)
BODY_M = (0.10, 1.95)  # heights above the floor where things are obstacles
LOOKS_S, GRID_PX, SEEN_PX = 0.5, 4, 100  # s between pictures, px between rays, least visible area in px


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sights", action="store_true")
    parser.add_argument("--scene", default="warehouse")
    parser.add_argument("--numbers", type=_span, default=range(1, 6), metavar="A-B")
    parser.add_argument("--seeds", type=_span, metavar="A-B")
    parser.add_argument("--kept", type=Path, metavar="FILE")
    options = parser.parse_args()
    measure, summary = (of_sight, summary_of_sights) if options.sights else (of_plan, summary_of_plans)
    seeds = options.seeds or range(3 if options.sights else 20)
    jobs = list(product((options.scene,), options.numbers, seeds))
    print(json.dumps(summary(list(measured(measure, jobs, options.kept)))))


def _span(text: str) -> range:
    first, _, last = text.partition("-")
    return range(int(first), int(last or first) + 1)


def measured(
    measure: Callable[[str, int, int], Row], jobs: list[tuple[str, int, int]], kept: Path | None
) -> Iterator[Row]:
    """Yield a row a job (scene, number, seed), from the file if it is there."""
    lines = kept.read_text().splitlines() if kept and kept.exists() else []
    known = {tuple(row["job"]): row for row in map(json.loads, lines)}
    for job in jobs:
        if job not in known:
            known[job] = {"job": job} | measure(*job)
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


def of_sight(scene: str, number: int, seed: int) -> Row:
    """Return the share of user1's pictures with user2, or the robot, in it, and their size there."""
    planned = plan_motions([f"paper:{number}"], make_scene_layout(scene, seed, SIZE), PAPER_S, seed)
    me, *others = planned.agents
    stamps = np.arange(me.path.start_ns, me.path.end_ns + 1, round(LOOKS_S * 1e9))
    poses = me.path.poses(stamps)  # a simulated body has camera axes, and is within centimetres of the camera
    rays = grid(load_profile("d435i").rig().cam0)
    room = scene_of([piece.shape.mesh.triangles for piece in planned.layout.all_pieces])
    walls = [depths(room, T, rays) for T in poses]
    row: Row = {"looks": len(stamps)}
    anyone = np.zeros(len(stamps), bool)
    for other in others:
        seen = zip(poses, bodies(other, stamps), walls, strict=True)
        areas = np.array([area(T, body, rays, wall) for T, body, wall in seen])
        there = areas >= SEEN_PX
        anyone |= there
        row[f"{other.name}_percent"] = _percent(there)
        row[f"{other.name}_px"] = int(np.median(areas[there])) if there.any() else 0
    return row | {"any_percent": _percent(anyone)}


def grid(camera: Camera) -> F64:
    """Return rays (N, 3) through every GRID_PX-th pixel in both directions."""
    x, y = np.meshgrid(*(np.arange(GRID_PX // 2, n, GRID_PX) for n in (camera.width, camera.height)))
    return rays(camera.normalise(np.column_stack([x.ravel(), y.ravel()]).astype(float)))


def bodies(agent: PlannedAgent, stamps: I64) -> Iterator[RayCaster]:
    """Yield the agent's body at each time."""
    parts = [
        shape.mesh.triangles.astype(float) for shape in avatar_shapes(agent.body_kind, agent.path, (0, 9))
    ]
    for T in Avatar(agent.body_kind, agent.path).part_poses(stamps):
        yield scene_of([se3.transform(T_part, part) for T_part, part in zip(T, parts, strict=True)])


def area(T_world_cam: F64, body: RayCaster, rays: F64, wall: F64) -> int:
    """Return the visible area of the body, px."""
    return int((depths(body, T_world_cam, rays) < wall).sum()) * GRID_PX**2


def depths(scene: RayCaster, T_world_cam: F64, rays: F64) -> F64:
    """Return depths (N,) m at which a camera's rays (N, 3) meet something, infinite where nothing."""
    points, hit = first_hits(scene, T_world_cam, rays)
    return np.where(hit, se3.transform(se3.inverse(T_world_cam), points)[:, 2], np.inf)


def summary_of_sights(rows: list[Row]) -> Row:
    """Return mean, minimum and maximum over the runs."""
    keys = [key for key in rows[0] if key.endswith("_percent")]
    columns = {key: [row[key] for row in rows] for key in keys}
    return {key: {"mean": _round(np.mean(v)), "least": min(v), "most": max(v)} for key, v in columns.items()}


def _percent(there: Any) -> float:
    return _round(100 * np.mean(there))


def _round(value: Any) -> float:
    return round(float(value), 3)


if __name__ == "__main__":
    main()
