"""The room of a session that `share emulate` made, opened again: its floor, its people, its renderer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from share.errors import UsageError
from share.lab.emulate.motion.route import floor_from_occupancy
from share.lab.emulate.recipe import Progress, SessionRecipe
from share.lab.emulate.sensor.effects import Effects
from share.lab.emulate.session import default_cache
from share.lab.emulate.stage import Actor, keep_room, prepare_session
from share.lab.emulate.types import RoomRenderer
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.occupancy import Occupancy
from share.lab.emulate.world.room_files import open_renderer
from share.lab.robot.planner import RoomGrid
from share.plain_data import from_mapping
from share.recordings.session import Session
from share.types import F64, I64, AgentKind

_PARTS_NS = 10_000_000  # between poses of people's bodies


@dataclass(frozen=True, eq=False)
class EmulatedRoom:
    """recipe: of the session. people: its headsets, in the session's order. folder: of the room to draw."""

    recipe: SessionRecipe
    layout: Layout
    grid: RoomGrid
    people: tuple[Actor, ...]
    folder: Path

    def open_renderer(self) -> RoomRenderer:
        return open_renderer(self.folder)

    def people_at(self, session_ns: int) -> F64:
        """Return where the people's heads are (P, 2), m, at a session time."""
        at = [
            person.path.poses(_own_times(person, np.array([session_ns])))[0, :2, 3] for person in self.people
        ]
        return np.array(at, np.float64).reshape(-1, 2)


def open_room(recipe: SessionRecipe, progress: Progress, has_pictures: bool = True) -> EmulatedRoom:
    """Return the room of a session, made again. has_pictures: kept in the user's cache, to be drawn."""
    prepared = prepare_session(recipe, default_cache() / f"room-{recipe.digest}", progress)
    if has_pictures:
        keep_room(prepared, progress)
    actors = prepared.stage.actors
    return EmulatedRoom(
        recipe,
        prepared.layout,
        RoomGrid(floor_from_occupancy(Occupancy.from_layout(prepared.layout))),
        tuple(actor for actor in actors if actor.kind is AgentKind.AR),
        prepared.stage.room,
    )


def session_recipe(session: Session) -> SessionRecipe:
    """Return the recipe that a session was made by. Raises UsageError for a session from elsewhere."""
    made = session.provenance
    if made.get("generator") != "share emulate":
        raise UsageError(
            f"{session.folder}: its room is not known; give a session that `share emulate` has made"
        )
    fields = {
        key: made[key] for key in ("scene", "motions", "seconds", "seed", "sensors", "profiles", "images")
    }
    size = made.get("size")
    return SessionRecipe(
        **fields | {"motions": tuple(fields["motions"])},
        size=None if size is None else tuple(size),
        effects=from_mapping(Effects, made["effects"], "effects"),
        day=made.get("day", 0),
    )


def _own_times(person: Actor, session_ns: I64) -> I64:
    return np.clip(session_ns + person.path.start_ns, person.path.start_ns, person.path.end_ns)


class Bodies:
    """The bodies of people at any time, from poses of their parts that are known each _PARTS_NS."""

    def __init__(self, people: tuple[Actor, ...]) -> None:
        self._parts = {}
        for person in people:
            span_ns = person.path.end_ns - person.path.start_ns
            times = np.arange(0, span_ns + 1, _PARTS_NS)
            self._parts[person.name] = person.avatar.part_poses(_own_times(person, times))

    def at(self, session_ns: I64) -> list[dict[str, F64]]:
        """Return the poses of all parts (P, 4, 4), by name, at each of session times (N,)."""
        return [{name: _blend(parts, int(t)) for name, parts in self._parts.items()} for t in session_ns]


def _blend(parts: F64, session_ns: int) -> F64:
    """Return parts between two known times. Rotations that near are blended as matrices."""
    first, rest_ns = divmod(min(session_ns, (len(parts) - 1) * _PARTS_NS), _PARTS_NS)
    share = rest_ns / _PARTS_NS
    blended: F64 = (1 - share) * parts[first] + share * parts[min(first + 1, len(parts) - 1)]
    return blended
