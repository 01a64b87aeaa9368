"""The map file is read in a thread after the mapper's death: a damaged one is repaired first, for seconds."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from share.errors import brief_reason
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
        self._store, self._on_read = store, on_read
        self._read: MapRead | None = None
        self._thread = threading.Thread(target=self._run, name="map reading", daemon=True)
        self._thread.start()

    def end(self, timeout_s: float, notify: Callable[[str], None]) -> str:
        """Wait for the end, notify of problems that were found, and close the file; abandon it where that
        takes longer than `timeout_s`. Return why it could not be read; "" if it could."""
        self._thread.join(timeout_s)
        if (read := self._read) is None:
            self._store.abandon()
            return "the map file was still being read, or repaired"
        for problem in read.new_problems:
            notify(problem)
        self._store.close()
        return "" if read.error is None else brief_reason(read.error)

    def _run(self) -> None:
        self._read = read_map(self._store)
        self._on_read(self._read)
