"""Input events of the live room, sent by the edge or by `share track`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import SavePoses
from share.types import F32, F64, AgentKind, TrackState

MERGES = frozenset(("maps merged", "merge undone"))
REFUSALS = frozenset(("merge skipped", "loop refused", "loop not accepted"))


@dataclass(frozen=True)
class SessionBegun:
    """The map starts anew. map_file: what it continues with; None: nothing."""

    map_file: Path | None = None


@dataclass(frozen=True, eq=False)
class RunArrived:
    """A run of an agent. T_body_cam0 (4, 4). half_angles: tangents of half of cam0's horizontal and vertical
    field of view."""

    run: str
    name: str
    kind: AgentKind
    T_body_cam0: F64
    half_angles: tuple[float, float]


@dataclass(frozen=True, eq=False)
class KeyframeArrived:
    """A keyframe. points (N, 3) float32 m, in the body. jpeg: cam0's image; empty without one."""

    key: KeyframeKey
    begins_segment: bool
    T_odom_body: F64
    points: F32
    jpeg: bytes = b""


@dataclass(frozen=True, eq=False)
class PoseArrived:
    """A run's newest pose (4, 4), relative to its keyframe `keyframe`; -1: in odom. age_ms: as in
    `PoseUpdate`; None: unknown."""

    run: str
    state: TrackState
    keyframe: int
    T_keyframe_body: F64
    age_ms: float | None = None


@dataclass(frozen=True, eq=False)
class CorrectionArrived:
    """T_map_odom (4, 4) of a run's segment that holds the keyframe `segment_keyframe`."""

    run: str
    map_id: str
    T_map_odom: F64
    segment_keyframe: int


@dataclass(frozen=True, eq=False)
class MapsSolved:
    """The poses of all keyframes."""

    poses: SavePoses


@dataclass(frozen=True)
class LoopAccepted:
    a: KeyframeKey
    b: KeyframeKey


@dataclass(frozen=True)
class LoopsRemoved:
    """All loops between two keyframes are removed."""

    a: KeyframeKey
    b: KeyframeKey


@dataclass(frozen=True)
class KeyframesRemoved:
    keys: tuple[KeyframeKey, ...]


@dataclass(frozen=True)
class RunRemoved:
    run: str


@dataclass(frozen=True)
class DecisionMade:
    """A line of events.jsonl. agent: its name; None: none."""

    t_s: float
    event: str
    agent: str | None
    reason: str


@dataclass(frozen=True)
class AgentsReported:
    """Entries of edge.json by label. trouble: of the edge. left_out: events that this viewer was too slow
    for."""

    agents: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    trouble: tuple[str, ...] = ()
    left_out: int = 0


RoomEvent = (
    SessionBegun
    | RunArrived
    | KeyframeArrived
    | PoseArrived
    | CorrectionArrived
    | MapsSolved
    | LoopAccepted
    | LoopsRemoved
    | KeyframesRemoved
    | RunRemoved
    | DecisionMade
    | AgentsReported
)
