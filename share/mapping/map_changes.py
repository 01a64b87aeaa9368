"""Changes of the map that the map file keeps, and the map read back from it.

A list of changes is stored as a whole or not at all (`share.store.map_store`). `StoredMap` is the sum of the
changes, from which the atlas is rebuilt: keyframes with the odometry edges that lead to them, loops, the
newest solution.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from share.checks import checked_array, checked_cov, checked_map_id, checked_pose
from share.geometry import se3
from share.mapping.loops import KeyframeKey, Loop
from share.types import F64, Keyframe
from share.vision.packed_view import PackedView
from share.wire.messages import Hello
from share.wire.room_messages import RoomObject

MAX_FORGOTTEN_RUNS = 65_536  # removed runs that are still recognised; beyond, the oldest are not


@dataclass(frozen=True, eq=False)
class SaveRun:
    """A run of an agent; comes before its keyframes. run_key: names it in all changes. One that was removed
    goes on with the ids after those that it had.

    credential: the public key that authenticated it; "": no key; None: unknown.
    """

    run_key: str
    hello: Hello
    credential: str | None = ""


@dataclass(frozen=True)
class SaveCredential:
    """Replaces the credential of a stored run: a public key; "": no key."""

    run_key: str
    credential: str


@dataclass(frozen=True, eq=False)
class SaveKeyframe:
    """A keyframe of a run. Ids of a run ascend; one that is not above all earlier ones is already stored or
    removed, and is ignored.
    """

    run_key: str
    keyframe: Keyframe

    @property
    def keyframe_key(self) -> KeyframeKey:
        return KeyframeKey(self.run_key, self.keyframe.id)


@dataclass(frozen=True, eq=False)
class StoredKeyframe(SaveKeyframe):
    """A keyframe read back. segment_name: `run_key/n`, the n-th of its run.

    A keyframe without a reference begins a segment. ordinal: number of keyframes before it there, including
    removed ones unless they were the newest. arrived_s: when it was stored, unix s; None if unknown.
    """

    segment_name: str
    ordinal: int
    arrived_s: int | None = None


@dataclass(frozen=True, eq=False)
class SaveLink:
    """Replaces the odometry edge that leads to a keyframe, after earlier keyframes were removed.

    reference: id of a keyframe of the same run, or -1: the keyframe is now the first of its segment and
    T_ref_body (4, 4) is its T_odom_body. cov (6, 6): of T_ref_body, as the pose graph uses it, not as the
    agent sent it.
    """

    key: KeyframeKey
    reference: int
    T_ref_body: F64
    cov: F64

    def __post_init__(self) -> None:
        if not -1 <= self.reference < self.key.id:
            raise ValueError(f"reference: {self.reference} must be in -1 .. {self.key.id - 1}")
        object.__setattr__(self, "T_ref_body", checked_pose("T_ref_body", self.T_ref_body))
        object.__setattr__(self, "cov", checked_cov("cov", self.cov))


@dataclass(frozen=True, eq=False)
class SaveView:
    """The ORB features of a keyframe's image, so that a restarted edge need not find them again."""

    key: KeyframeKey
    view: PackedView


@dataclass(frozen=True, eq=False)
class SaveLoop:
    """An accepted loop. Several may connect the same two keyframes."""

    loop: Loop


@dataclass(frozen=True)
class RemoveLoops:
    """Removes all loops between these two keyframes, in either direction."""

    a: KeyframeKey
    b: KeyframeKey


@dataclass(frozen=True)
class RemoveKeyframes:
    """Removes keyframes with their links and loops. Their ids are never requested again."""

    keys: tuple[KeyframeKey, ...]


@dataclass(frozen=True)
class RemoveRun:
    """Removes a run without keyframes, with its name. Its `public_tag` stays, and the id after all that it
    ever had: they are never requested again. No change of it follows before its next SaveRun."""

    run_key: str


@dataclass(frozen=True)
class Wipe:
    """What was removed must not be readable in the file's log either."""


