"""One run of an agent in the live room: its keyframes, path and pose.

Things that are drawn together are *chunks*: of the run's keyframes, and of its path. A change names the
chunks that have to be drawn again.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from dataclasses import dataclass, field

import numpy as np

from share.geometry.se3 import inverse, rotation_angle
from share.types import F32, F64, TrackState
from share.view.events import KeyframeArrived, PoseArrived, RunArrived

KEYFRAMES_PER_CHUNK, PATH_POINTS_PER_CHUNK = 32, 128
_PATH_STEP_M = 0.03
_MAX_PATH_CHUNKS = 400  # of a run: 50,000 points; the oldest are forgotten
_MOVED_M, _MOVED_RAD = 4e-3, 4e-3  # smaller changes of a pose are not redrawn


@dataclass(eq=False, slots=True)
class PlacedKeyframe:
    """A keyframe and where it is. T_map_body: in map `map_id`; None until that is known. is_solved: by the
    map, not by odometry and a correction."""

    id: int
    T_odom_body: F64
    points: F32
    chunk: int
    T_map_body: F64 | None = None
    map_id: str = ""
    is_solved: bool = False
    path_chunks: set[int] = field(default_factory=set)
    loop_chunks: set[int] = field(default_factory=set)

    def place(self, map_id: str, T_map_body: F64, is_solved: bool) -> bool:
        """Set the pose. Return True if the change is large enough to be drawn."""
        self.is_solved = is_solved
        if (
            self.T_map_body is not None
            and map_id == self.map_id
            and not _has_moved(self.T_map_body, T_map_body)
        ):
            return False
        self.map_id, self.T_map_body = map_id, T_map_body
        return True


def _has_moved(T_old: F64, T_new: F64) -> bool:
    if np.abs(T_new[:3, 3] - T_old[:3, 3]).max() > _MOVED_M:
        return True
    return bool(rotation_angle(inverse(T_old) @ T_new) > _MOVED_RAD)


@dataclass(frozen=True, slots=True, eq=False)
class _PathPoint:
    """position (3,): in the keyframe `keyframe`."""

    keyframe: int
    position: F64


def _relative(one: PlacedKeyframe, other: PlacedKeyframe) -> F64 | None:
    """Return T_one_other; None if they are not in one map."""
    if one.T_map_body is None or other.T_map_body is None or one.map_id != other.map_id:
        return None
    return inverse(one.T_map_body) @ other.T_map_body


class RunPath:
    """One run. number: names it in drawings."""

    def __init__(self, number: int, shown: RunArrived) -> None:
        self.number, self.shown = number, shown
        self.keyframes: dict[int, PlacedKeyframe] = {}
        self.chunks: dict[int, list[PlacedKeyframe]] = {}
        self.map_id: str | None = None
        self.T_map_odom: F64 | None = None
        self.state = TrackState.INITIALISING
        self.is_current = True  # the edge receives its messages, and it is not LOST
        self._pose: PoseArrived | None = None
        self._count = 0
        self._ids: list[int] = []  # of keyframes, in order
        self._segment_begin = 0  # first keyframe of the present segment
        self._path: dict[int, list[_PathPoint]] = {}
        self._last_position: F64 | None = None  # of the path, in the map

    # Keyframes

    def add_keyframe(self, shown: KeyframeArrived) -> PlacedKeyframe:
        if shown.begins_segment:
            self._segment_begin, self.T_map_odom, self._last_position = shown.key.id, None, None
        one = PlacedKeyframe(
            shown.key.id, shown.T_odom_body, shown.points, self._count // KEYFRAMES_PER_CHUNK
        )
        self._count += 1
        self.keyframes[one.id] = one
        insort(self._ids, one.id)
        self.chunks.setdefault(one.chunk, []).append(one)
        if self.T_map_odom is not None and self.map_id is not None:
            one.place(self.map_id, self.T_map_odom @ one.T_odom_body, False)
        return one

    def correct(self, map_id: str, T_map_odom: F64, segment_keyframe: int) -> list[PlacedKeyframe]:
        """Move odometry in the map. Return the keyframes that move: all of the segment into another map,
        those that the map has not placed within one."""
        if segment_keyframe < self._segment_begin:
            return []
        is_other_map = map_id != self.map_id
        self.map_id, self.T_map_odom = map_id, T_map_odom
        present = (self.keyframes[k] for k in self._ids[bisect_left(self._ids, self._segment_begin) :])
        return [
            one
            for one in present
            if (is_other_map or not one.is_solved) and one.place(map_id, T_map_odom @ one.T_odom_body, False)
        ]

    def remove_keyframe(self, id_: int) -> PlacedKeyframe | None:
        """Remove a keyframe; its part of the path follows the keyframe before it."""
        if (removed := self.keyframes.pop(id_, None)) is None:
            return None
        self.chunks[removed.chunk].remove(removed)
        at = bisect_left(self._ids, id_)
        del self._ids[at]
        new_owner = self.keyframes[self._ids[max(0, at - 1)]] if self._ids else None
        T_owner_removed = None if new_owner is None else _relative(new_owner, removed)
        for chunk in removed.path_chunks & self._path.keys():
            points = self._path[chunk]
            if new_owner is None or T_owner_removed is None:
                self._path[chunk] = [point for point in points if point.keyframe != id_]
                continue
            new_owner.path_chunks.add(chunk)
            R, t = T_owner_removed[:3, :3], T_owner_removed[:3, 3]
            self._path[chunk] = [
                _PathPoint(new_owner.id, R @ point.position + t) if point.keyframe == id_ else point
                for point in points
            ]
        return removed

    def remove_all(self) -> None:
        """Remove all keyframes and the path."""
        self.keyframes.clear()
        self._ids.clear()
        self._path.clear()
        self.chunks = {chunk: [] for chunk in self.chunks}

    # Pose and path

    def add_pose(self, pose: PoseArrived) -> int | None:
        """Add the newest pose. Return the chunk of the path that it extends; None if it does not."""
        self._pose, self.state = pose, pose.state
        place = self.place()
        if place is None or pose.keyframe < 0 or not pose.state.has_pose:
            return None
        position = place[1][:3, 3]
        if self._last_position is not None and np.linalg.norm(position - self._last_position) < _PATH_STEP_M:
            return None
        self._last_position = position
        chunk = next(reversed(self._path), 0)
        if len(self._path.get(chunk, ())) >= PATH_POINTS_PER_CHUNK:
            chunk += 1
            self._path[chunk] = self._path[chunk - 1][-1:]  # joined to the chunk before
            self._note_chunk(self._path[chunk][0].keyframe, chunk)
        self._path.setdefault(chunk, []).append(_PathPoint(pose.keyframe, pose.T_keyframe_body[:3, 3]))
        self._note_chunk(pose.keyframe, chunk)
        return chunk

    def forget_oldest_path(self) -> int | None:
        """Forget the oldest chunk of a path that is too long. Return it."""
        if len(self._path) <= _MAX_PATH_CHUNKS:
            return None
        oldest = next(iter(self._path))
        del self._path[oldest]
        return oldest

    def _note_chunk(self, keyframe: int, chunk: int) -> None:
        if (one := self.keyframes.get(keyframe)) is not None:
            one.path_chunks.add(chunk)

    def place(self) -> tuple[str, F64] | None:
        """Return the map id and T_map_body (4, 4) of the newest pose; None if unknown."""
        if self._pose is None:
            return None
        reference = self._reference(self._pose.keyframe)
        return None if reference is None else (reference[0], reference[1] @ self._pose.T_keyframe_body)

    def path(self, chunk: int) -> list[tuple[str, F64]]:
        """Return the map and position (3,) of each point of a chunk of the path, as far as known."""
        placed = []
        for point in self._path.get(chunk, ()):
            if (reference := self._reference(point.keyframe)) is not None:
                T = reference[1]
                placed.append((reference[0], T[:3, :3] @ point.position + T[:3, 3]))
        return placed

    @property
    def path_chunks(self) -> list[int]:
        return list(self._path)

    def _reference(self, keyframe: int) -> tuple[str, F64] | None:
        """Return the map and pose of a keyframe, or of odom (-1)."""
        if keyframe < 0:
            known = self.map_id is not None and self.T_map_odom is not None
            return (self.map_id, self.T_map_odom) if known else None  # type: ignore[return-value]
        one = self.keyframes.get(keyframe)
        return None if one is None or one.T_map_body is None else (one.map_id, one.T_map_body)
