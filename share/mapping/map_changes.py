"""What the edge wants kept of its map: changes, one after the other, and what is found again.

A list of changes is kept as a whole or not at all (`share.store.map_store`). What is `StoredMap` says again
what the changes said, so that the atlas can be built anew from it: keyframes and the odometry edges
that lead to them, loops, the newest solution.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from share.geometry import se3
from share.mapping.loops import KeyframeKey, Loop
from share.types import F64, Keyframe, checked_array, checked_cov, checked_pose
from share.wire.messages import Hello


@dataclass(frozen=True, eq=False)
class SaveRun:
    """One run of one agent. key: names it everywhere here. Comes before its keyframes. voice: the public key
    that speaks for it; "": none did; None: it may be any."""

    run_key: str
    hello: Hello
    credential: str | None = ""


@dataclass(frozen=True)
class SaveCredential:
    """Who speaks for a run that is kept, from now on: a public key; "": no key."""

    run_key: str
    credential: str


@dataclass(frozen=True, eq=False)
class SaveKeyframe:
    """A keyframe of a run.

    Numbers of a run rise; one that is not above all before was kept already, or retired, and changes nothing.
    """

    run_key: str
    keyframe: Keyframe

    @property
    def keyframe_key(self) -> KeyframeKey:
        return KeyframeKey(self.run_key, self.keyframe.id)


@dataclass(frozen=True, eq=False)
class StoredKeyframe(SaveKeyframe):
    """Found again. stretch: `key/n`, the n-th of its run; a keyframe without a reference begins one.
    ordinal: how many came before it there, retired ones too, if they were not its newest."""

    segment_name: str
    ordinal: int


@dataclass(frozen=True, eq=False)
class SaveLink:
    """The odometry edge that leads to a keyframe from now on: those before it were retired.

    reference: number of a keyframe of the same run, or -1: it is the first of its stretch now, and
    T_ref_body (4, 4) is its T_odom_body. cov (6, 6): of T_ref_body, as the pose graph uses it, not as
    the agent said it.
    """

    key: KeyframeKey
    reference: int
    T_ref_body: F64
    cov: F64

    def __post_init__(self) -> None:
        if not -1 <= self.reference < self.key.id:
            raise ValueError(f"reference: {self.reference} must lie in -1 .. {self.key.id - 1}")
        object.__setattr__(self, "T_ref_body", checked_pose("T_ref_body", self.T_ref_body))
        object.__setattr__(self, "cov", checked_cov("cov", self.cov))


@dataclass(frozen=True, eq=False)
class SaveLoop:
    """An accepted loop. Several may tie the same two keyframes."""

    loop: Loop


@dataclass(frozen=True)
class RemoveLoops:
    """All loops between these two keyframes, whichever way round."""

    a: KeyframeKey
    b: KeyframeKey


@dataclass(frozen=True)
class RemoveKeyframes:
    """Keyframes that go, with their links and loops. Their numbers are never asked for again."""

    keys: tuple[KeyframeKey, ...]


@dataclass(frozen=True)
class RemoveRun:
    """A run of which nothing is left goes, with its name. Nothing of it comes afterwards."""

    run_key: str


@dataclass(frozen=True, eq=False)
class SavePoses:
    """The newest solution; it takes the place of the one before. T_map_body (N, 4, 4) of `keys`, each in
    the map that `map_ids` names."""

    keys: tuple[KeyframeKey, ...]
    T_map_body: F64
    map_ids: tuple[str, ...]

    def __post_init__(self) -> None:
        n = len(self.keys)
        if len(self.map_ids) != n:
            raise ValueError(f"maps: {len(self.map_ids)} names for {n} keyframes")
        object.__setattr__(
            self, "T_map_body", checked_array("T_map_body", self.T_map_body, (n, 4, 4), np.float64)
        )


MapChange = (
    SaveRun
    | SaveCredential
    | SaveKeyframe
    | SaveLink
    | SaveLoop
    | RemoveLoops
    | RemoveKeyframes
    | RemoveRun
    | SavePoses
)


@dataclass(frozen=True, eq=False)
class StoredMap:
    """What is found again.

    runs, stretches (names), keyframes: in the order in which they came, stretches also without
    keyframes by now. links: for keyframes whose odometry edge is no longer the one that they came with.
    loops: oldest first. next_keyframe: of each run, one above all that it ever had here. complaints: what
    is missing, a line each.
    """

    runs: tuple[SaveRun, ...] = ()
    segments: tuple[str, ...] = ()
    keyframes: tuple[StoredKeyframe, ...] = ()
    links: Mapping[KeyframeKey, SaveLink] = field(default_factory=dict)
    loops: tuple[Loop, ...] = ()
    poses: SavePoses | None = None
    next_ids: Mapping[str, int] = field(default_factory=dict)
    problems: tuple[str, ...] = ()


def with_unknown_credentials(kept: StoredMap) -> StoredMap:
    """For an edge that uses keys: a run for which none spoke may be anybody's."""
    return replace(kept, runs=tuple(replace(run, credential=run.credential or None) for run in kept.runs))


def odometry_link(keyframe: SaveKeyframe, links: Mapping[KeyframeKey, SaveLink]) -> SaveLink:
    """The odometry edge that leads to a keyframe: its link, or what it came with."""
    sent = keyframe.keyframe
    return links.get(keyframe.keyframe_key) or SaveLink(
        keyframe.keyframe_key, sent.reference, sent.T_ref_body, sent.cov
    )


def map_poses(kept: StoredMap) -> dict[KeyframeKey, tuple[str, F64]]:
    """Map and T_map_body (4, 4) of every keyframe.

    One that came after the newest solution follows its reference; a stretch that no solution speaks of is
    a map of its own, where its odometry says.
    """
    solved = {} if kept.poses is None else _poses_by_key(kept.poses)
    out: dict[KeyframeKey, tuple[str, F64]] = {}
    for keyframe in kept.keyframes:
        if keyframe.keyframe_key in solved:
            out[keyframe.keyframe_key] = solved[keyframe.keyframe_key]
            continue
        edge = odometry_link(keyframe, kept.links)
        previous = out.get(KeyframeKey(keyframe.run_key, edge.reference))
        if previous is None:
            out[keyframe.keyframe_key] = keyframe.segment_name, keyframe.keyframe.T_odom_body
        else:
            out[keyframe.keyframe_key] = previous[0], se3.orthonormal(previous[1] @ edge.T_ref_body)
    return out


def _poses_by_key(poses: SavePoses) -> dict[KeyframeKey, tuple[str, F64]]:
    return dict(zip(poses.keys, zip(poses.map_ids, poses.T_map_body, strict=True), strict=True))