@dataclass(frozen=True, eq=False)
class SavePoses:
    """The newest solution, which replaces the one before.

    T_map_body (N, 4, 4) of `keys`, each in the map that `map_ids` names.
    """

    keys: tuple[KeyframeKey, ...]
    T_map_body: F64
    map_ids: tuple[str, ...]

    def __post_init__(self) -> None:
        n = len(self.keys)
        if len(self.map_ids) != n:
            raise ValueError(f"map_ids: {len(self.map_ids)} names for {n} keyframes")
        for map_id in set(self.map_ids):
            checked_map_id(map_id)
        object.__setattr__(
            self, "T_map_body", checked_array("T_map_body", self.T_map_body, (n, 4, 4), np.float64)
        )

    def __reduce__(self) -> tuple[Callable[..., SavePoses], tuple[Any, ...]]:
        """To another process as columns: pickled one by one, 20,000 keys take 30 ms."""
        agents, ids = [key.agent for key in self.keys], [key.id for key in self.keys]
        return _poses_of_columns, (agents, ids, self.T_map_body, self.map_ids)


def _poses_of_columns(agents: list[str], ids: list[int], T: F64, map_ids: tuple[str, ...]) -> SavePoses:
    return SavePoses(tuple(map(KeyframeKey, agents, ids)), T, map_ids)


@dataclass(frozen=True, eq=False)
class SaveObject:
    """An object of the room as it is now. home_map: in which map it was placed."""

    object: RoomObject
    home_map: str


@dataclass(frozen=True)
class RemoveStoredObject:
    """Removes an object of the room."""

    object_id: int


MapChange = (
    SaveRun
    | SaveCredential
    | SaveKeyframe
    | SaveLink
    | SaveView
    | SaveLoop
    | RemoveLoops
    | RemoveKeyframes
    | RemoveRun
    | Wipe
    | SavePoses
    | SaveObject
    | RemoveStoredObject
)


@dataclass(frozen=True, eq=False)
class StoredMap:
    """The map read back from a file.

    runs, segments (names), keyframes: in order of arrival; segments may be empty. links: for keyframes whose
    odometry edge was replaced. loops: oldest first. next_ids: for each run, an id above all it ever had here.
    problems: what is missing, a line each. objects: of the room. forgotten: for each removed run, by its
    `public_tag`, an id above all it ever had, oldest first.
    """

    runs: tuple[SaveRun, ...] = ()
    segments: tuple[str, ...] = ()
    keyframes: tuple[StoredKeyframe, ...] = ()
    links: Mapping[KeyframeKey, SaveLink] = field(default_factory=dict)
    loops: tuple[Loop, ...] = ()
    poses: SavePoses | None = None
    next_ids: Mapping[str, int] = field(default_factory=dict)
    problems: tuple[str, ...] = ()
    objects: tuple[SaveObject, ...] = ()
    forgotten: Mapping[str, int] = field(default_factory=dict)


def with_unknown_credentials(stored: StoredMap) -> StoredMap:
    """Mark runs without a credential as unknown, for an edge that uses keys."""
    return replace(stored, runs=tuple(replace(run, credential=run.credential or None) for run in stored.runs))


def odometry_link(keyframe: SaveKeyframe, links: Mapping[KeyframeKey, SaveLink]) -> SaveLink:
    """Return the odometry edge that leads to a keyframe: its link, or else the one it was sent with."""
    sent = keyframe.keyframe
    return links.get(keyframe.keyframe_key) or SaveLink(
        keyframe.keyframe_key, sent.reference, sent.T_ref_body, sent.cov
    )


def map_poses(stored: StoredMap) -> dict[KeyframeKey, tuple[str, F64]]:
    """Map name and T_map_body (4, 4) of every keyframe.

    A keyframe newer than the solution follows its reference. A segment without a solution is a map of its
    own, posed by odometry.
    """
    solved = {} if stored.poses is None else _poses_by_key(stored.poses)
    out: dict[KeyframeKey, tuple[str, F64]] = {}
    for keyframe in stored.keyframes:
        if keyframe.keyframe_key in solved:
            out[keyframe.keyframe_key] = solved[keyframe.keyframe_key]
            continue
        edge = odometry_link(keyframe, stored.links)
        reference = KeyframeKey(keyframe.run_key, edge.reference)
        previous = out.get(reference) or solved.get(reference)
        if previous is None:
            out[keyframe.keyframe_key] = keyframe.segment_name, keyframe.keyframe.T_odom_body
        else:
            out[keyframe.keyframe_key] = previous[0], se3.orthonormal(previous[1] @ edge.T_ref_body)
    return out


def _poses_by_key(poses: SavePoses) -> dict[KeyframeKey, tuple[str, F64]]:
    return dict(zip(poses.keys, zip(poses.map_ids, poses.T_map_body, strict=True), strict=True))
