"""The map file is read in a thread after the mapper's death: a damaged one is repaired first, for seconds."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from share.mapping.map_changes import StoredMap
from share.runtime.room_parts import RoomStore
from share.store.salvage import ReadRows


@dataclass(frozen=True, eq=False)
class MapRead:
    """The rows of a map file and what runs continue from, or why they cannot be read. new_problems: of the
    file, found meanwhile, a line each."""

    found: tuple[ReadRows, StoredMap] | None
    error: Exception | None
    new_problems: tuple[str, ...]


def read_map(store: RoomStore) -> MapRead:
    """Read the rows of a map file, and repair it if it is damaged."""
    known = len(store.problems)
    found: tuple[ReadRows, StoredMap] | None = None
    error: Exception | None = None
    try:
        found = store.rows(), store.outline()
    except Exception as reason:
        error = reason
    return MapRead(found, error, store.problems[known:])


class MapReading:
    """Reads a map file; nobody else may use it meanwhile. on_read: called from the thread, once. Raises
    RuntimeError where no thread can be started."""

    def __init__(self, store: RoomStore, on_read: Callable[[MapRead], None]) -> None:
        self._thread = threading.Thread(
            target=lambda: on_read(read_map(store)), name="map reading", daemon=True
        )
        self._thread.start()

    def wait(self, timeout_s: float) -> bool:
        """Wait for the end. Return False if that takes longer than `timeout_s`."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()
