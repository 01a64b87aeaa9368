"""What the edge is told (events) and what it wants done (effects): of its agents, its mapper, its keeper, and
of trackers, where it tracks agents that stream."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from share.geometry.camera import Rig
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import MapChange
from share.mapping.steps import MapEvent
from share.types import Frame, Keyframe
from share.wire import messages as wire
from share.wire.codec import Bytes

# ---------------------------------------------------------------- events


@dataclass(frozen=True)
class PeerMessageReceived:
    """A message, still bytes, from the peer that the transport knows by this id.

    names: of the agents that its key may speak for; None where no keys are used. voice: that key; ""
    without."""

    peer_id: bytes
    frames: Sequence[Bytes]
    allowed_names: frozenset[str] | None = None
    credential: str = ""

    def is_authorised_for(self, name: str) -> bool:
        return self.allowed_names is None or name in self.allowed_names


@dataclass(frozen=True)
class MapperResult:
    """What the mapper has decided, and what of it must survive a crash."""

    findings: Sequence[MapEvent]
    changes: Sequence[MapChange] = ()
    empty_runs: Sequence[
        KeyframeKey
    ] = ()  # runs of which nothing is left, each with its newest keyframe that came


@dataclass(frozen=True)
class ChangesSaved:
    """Everything up to this ticket will be there after a crash."""

    ticket: int


@dataclass(frozen=True)
class EdgeTick:
    """Time has passed."""


# ---------------------------------------------------------------- of a tracker


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
    """The tracker has died; how, for a person."""

    key: str
    generation: int
    reason: str


TrackerEvent = TrackerReady | TrackerAnswered | TrackerLost
EdgeEvent = PeerMessageReceived | MapperResult | ChangesSaved | EdgeTick | TrackerEvent

# ---------------------------------------------------------------- effects


@dataclass(frozen=True)
class SendToPeer:
    peer_id: bytes
    frames: Sequence[Bytes]


@dataclass(frozen=True)
class AddRun:
    """To the mapper: a run of an agent, before its first keyframe. voice: the key that speaks for it, and has
    one vote with all its names; "": the name has a vote of its own."""

    key: str
    hello: wire.Hello
    credential: str = ""


@dataclass(frozen=True)
class SetCredential:
    """To the mapper: who speaks for a run from now on; voice: as of `AddRun`."""

    key: str
    credential: str


@dataclass(frozen=True)
class AddKeyframe:
    """To the mapper: the next keyframe of a run, each once and in order. is_extra: more than its agent may
    send; it is looked up only when nothing else waits, and maps may be joined by it."""

    key: str
    keyframe: Keyframe
    is_over_rate: bool = False


@dataclass(frozen=True)
class SetPresence:
    """To the mapper: a run is heard, or no longer. Whoever joins is; a run of an earlier life is not yet."""

    key: str
    is_present: bool


@dataclass(frozen=True)
class DropRun:
    """To the mapper: nothing is left of this run, and it will not come back."""

    key: str


@dataclass(frozen=True)
class SaveChanges:
    """Make this safe, and answer with `ChangesSaved`. Tickets rise."""

    ticket: int
    changes: tuple[MapChange, ...]


@dataclass(frozen=True)
class WriteEvent:
    """A decision with its reason: one line of events.jsonl."""

    fields: dict[str, Any]


# ---------------------------------------------------------------- for a tracker


@dataclass(frozen=True, eq=False)
class StartTracker:
    """A tracker for this rig; it answers `TrackerReady`. life: how many this agent has had before."""

    key: str
    generation: int
    rig: Rig


@dataclass(frozen=True, eq=False)
class TrackFrame:
    """The next frame of this agent; it is answered by `TrackerAnswered`."""

    key: str
    frame: Frame


@dataclass(frozen=True)
class StopTracker:
    """Its tracker is not needed any more."""

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
