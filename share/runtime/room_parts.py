"""What a room is made of, on this machine or on another: the open map file and the mapper."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from share.mapping.map_changes import MapChange, StoredMap
from share.store.map_store import MapStore
from share.store.salvage import ReadRows


class RoomStore(Protocol):
    """A map file that is open; see `share.store.map_store.MapStore`."""

    @property
    def path(self) -> Path: ...

    @property
    def writable(self) -> bool: ...

    @property
    def read_only_reason(self) -> str: ...

    @property
    def problems(self) -> tuple[str, ...]: ...

    @property
    def loss(self) -> str | None:
        """What has happened to the machine that had it open, so that it has to be opened anew; None: it
        lives."""

    def outline(self) -> StoredMap: ...

    def rows(self) -> ReadRows: ...

    def write(self, new_changes: Sequence[MapChange]) -> None: ...

    def set_aside(self, forgotten: Mapping[str, int]) -> Path: ...

    def close(self) -> None: ...

    def abandon(self) -> None: ...


class MapperLink(Protocol):
    """The way to a mapper; see `share.runtime.worker_process.WorkerProcess`."""

    def send(self, message: Any) -> None: ...

    def close(self) -> None: ...


StartMapping = Callable[[Callable[[Any], None], Callable[[str], None], float], MapperLink]
# (on_answer, on_death, start_delay_s)


@dataclass(frozen=True, eq=False)
class OpenedRoom:
    """start_mapper: on the machine that has the file open; None: on this one."""

    store: RoomStore
    start_mapper: StartMapping | None = None


OpenRoom = Callable[[Path], OpenedRoom]


def open_here(path: Path) -> OpenedRoom:
    """Open a room's map file on this machine. Raises ShareError."""
    return OpenedRoom(MapStore.open(path))
