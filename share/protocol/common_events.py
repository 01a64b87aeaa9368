"""Events and effects of several state machines: agents, clients of a room, robot bridge, edge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from share.errors import ShareError
from share.wire.layouts import Bytes

# ---------------------------------------------------------------- events


@dataclass(frozen=True)
class Connected:
    """The link has reached an edge, perhaps a restarted one."""


@dataclass(frozen=True, eq=False)
class EdgeMessageReceived:
    """A message from the edge, undecoded."""

    frames: Sequence[Bytes]


@dataclass(frozen=True)
class Tick:
    """Time has passed; every 50 ms suffices."""


# ---------------------------------------------------------------- effects


@dataclass(frozen=True, eq=False)
class SendToEdge:
    """Hand a message to the link. An agent's is answered by `SendFailed` if the link refuses it.
    keyframe_id: None if it is no keyframe."""

    frames: Sequence[Bytes]
    keyframe_id: int | None = None


@dataclass(frozen=True)
class PrintLine:
    """One line for a person."""

    text: str


@dataclass(frozen=True)
class FailRun:
    """The run cannot go on; `error` says why."""

    error: ShareError
