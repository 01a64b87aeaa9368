"""What the edge wants kept of its map: changes, one after the other, and what is found again.

A list of changes is kept as a whole or not at all (`share.store.map_store`). What is `Kept` says again
what the changes said, so that the atlas can be built anew from it: keyframes and the odometry edges
that lead to them, loops, the newest solution.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from share.geometry import se3
from share.mapping.loops import Key, Loop
from share.types import F64, Keyframe, checked, checked_cov, checked_pose
from share.wire.messages import Hello


@dataclass(frozen=True, eq=False)
class KeepRun:
    """One run of one agent. key: names it everywhere here. Comes before its keyframes. voice: the public key
    that speaks for it; "": none did; None: it may be any."""

    key: str
    hello: Hello
    voice: str | None = ""


@dataclass(frozen=True)
class KeepVoice:
    """Who speaks for a run that is kept, from now on: a public key; "": no key."""

    key: str
    voice: str


@dataclass(frozen=True, eq=False)
class KeepKeyframe:
    """A keyframe of a run.

    Numbers of a run rise; one that is not above all before was kept already, or retired, and changes nothing.
    """

    key: str
    keyframe: Keyframe

    @property
    def at(self) -> Key:
        return Key(self.key, self.keyframe.id)


@dataclass(frozen=True, eq=False)
class KeptKeyframe(KeepKeyframe):
    """Found again. stretch: `key/n`, the n-th of its run; a keyframe without a reference begins one.
    ordinal: how many came before it there, retired ones too, if they were not its newest."""

    stretch: str
    ordinal: int


@dataclass(frozen=True, eq=False)
class KeepLink:
    """The odometry edge that leads to a keyframe from now on: those before it were retired.

    reference: number of a keyframe of the same run, or -1: it is the first of its stretch now, and
    T_ref_body (4, 4) is its T_odom_body. cov (6, 6): of T_ref_body, as the pose graph uses it, not as
    the agent said it.
    """

    key: Key
    reference: int
    T_ref_body: F64
    cov: F64

    def __post_init__(self) -> None:
        if not -1 <= self.reference < self.key.id:
            raise ValueError(f"reference: {self.reference} must lie in -1 .. {self.key.id - 1}")
        object.__setattr__(self, "T_ref_body", checked_pose("T_ref_body", self.T_ref_body))
        object.__setattr__(self, "cov", checked_cov("cov", self.cov))


@dataclass(frozen=True, eq=False)
class KeepLoop:
    """An accepted loop. Several may tie the same two keyframes."""

    loop: Loop


@dataclass(frozen=True)
class DropLoop:
    """All loops between these two keyframes, whichever way round."""

    a: Key
    b: Key


@dataclass(frozen=True)
class Retire:
    """Keyframes that go, with their links and loops. Their numbers are never asked for again."""

    keys: tuple[Key, ...]


@dataclass(frozen=True)
class ForgetRun:
    """A run of which nothing is left goes, with its name. Nothing of it comes afterwards."""

    key: str


@dataclass(frozen=True, eq=False)
class KeepPoses:
    """The newest solution; it takes the place of the one before. T_map_body (N, 4, 4) of `keys`, each in
    the map that `maps` names."""

    keys: tuple[Key, ...]
    T_map_body: F64
    maps: tuple[str, ...]

    def __post_init__(self) -> None:
        n = len(self.keys)
        if len(self.maps) != n:
            raise ValueError(f"maps: {len(self.maps)} names for {n} keyframes")
        object.__setattr__(self, "T_map_body", checked("T_map_body", self.T_map_body, (n, 4, 4), np.float64))


Change = KeepRun | KeepVoice | KeepKeyframe | KeepLink | KeepLoop | DropLoop | Retire | ForgetRun | KeepPoses


@dataclass(frozen=True, eq=False)
class Kept:
    """What is found again.

    runs, stretches (names), keyframes: in the order in which they came, stretches also without
    keyframes by now. links: for keyframes whose odometry edge is no longer the one that they came with.
    loops: oldest first. next_keyframe: of each run, one above all that it ever had here. complaints: what
    is missing, a line each.
    """

    runs: tuple[KeepRun, ...] = ()
    stretches: tuple[str, ...] = ()
    keyframes: tuple[KeptKeyframe, ...] = ()
    links: Mapping[Key, KeepLink] = field(default_factory=dict)
    loops: tuple[Loop, ...] = ()
    poses: KeepPoses | None = None
    next_keyframe: Mapping[str, int] = field(default_factory=dict)
    complaints: tuple[str, ...] = ()


def with_keys(kept: Kept) -> Kept:
    """For an edge that uses keys: a run for which none spoke may be anybody's."""
    return replace(kept, runs=tuple(replace(run, voice=run.voice or None) for run in kept.runs))


def edge_to(keyframe: KeepKeyframe, links: Mapping[Key, KeepLink]) -> KeepLink:
    """The odometry edge that leads to a keyframe: its link, or what it came with."""
    own = keyframe.keyframe
    return links.get(keyframe.at) or KeepLink(keyframe.at, own.reference, own.T_ref_body, own.cov)


def placed(kept: Kept) -> dict[Key, tuple[str, F64]]:
    """Map and T_map_body (4, 4) of every keyframe.

    One that came after the newest solution follows its reference; a stretch that no solution speaks of is
    a map of its own, where its odometry says.
    """
    solved = {} if kept.poses is None else _by_key(kept.poses)
    out: dict[Key, tuple[str, F64]] = {}
    for keyframe in kept.keyframes:
        if keyframe.at in solved:
            out[keyframe.at] = solved[keyframe.at]
            continue
        edge = edge_to(keyframe, kept.links)
        before = out.get(Key(keyframe.key, edge.reference))
        if before is None:
            out[keyframe.at] = keyframe.stretch, keyframe.keyframe.T_odom_body
        else:
            out[keyframe.at] = before[0], se3.orthonormal(before[1] @ edge.T_ref_body)
    return out


def _by_key(poses: KeepPoses) -> dict[Key, tuple[str, F64]]:
    return dict(zip(poses.keys, zip(poses.maps, poses.T_map_body, strict=True), strict=True))
