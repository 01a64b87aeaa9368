"""What is around a room that an edge serves: the edge, and the other rooms of a site."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from share.event_kinds import EventKind
from share.mapping.places import KeyframeSought, PlaceNews
from share.protocol.edge_events import AddKeyframe
from share.wire.layouts import Bytes


class RoomHost(Protocol):
    """What a room needs of the edge around it. All but `wake` are called from the edge's loop."""

    def wake(self) -> None:
        """Have `ServedRoom.step` called soon. Safe from any thread."""

    def send(self, peer_id: bytes, frames: Sequence[Bytes]) -> None: ...

    def expect_growth(self, is_expected: bool) -> None:
        """The memory of this process grows while a stored map is restored."""

    def record(self, fields: dict[str, Any]) -> None:
        """Log an event of the state machine."""

    def log_event(self, event: EventKind, reason: str) -> None:
        """Log what happens to the room's processes and files."""


class OtherRooms(Protocol):
    """What a room tells of itself where there are others. All is called from the edge's loop."""

    def note_session(self) -> None:
        """The room's map begins anew, with what its file holds."""

    def note_keyframe(self, added: AddKeyframe) -> None:
        """A keyframe goes to the mapper."""

    def note_places(self, news: Sequence[PlaceNews]) -> None:
        """The map has changed, or has not recognised a keyframe."""

    def note_sought(self, sought: KeyframeSought) -> None:
        """The answer to `ServedRoom.find`."""
