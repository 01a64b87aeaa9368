"""Events and effects of the edge's state machine: peers, the mapper, the map writer, and the trackers of
streamed agents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from share.geometry.camera import Rig
from share.mapping.corrections import MapEvent
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import MapChange
from share.protocol.common_events import Tick
from share.types import Frame, Keyframe
from share.wire import messages as wire
from share.wire.layouts import Bytes
from share.wire.room_messages import Permission

# ---------------------------------------------------------------- events


@dataclass(frozen=True)
class PeerMessageReceived:
    """An undecoded message of a peer, by its transport id.

    allowed_names: agents that its credential is authorised for; None without keys. credential: its public
    key; "" without keys. permissions: what it may do as a client."""

    peer_id: bytes
    frames: Sequence[Bytes]
    allowed_names: frozenset[str] | None = None
    credential: str = ""
    permissions: frozenset[Permission] = frozenset()

    def is_authorised_for(self, name: str) -> bool:
        return self.allowed_names is None or name in self.allowed_names


@dataclass(frozen=True)
class MapperResult:
    """Decisions of the mapper, and the changes that must survive a crash. empty_runs: runs that the map has
    nothing left of, each with its newest received keyframe."""

    map_events: Sequence[MapEvent]
    changes: Sequence[MapChange] = ()
    empty_runs: Sequence[KeyframeKey] = ()


@dataclass(frozen=True)
class ChangesSaved:
    """All changes up to this ticket are stored."""

    ticket: int


# ---------------------------------------------------------------- events of trackers


@dataclass(frozen=True)
class TrackerReady:
    key: str
    generation: int


@dataclass(frozen=True, eq=False)
class TrackerAnswered:
    key: str
    generation: int
    result: wire.RemoteTrackingResult


@dataclass(frozen=True)
class TrackerLost:
    """The tracker process has died. reason: for a person."""

    key: str
    generation: int
    reason: str


TrackerEvent = TrackerReady | TrackerAnswered | TrackerLost
EdgeEvent = PeerMessageReceived | MapperResult | ChangesSaved | Tick | TrackerEvent

# ---------------------------------------------------------------- effects


@dataclass(frozen=True)
class SendToPeer:
    peer_id: bytes
    frames: Sequence[Bytes]


@dataclass(frozen=True)
class AddRun:
    """To the mapper: a new run, before its first keyframe. credential: its public key; all names of one key
    count as one identity. "": the name is an identity of its own."""

    key: str
    hello: wire.Hello
    credential: str = ""


@dataclass(frozen=True)
class SetCredential:
    """To the mapper: the credential of a run from now on, as in `AddRun`."""

    key: str
    credential: str


@dataclass(frozen=True)
class AddKeyframe:
    """To the mapper: the next keyframe of a run, each once and in order. is_over_rate: beyond the agent's
    rate; it is queried only while nothing else waits, and may still merge maps."""

    key: str
    keyframe: Keyframe
    is_over_rate: bool = False


@dataclass(frozen=True)
class SetPresence:
    """To the mapper: a run became present or absent. New runs are present, restored ones absent at first."""

    key: str
    is_present: bool


@dataclass(frozen=True)
class DropRun:
    """To the mapper: the run is forgotten and cannot come back."""

    key: str


@dataclass(frozen=True)
class SaveChanges:
    """Store these changes and answer `ChangesSaved`. Tickets rise."""

    ticket: int
    changes: tuple[MapChange, ...]


@dataclass(frozen=True)
class WriteEvent:
    """A decision with its reason: one line of events.jsonl."""

    fields: dict[str, Any]


# ---------------------------------------------------------------- effects for trackers


@dataclass(frozen=True, eq=False)
class StartTracker:
    """Start a tracker for this rig; it answers `TrackerReady`. generation: number of earlier trackers of the
    run."""

    key: str
    generation: int
    rig: Rig


@dataclass(frozen=True, eq=False)
class TrackFrame:
    """Track the next frame of this run; the answer is `TrackerAnswered`."""

    key: str
    frame: Frame


@dataclass(frozen=True)
class StopTracker:
    """Stop the tracker of this run."""

    key: str


TrackerEffect = StartTracker | TrackFrame | StopTracker
EdgeEffect = (
    SendToPeer
    | AddRun
    | SetCredential
    | SetPresence
    | AddKeyframe
    | DropRun
    | SaveChanges
    | WriteEvent
    | TrackerEffect
)
