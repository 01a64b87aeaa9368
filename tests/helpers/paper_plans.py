"""Plans of the paper's experiments in rooms of 9 x 6 x 4 m: errors of lengths, least distances."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from share.errors import ShareError
from share.lab.emulate.motion.crowd import fixed_path, min_distance, path_length
from share.lab.emulate.motion.motion_plan import PAPER_LENGTHS_M, PAPER_S, PlannedAgent, plan_motions
from share.lab.emulate.motion.route import Floor
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.occupancy import Occupancy
from share.lab.emulate.world.scenes import make_scene_layout

Row = dict[str, Any]
SIZE = (9.0, 6.0, 4.0)
BODY_M = (0.10, 1.95)  # heights above the floor where things are obstacles


def of_plan(scene: str, number: int, seed: int) -> Row:
    """Plan one experiment in one room."""
    room = make_scene_layout(scene, seed, SIZE)
    try:
        agents = plan_motions([f"paper:{number}"], room, PAPER_S, seed).agents
    except ShareError as error:
        return {"failed": str(error)}
    wanted = PAPER_LENGTHS_M[number]
    off = [100 * (path_length(a.path) / length - 1) for a, length in zip(agents, wanted, strict=True)]
    return {"length_off": off} | distances(room, agents)


def distances(room: Layout, agents: Sequence[PlannedAgent]) -> Row:
    """Return least distances, m: of each agent from things at body height, of each head from anything,
    between agents."""
    xyz1, xyz2, xyz3 = xyz = [fixed_path(a.path, 0.0).xyz for a in agents]
    free = Occupancy.from_layout(room)
    floor = fine_floor(free)
    return {
        "floor_m": [floor.clearance_at(p[:, :2]).min() for p in xyz],
        "head_m": [free.clearance(p).min() for p in xyz],
        "people_m": min_distance(xyz1, xyz2),
        "robot_m": min(min_distance(xyz1, xyz3), min_distance(xyz2, xyz3)),
    }


def fine_floor(free: Occupancy) -> Floor:
    """Return distances from obstacles at the occupancy's resolution."""
    clearance, origin, step = free.floor_clearance(*BODY_M)
    return Floor(clearance.astype(np.float64), step, float(origin[0]))
