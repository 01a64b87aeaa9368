"""What the edge wants kept, so that a crash costs nothing that was acknowledged."""

from __future__ import annotations

from dataclasses import dataclass

from share.merge.join import Key, Loop
from share.types import F64, Keyframe
from share.wire.messages import Hello


@dataclass(frozen=True, eq=False)
class KeepRun:
    """One run of one agent; key names it."""

    key: str
    hello: Hello


@dataclass(frozen=True, eq=False)
class KeepKeyframe:
    """A keyframe of a run, and where it stands in its odometry: T_odom_body (4, 4)."""

    key: str
    keyframe: Keyframe
    T_odom_body: F64


@dataclass(frozen=True, eq=False)
class KeepLoop:
    """A loop that ties the map together."""

    loop: Loop


@dataclass(frozen=True, eq=False)
class DropLoop:
    """It does no longer."""

    a: Key
    b: Key


Change = KeepRun | KeepKeyframe | KeepLoop | DropLoop
