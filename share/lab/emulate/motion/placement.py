"""Place recorded motions in a room: turn them about the vertical and shift them, as far from things as
possible.

Every yaw of a grid with every shift of a grid is scored by the distances of the room's voxels. Shifts that
touch walls, floor or ceiling are excluded; then the fewest places near furniture (which is removed) count
first, then clearance, then places that others visit as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from share.errors import UsageError
from share.geometry import se3
from share.lab.emulate.types import MotionPath
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.occupancy import Occupancy
from share.types import F32, F64

CLEARANCE_M = 0.25
MIN_DISTANCE_M = 0.5  # between two agents at the same time
_VOXEL_M = 0.1
_YAWS = 24
_SHIFT_M = 0.25
_TIME_S = 0.1
_SHIFT_CHUNK = 256  # shifts at a time
_MAX_POINTS = 400  # of a path, for scoring
_AMPLE_CLEARANCE_M = 0.8  # more clearance than this does not count
_USUAL_HEIGHTS = {"person": 1.65, "robot": 0.35, "drone": 1.5}  # m, mean height of such a body's path
_BODY_HEIGHTS = {
    "person": (0.35, 1.0),
    "robot": (),
    "drone": (),
}  # m above the floor: how far a body reaches below its head
_MAX_CANDIDATES = 400  # candidates that are checked exactly


@dataclass(frozen=True, eq=False)
class PathToPlace:
    """A motion to place. xyz (M, 3) m every _TIME_S from its start."""

    name: str
    body_kind: str
    path: MotionPath

    @property
    def xyz(self) -> F64:
        stamps = np.arange(self.path.start_ns, self.path.end_ns + 1, round(_TIME_S * 1e9))
        return self.path.poses(stamps)[:, :3, 3]


def place_paths(
    layout: Layout, requests: Sequence[PathToPlace], seed: tuple[int, ...]
) -> tuple[Layout, list[MotionPath], list[str]]:
    """Return the room without the pieces in the way, the paths in it, and notes for the user.

    Raises UsageError where a path does not fit into the room, or cannot keep its distance from the others.
    """
    occupancy = Occupancy.from_layout(layout, _VOXEL_M)
    shell_occupancy = Occupancy.from_layout(replace(layout, pieces=()), _VOXEL_M)
    paths: list[MotionPath] = []
    placed_paths: list[F64] = []
    notes = []
    for k, request in enumerate(requests):
        rng = np.random.default_rng((*seed, k))
        T = _find_place(layout, occupancy, shell_occupancy, request, placed_paths, rng)
        paths.append(request.path.transformed(T))
        placed_paths.append(se3.transform(T, request.xyz))
    for request, xyz in zip(requests, placed_paths, strict=True):
        layout, removed = layout.without(_body_points(xyz, request.body_kind), CLEARANCE_M - 0.05)
        if removed:
            notes.append(f"{request.name}: left out {', '.join(removed)}, which stood in its way")
    return layout, paths, notes


def _find_place(
    layout: Layout,
    occupancy: Occupancy,
    shell_occupancy: Occupancy,
    request: PathToPlace,
    placed_paths: Sequence[F64],
    rng: np.random.Generator,
) -> F64:
    xyz = request.xyz
    middle = (xyz.min(0) + xyz.max(0)) / 2
    visited = _distance_from_paths(shell_occupancy, placed_paths)
    candidates: list[tuple[float, F64]] = []
    for yaw in (np.arange(_YAWS) + rng.random()) * 2 * np.pi / _YAWS:
        turned = _yaw_transform(yaw, middle)
        p = se3.transform(turned, xyz)
        shifts = _candidate_shifts(p, np.array(layout.size), request.body_kind)
        if len(shifts):
            scores = _shift_scores(p, shifts, occupancy, shell_occupancy, request.body_kind, visited)
            scores = scores + 0.02 * rng.random(len(scores))
            for i in np.argsort(-scores)[: _MAX_CANDIDATES // _YAWS * 2]:
                if np.isfinite(scores[i]):
                    T = turned.copy()
                    T[:3, 3] += shifts[i]
                    candidates.append((float(scores[i]), T))
    if not candidates:
        raise UsageError(_too_large_text(layout, request, xyz))
    for _, T in sorted(candidates, key=lambda pair: -pair[0]):
        if all(_min_distance(se3.transform(T, xyz), other) >= MIN_DISTANCE_M for other in placed_paths):
            return T
    raise UsageError(
        f"{request.name}: wherever it is put in this room it "
        f"comes nearer than {MIN_DISTANCE_M:g} "
        f"m to another agent; "
        "ask for a larger --size, or other start= times"
    )


def _yaw_transform(yaw: float, middle: F64) -> F64:
    """Return the rotation about the vertical through `middle`, with `middle` moved to 0."""
    R = se3.so3_exp(np.array([0.0, 0.0, yaw]))
    return se3.from_rt(R, -R @ middle)


def _candidate_shifts(p: F64, size: F64, body_kind: str) -> F64:
    """Return shifts (S, 3) m of the middle of a path p (M, 3) around 0, limited by its extent alone."""
    low, high = CLEARANCE_M - p.min(0), size - CLEARANCE_M - p.max(0)
    if (low > high).any():
        return np.zeros((0, 3))
    axes = [
        np.linspace(a, b, max(1, round((b - a) / _SHIFT_M)) + 1)
        for a, b in zip(low[:2], high[:2], strict=True)
    ]
    usual_height = np.clip(_USUAL_HEIGHTS[body_kind] - p[:, 2].mean(), low[2], high[2])
    heights = (
        [usual_height]
        if body_kind != "drone"
        else np.unique(np.clip(usual_height + np.array([-0.4, 0.0, 0.4]), low[2], high[2]))
    )
    return np.array([(x, y, z) for x in axes[0] for y in axes[1] for z in heights])


def _shift_scores(
    p: F64, shifts: F64, whole: Occupancy, shell: Occupancy, body_kind: str, visited: F64
) -> F64:
    """Return the score of each shift (S, 3); -inf where the path would touch the shell."""
    samples = p[:: max(1, len(p) // _MAX_POINTS)]
    out = np.full(len(shifts), -np.inf)
    for first in range(0, len(shifts), _SHIFT_CHUNK):
        at = samples + shifts[first : first + _SHIFT_CHUNK, None]
        fits = _grid_values(shell.distance, at).min(axis=1) >= CLEARANCE_M
        at = at[fits]
        room = _grid_values(whole.distance, _body_points(at, body_kind))
        out[first : first + _SHIFT_CHUNK][fits] = (
            -4 * (room < CLEARANCE_M).mean(axis=1)
            + room.clip(0, _AMPLE_CLEARANCE_M).mean(axis=1)
            - 0.3 * _grid_values(visited, at).mean(axis=1)
        )
    return out


def _body_points(xyz: F64, body_kind: str) -> F64:
    """Return points (..., P, 3) of the whole body, not of the head (..., M, 3) alone, that must be free."""
    lower = [
        np.concatenate([xyz[..., :2], np.full_like(xyz[..., 2:], z)], axis=-1)
        for z in _BODY_HEIGHTS[body_kind]
    ]
    return np.concatenate([xyz, *lower], axis=-2)


def _grid_values(grid: F64 | F32, points: F64) -> F64:
    """Return the grid's values (...) at points (..., 3) m."""
    cells = np.floor(points / _VOXEL_M).astype(int)
    i, j, k = np.moveaxis(np.clip(cells, 0, np.array(grid.shape) - 1), -1, 0)
    out: F64 = grid[i, j, k].astype(np.float64)
    return out


