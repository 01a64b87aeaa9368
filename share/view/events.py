"""Input events of the live room, sent by the edge or by `share track`, and what sums them up."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import SavePoses
from share.types import F32, F64, AgentKind, TrackState

MERGES = frozenset(("maps merged", "merge undone"))
REFUSALS = frozenset(("merge skipped", "loop refused", "loop not accepted"))


@dataclass(frozen=True)
class SessionBegun:
    """The map starts anew. map_file: the map that it continues; None: none."""

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
    `PoseUpdate`; None: unknown. stamp_ns: by the agent's clock. received_ns: when it came to the
    edge, by this machine's monotonic clock. sigma_m, sigma_rad: as in `PoseUpdate`."""

    run: str
    state: TrackState
    keyframe: int
    T_keyframe_body: F64
    age_ms: float | None = None
    stamp_ns: int = 0
    received_ns: int = 0
    sigma_m: float | None = None
    sigma_rad: float | None = None


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


MAX_KEYFRAMES = 5000  # some kB each


class SessionSnapshot:
    """The state of a session as the fewest events that lead to it, for a live room that is started again.

    It has no pictures, and the newest keyframes only; with a map file the live room reads older ones there.
    """

    def __init__(self) -> None:
        self._begin(SessionBegun())

    def _begin(self, session: SessionBegun) -> None:
        self._session = session
        self._runs: dict[str, RunArrived] = {}
        self._keyframes: dict[KeyframeKey, KeyframeArrived] = {}
        self._corrections: dict[str, CorrectionArrived] = {}
        self._solved: MapsSolved | None = None
        self._loops: dict[frozenset[KeyframeKey], LoopAccepted] = {}

    def apply(self, event: RoomEvent) -> None:
        match event:
            case SessionBegun():
                self._begin(event)
            case RunArrived():
                self._runs[event.run] = event
            case KeyframeArrived():
                self._keyframes[event.key] = replace(event, jpeg=b"")
                if len(self._keyframes) > MAX_KEYFRAMES:
                    del self._keyframes[next(iter(self._keyframes))]
            case CorrectionArrived():
                self._corrections[event.run] = event
            case MapsSolved():
                self._solved = event
            case LoopAccepted():
                self._loops[frozenset((event.a, event.b))] = event
            case LoopsRemoved():
                self._loops.pop(frozenset((event.a, event.b)), None)
            case KeyframesRemoved():
                self._remove(set(event.keys))
            case RunRemoved():
                self._runs.pop(event.run, None)
                self._corrections.pop(event.run, None)
                self._remove({key for key in self._keyframes if key.agent == event.run})

    def _remove(self, keys: set[KeyframeKey]) -> None:
        for key in keys:
            self._keyframes.pop(key, None)
        self._loops = {pair: loop for pair, loop in self._loops.items() if not pair & keys}

    def events(self) -> Iterator[RoomEvent]:
        """Yield the events that lead to the same room."""
        yield self._session
        yield from self._runs.values()
        yield from self._keyframes.values()
        yield from self._corrections.values()  # before what is solved, which is better known
        if self._solved is not None:
            yield self._solved
        yield from self._loops.values()
