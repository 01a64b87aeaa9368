"""What the edge is told (events) and what it wants done (effects): of its agents, its mapper, its keeper, and
of trackers, where it tracks agents that stream."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from share.geometry.camera import Rig
from share.mapping.changes import Change
from share.mapping.loops import Key
from share.mapping.steps import Finding
from share.types import Frame, Keyframe
from share.wire import messages as wire
from share.wire.codec import Bytes

# ---------------------------------------------------------------- events


@dataclass(frozen=True)
class Received:
    """A message, still bytes, from the peer that the transport knows by this id.

    names: of the agents that its key may speak for; None where no keys are used. voice: that key; ""
    without."""

    peer: bytes
    frames: Sequence[Bytes]
    names: frozenset[str] | None = None
    voice: str = ""

    def speaks_for(self, name: str) -> bool:
        return self.names is None or name in self.names


@dataclass(frozen=True)
class Found:
    """What the mapper has decided, and what of it must survive a crash."""

    findings: Sequence[Finding]
    changes: Sequence[Change] = ()
    emptied: Sequence[Key] = ()  # runs of which nothing is left, each with its newest keyframe that came


@dataclass(frozen=True)
class Kept:
    """Everything up to this ticket will be there after a crash."""

    ticket: int


@dataclass(frozen=True)
class Tick:
    """Time has passed."""


# ---------------------------------------------------------------- of a tracker


@dataclass(frozen=True)
class Ready:
    key: str
    life: int


@dataclass(frozen=True, eq=False)
class Answered:
    key: str
    life: int
    answer: wire.Tracked


@dataclass(frozen=True)
class Lost:
    """The tracker has died; how, for a person."""

    key: str
    life: int
    how: str


FromTracker = Ready | Answered | Lost
Event = Received | Found | Kept | Tick | FromTracker

# ---------------------------------------------------------------- effects


@dataclass(frozen=True)
class Send:
    peer: bytes
    frames: Sequence[Bytes]


@dataclass(frozen=True)
class Join:
    """To the mapper: a run of an agent, before its first keyframe. voice: the key that speaks for it, and has
    one vote with all its names; "": the name has a vote of its own."""

    key: str
    hello: wire.Hello
    voice: str = ""


@dataclass(frozen=True)
class Speaks:
    """To the mapper: who speaks for a run from now on; voice: as of `Join`."""

    key: str
    voice: str


@dataclass(frozen=True)
class Add:
    """To the mapper: the next keyframe of a run, each once and in order. is_extra: more than its agent may
    send; it is looked up only when nothing else waits, and maps may be joined by it."""

    key: str
    keyframe: Keyframe
    is_extra: bool = False


@dataclass(frozen=True)
class Present:
    """To the mapper: a run is heard, or no longer. Whoever joins is; a run of an earlier life is not yet."""

    key: str
    here: bool


@dataclass(frozen=True)
class Forget:
    """To the mapper: nothing is left of this run, and it will not come back."""

    key: str


@dataclass(frozen=True)
class Keep:
    """Make this safe, and answer with `Kept`. Tickets rise."""

    ticket: int
    changes: tuple[Change, ...]


@dataclass(frozen=True)
class Record:
    """A decision with its reason: one line of events.jsonl."""

    fields: dict[str, Any]


# ---------------------------------------------------------------- for a tracker


@dataclass(frozen=True, eq=False)
class BeginTracking:
    """A tracker for this rig; it answers `Ready`. life: how many this agent has had before."""

    key: str
    life: int
    rig: Rig


@dataclass(frozen=True, eq=False)
class Track:
    """The next frame of this agent; it is answered by `Answered`."""

    key: str
    frame: Frame


@dataclass(frozen=True)
class EndTracking:
    """Its tracker is not needed any more."""

    key: str


ToTracker = BeginTracking | Track | EndTracking
Effect = Send | Join | Speaks | Present | Add | Forget | Keep | Record | ToTracker
