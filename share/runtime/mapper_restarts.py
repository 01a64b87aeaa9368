"""What becomes of a mapper that has died: when the next one begins, and with which map."""

from __future__ import annotations

import time
from collections.abc import Callable

from share.errors import ShareError
from share.mapping.map_changes import StoredMap, with_unknown_credentials
from share.protocol.peer import RestoredRun, restored_runs
from share.store.map_store import MapStore
from share.timing import Backoff

_MAX_TRIES = 3  # mappers that may die of one map, before it is set aside


class MapperRestarts:
    """Of the mapper of one edge. `notify` is told what happens to the map file.

    A map that the edge cannot make anything of, or that has ended `_MAX_TRIES` mappers while they took it
    in, is set aside under another name, never deleted; the edge goes on with a fresh one.
    """

    def __init__(
        self, store: MapStore | None, known_m: float, notify: Callable[[str], None], has_keys: bool = False
    ) -> None:
        """known_m: as `share.protocol.peer.known_runs`. has_keys: whether agents of this edge have keys."""
        self.store = store  # None also once a map that may not be written is no longer used
        self._known_m, self._notify, self._has_keys = known_m, notify, has_keys
        self._backoff = Backoff(time.monotonic_ns())
        self._is_restoring = False
        self._tries = 0

    @property
    def writable(self) -> bool:
        return self.store is not None and self.store.writable

    def record_restored(self) -> None:
        """The mapper has taken the map in."""
        self._is_restoring, self._tries = False, 0

    def record_death(self) -> float:
        """Seconds until the next may begin."""
        self._tries += self._is_restoring
        return self._backoff.record_failure(time.monotonic_ns())

    def load_map(self) -> tuple[StoredMap | None, list[RestoredRun]]:
        """What a new life begins with. Raises StoreError if the file cannot be read at the moment."""
        self._is_restoring = False
        if self._tries >= _MAX_TRIES:
            self._set_aside(f"{self._tries} mappers, one after the other, have died of it")
        if self.store is None:
            return None, []
        try:
            stored_map = with_unknown_credentials(self.store.load()) if self._has_keys else self.store.load()
            known = restored_runs(stored_map, self._known_m)
        except ShareError:
            raise
        except Exception as error:  # whatever is in a file, the edge goes on
            self._set_aside(f"{type(error).__name__}: {error}")
            return None, []
        self._is_restoring = bool(stored_map.keyframes)
        return stored_map, known

    def _set_aside(self, reason: str) -> None:
        self._tries = 0
        if self.store is None:
            return
        if not self.store.writable:
            self.store = None
            self._notify(f"the map is not used any more: {reason}; nothing is kept")
            return
        renamed = self.store.set_aside()
        self._notify(f"the map is set aside as {renamed.name}: {reason}; a fresh one is begun")
