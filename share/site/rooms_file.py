"""The rooms file of a site: each room with its map file, who may be in it, and its limits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from share.agent_names import checked_name
from share.config import Config
from share.errors import ConfigError, UsageError
from share.files.reading import MAX_SETTINGS_BYTES, read_errors, read_text
from share.plain_data import from_mapping
from share.strict_yaml import load_yaml

_SCHEMA = 1
_MAX_ROOMS = 500


@dataclass(frozen=True)
class RoomSpec:
    """One room. map: its file, relative to the rooms file; None: the map is not kept. agents: names that may
    be in it; None: all. max_agents, max_keyframes: as edge.max_agents and edge.max_keyframes."""

    map: str | None = None
    agents: tuple[str, ...] | None = None
    max_agents: int | None = None
    max_keyframes: int | None = None

    def settings(self, config: Config) -> Config:
        """Return the settings of this room. Raises ValueError."""
        edge = config.edge
        if self.max_agents is not None:
            edge = replace(edge, max_agents=self.max_agents)
        if self.max_keyframes is not None:
            edge = replace(edge, max_keyframes=self.max_keyframes)
        return replace(config, edge=edge)


@dataclass(frozen=True)
class _RoomsFile:
    rooms: dict[str, RoomSpec]
    schema: int = _SCHEMA


@dataclass(frozen=True)
class SitePlan:
    """The rooms by name; those of whom nothing is known begin in the first. folder: of the rooms file."""

    rooms: dict[str, RoomSpec]
    folder: Path

    def map_file(self, room: str) -> Path | None:
        """Return the map file of a room."""
        name = self.rooms[room].map
        return None if name is None else self.folder / name


def read_rooms(path: Path) -> SitePlan:
    """Read a rooms file. Raises UsageError, ConfigError."""
    where = str(path)
    with read_errors(path, UsageError):
        text = read_text(path, MAX_SETTINGS_BYTES)
    data = load_yaml(text, where)
    if isinstance(data, dict) and isinstance(rooms := data.get("rooms"), dict):  # some without anything
        data = {**data, "rooms": {room: {} if one is None else one for room, one in rooms.items()}}
    read = from_mapping(_RoomsFile, data, where)
    if read.schema != _SCHEMA:
        raise ConfigError(f"{where}: schema {read.schema}; this SHARE reads {_SCHEMA}")
    if not 1 <= len(read.rooms) <= _MAX_ROOMS:
        raise ConfigError(f"{where}: {len(read.rooms)} rooms; name 1 to {_MAX_ROOMS}")
    plan = SitePlan(read.rooms, path.parent)
    for room, one in plan.rooms.items():
        _check_room(room, one, f"{where}: rooms: {room!r}")
    _check_maps(plan, where)
    return plan


def _check_room(room: str, spec: RoomSpec, where: str) -> None:
    try:
        for name in (room, *(spec.agents or ())):
            if checked_name(name) != name:
                raise ValueError("name: is not composed (NFC)")
        spec.settings(Config())
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None
    if spec.agents is not None and len(set(spec.agents)) < len(spec.agents):
        raise ConfigError(f"{where}: agents: a name is given twice")


def _check_maps(plan: SitePlan, where: str) -> None:
    rooms_by_map: dict[Path, str] = {}
    for room in plan.rooms:
        if (path := plan.map_file(room)) is None:
            continue
        other = rooms_by_map.setdefault(path.resolve(), room)
        if other != room:
            raise ConfigError(f"{where}: rooms '{other}' and '{room}' have the same map; give each its own")
