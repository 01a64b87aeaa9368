"""Random views of people and robots in a room."""

from __future__ import annotations

import numpy as np

from share.lab.emulate.world.occupancy import Occupancy
from share.types import F64

_MIN_CLEARANCE_M = 0.35  # from the nearest object
_FLOOR_MARGIN_M = 0.1  # above the floor
_PERSON, _ROBOT = (1.5, 1.75), 0.35  # heights of their cameras


def standing_views(occupancy: Occupancy, seed: int, count: int) -> F64:
    """Return T_world_cam (count, 4, 4): three of four are people's, one is a robot's. Raises ValueError where
    there is no free place."""
    rng = np.random.default_rng((seed, 4))
    out = np.tile(np.eye(4), (count, 1, 1))
    places = {robot: _standing_places(occupancy, 0.5 if robot else 1.9) for robot in (False, True)}
    for k in range(count):
        robot = k % 4 == 3
        x, y = places[robot][rng.integers(len(places[robot]))]
        z, pitch = (_ROBOT, 0.15) if robot else (rng.uniform(*_PERSON), rng.uniform(-0.35, 0.15))
        out[k] = level_camera_pose((x, y, z), rng.uniform(0, 2 * np.pi), pitch)
    return out


def level_camera_pose(position: tuple[float, float, float], yaw: float, pitch: float) -> F64:
    """Return T_world_cam (4, 4) of a level camera: yaw from the x axis, pitch upwards, rad."""
    ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0])
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    T[:3, 3] = position
    return T


def _standing_places(occupancy: Occupancy, tall: float) -> F64:
    grid, origin, step = occupancy.floor_clearance(_FLOOR_MARGIN_M, tall)
    cells = np.argwhere(grid > _MIN_CLEARANCE_M)
    if not len(cells):
        raise ValueError(f"room: no free place for a body {tall} m tall")
    return np.asarray(cells * step + origin)
