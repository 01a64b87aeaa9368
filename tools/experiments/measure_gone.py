"""What leaves a saved map on another day, counted by the true rooms of both days.

    python tools/experiments/measure_gone.py 5101-0 5101-1 [FIRST SECOND …] [--json FILE]

FIRST and SECOND: days of one emulated room, played as `measure_next_day.py` does. Prints a Markdown
table with two lines a pair: keyframes of the first day that stayed in the map, and those that left.

Protocol: rays through a grid of pixels of each keyframe of the first day, from its true pose, meet the room
of that day. What they meet is *gone* if the same rays go 5 cm further on the second day, *hidden* if they
end 5 cm before, else *there*. *Of it shown today*: the share of what is there that a keyframe of the second
day has in its picture, unhidden. *In place*: keyframes in whose place one of the second day stands: only
they may leave.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from tool_main import exit_code  # noqa: E402
from two_days import play_days, run_pairs  # noqa: E402

from share.errors import UsageError  # noqa: E402
from share.geometry import se3  # noqa: E402
from share.geometry.camera import Camera  # noqa: E402
from share.geometry.interpolation import interpolate  # noqa: E402
from share.lab.emulate.recipe import SessionRecipe  # noqa: E402
from share.lab.emulate.stage import make_layout  # noqa: E402
from share.lab.emulate.world.layout import Layout  # noqa: E402
from share.lab.emulate.world.ray_casting import RayCaster  # noqa: E402
from share.mapping.loop_consistency import PLACE_M, PLACE_RAD  # noqa: E402
from share.mapping.loops import KeyframeKey  # noqa: E402
from share.mapping.map_changes import StoredMap  # noqa: E402
from share.recordings.session import Session, read_session  # noqa: E402
from share.recordings.trajectory import read_tum  # noqa: E402
from share.types import F64  # noqa: E402

_GRID = 40, 30  # rays of a picture
_MOVED_M = 0.05


@dataclass(frozen=True)
class Leavers:
    """Keyframes of the first day that stayed or left, and what they show. Shares of all rays."""

    sessions: str
    keyframes: str
    count: int
    in_place: int
    gone: float
    hidden: float
    there: float
    shown: float


@dataclass(frozen=True, eq=False)
class TrueView:
    """A keyframe with its true poses (4, 4)."""

    key: KeyframeKey
    T_world_body: F64
    T_world_cam: F64
    camera: Camera

    def rays(self) -> tuple[F64, F64]:
        """Return origins and unit directions (N, 3) of a grid of pixels."""
        u, v = np.meshgrid(*((np.arange(n) + 0.5) / n for n in _GRID))
        px = np.column_stack([u.ravel() * self.camera.width, v.ravel() * self.camera.height])
        away = self.camera.directions(px) @ self.T_world_cam[:3, :3].T
        return np.broadcast_to(self.T_world_cam[:3, 3], away.shape), away

    def has_in_picture(self, points: F64) -> NDArray[np.bool_]:
        """Return whether points (N, 3) are within the picture, hidden or not."""
        seen = se3.transform(se3.inverse(self.T_world_cam), points)
        inside = seen[:, 2] > 0.05
        inside[inside] = self.camera.is_inside(self.camera.project(seen[inside]))
        return np.asarray(inside)


class TrueRoom:
    """The surfaces of a room."""

    def __init__(self, layout: Layout) -> None:
        meshes = [piece.shape.mesh for piece in layout.pieces]
        self._caster = RayCaster(np.concatenate([m.vertices[m.faces].astype(np.float32) for m in meshes]))

    def distances(self, start: F64, direction: F64) -> F64:
        """Return how far rays (N, 3) go, m; infinite where they meet nothing."""
        origin = np.ascontiguousarray(start, np.float32)
        triangle, weights = self._caster.first_hits(origin, np.ascontiguousarray(direction, np.float32))
        corners = self._caster.triangles[np.maximum(triangle, 0)]
        reach = np.linalg.norm(np.einsum("nk,nkj->nj", weights, corners) - origin, axis=1)
        return np.where(triangle < 0, np.inf, reach).astype(np.float64)


def true_room(session: Session) -> TrueRoom:
    made = session.provenance
    if "scene" not in made:
        raise UsageError(f"{session.folder}: not an emulated session, so its room is not known")
    size = None if made.get("size") is None else tuple(made["size"])
    recipe = SessionRecipe(made["scene"], (), seed=made["seed"], size=size, day=made.get("day", 0))
    return TrueRoom(make_layout(recipe))


def true_views(session: Session, kept: StoredMap, known: Sequence[KeyframeKey] = ()) -> list[TrueView]:
    """Return the keyframes of the file that are not `known`, those with a truth."""
    hellos = {run.run_key: run.hello for run in kept.runs}
    truths = {name: read_tum(session.folder / "truth" / f"{name}.tum") for name in session.agents}
    before, out = set(known), []
    for one in kept.keyframes:
        if one.keyframe_key in before:
            continue
        hello = hellos[one.run_key]
        is_known, T = interpolate(*truths[hello.name], np.array([one.keyframe.stamp_ns], np.int64))
        if is_known[0]:
            T_world_cam = T[0] @ hello.rig.T_body_cam0
            out.append(TrueView(one.keyframe_key, T[0], T_world_cam, hello.rig.cam0))
    return out


def measure(first: Path, second: Path) -> list[Leavers]:
    """Play both days; return what stayed and what left."""
    days = read_session(first), read_session(second)
    *kept, _ = play_days(*days)
    old = true_views(days[0], kept[0])
    new = true_views(days[1], kept[1], [one.keyframe_key for one in kept[0].keyframes])
    left = {one.keyframe_key for one in kept[0].keyframes} - {one.keyframe_key for one in kept[1].keyframes}
    rooms = true_room(days[0]), true_room(days[1])
    pair = f"{first.name} {second.name}"
    groups = {
        "stayed": [v for v in old if v.key not in left],
        "left": [v for v in old if v.key in left],
    }
    return [_leavers(pair, name, group, new, rooms) for name, group in groups.items()]


def _leavers(
    pair: str, name: str, old: Sequence[TrueView], new: Sequence[TrueView], rooms: tuple[TrueRoom, TrueRoom]
) -> Leavers:
    if not old:
        return Leavers(pair, name, 0, 0, *(float("nan"),) * 4)
    counts = np.zeros(5)  # rays, gone, hidden, there, shown
    for view in old:
        start, away = view.rays()
        reach, later = (room.distances(start, away) for room in rooms)
        meets = np.isfinite(reach)
        gone, hidden = meets & (later > reach + _MOVED_M), meets & (later < reach - _MOVED_M)
        there = meets & ~gone & ~hidden
        shown = _is_shown(start[there] + reach[there, None] * away[there], new, rooms[1])
        counts += meets.sum(), gone.sum(), hidden.sum(), there.sum(), shown.sum()
    rays, gone_count, hidden_count, there_count, shown_count = counts
    shares = gone_count / rays, hidden_count / rays, there_count / rays, shown_count / max(there_count, 1)
    return Leavers(pair, name, len(old), _count_in_place(old, new), *map(float, shares))


def _is_shown(points: F64, views: Sequence[TrueView], room: TrueRoom) -> NDArray[np.bool_]:
    """Return which points (N, 3) a view has in its picture, unhidden."""
    out = np.zeros(len(points), bool)
    for view in views:
        rest = np.flatnonzero(~out)
        rest = rest[view.has_in_picture(points[rest])]
        way = points[rest] - view.T_world_cam[:3, 3]
        length = np.linalg.norm(way, axis=1)
        start = np.broadcast_to(view.T_world_cam[:3, 3], way.shape)
        out[rest] = room.distances(start, way / length[:, None]) > length - _MOVED_M
    return out


def _count_in_place(old: Sequence[TrueView], new: Sequence[TrueView]) -> int:
    if not new:
        return 0
    shift, angle = se3.pairwise_distances(
        np.array([v.T_world_body for v in old]), np.array([v.T_world_body for v in new])
    )
    return int((shift / PLACE_M + angle / PLACE_RAD < 1).any(axis=1).sum())


_TITLES = "sessions", "keyframes", "count", "in place", "gone", "hidden", "there", "of it shown today"


if __name__ == "__main__":
    sys.exit(exit_code("measure_gone", lambda: run_pairs(__doc__ or "", _TITLES, measure)))