def _distance_from_paths(shell: Occupancy, fixed: Sequence[F64]) -> F64:
    """Return the horizontal distance (X, Y, 1) m of each place from placed paths, 0 everywhere without
    any."""
    from scipy.ndimage import distance_transform_edt

    shape = shell.solid.shape[:2]
    free = np.ones(shape, bool)
    for xyz in fixed:
        i, j = np.floor(xyz[:, :2] / _VOXEL_M).astype(int).T
        free[i.clip(0, shape[0] - 1), j.clip(0, shape[1] - 1)] = False
    if free.all():
        return np.zeros((*shape, 1))
    return np.asarray(distance_transform_edt(free) * _VOXEL_M)[..., None]


def _min_distance(a: F64, b: F64) -> float:
    """Return the least distance (m) of two paths at the same times; one that has ended stands still."""
    count = np.arange(max(len(a), len(b)))
    d = a[np.minimum(count, len(a) - 1)] - b[np.minimum(count, len(b) - 1)]
    return float(np.linalg.norm(d, axis=1).min())


def _too_large_text(layout: Layout, request: PathToPlace, xyz: F64) -> str:
    """Return one line: what the path needs, what the room has, and what to change."""
    extents = [
        np.ptp(se3.transform(_yaw_transform(yaw, 0 * xyz[0]), xyz), axis=0)
        for yaw in np.linspace(0, np.pi, 37)
    ]
    need = min(extents, key=lambda e: e[0] * e[1]) + 2 * CLEARANCE_M
    x, y = sorted(need[:2], reverse=True)
    room_size = " x ".join(f"{s:g}" for s in layout.size)
    wide, deep = sorted(layout.size[:2], reverse=True)
    sizes = zip((x, y, need[2]), (wide, deep, layout.size[2]), strict=True)
    ask = ",".join(f"{max(np.ceil(v * 2 + 1) / 2, s):g}" for v, s in sizes)
    return (
        f"{request.name}: its path needs {x:.1f} x {y:.1f} x {need[2]:.1f} m of free room, "
        f"{layout.name} is {room_size} m; "
        f"ask for a larger --size, such as {ask}, or a shorter part (start=, seconds=)"
    )
