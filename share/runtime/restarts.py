"""What becomes of a mapper that has died: when the next one begins, and with which map."""

from __future__ import annotations

import time
from collections.abc import Callable

from share.errors import ShareError
from share.mapping.changes import Kept, with_keys
from share.protocol.peer import Known, known_runs
from share.rates import Backoff
from share.store.map_store import MapStore

_TRIES = 3  # mappers that may die of one map, before it is set aside


class Restarts:
    """Of the mapper of one edge. `said` is told what happens to the map file.

    A map that the edge cannot make anything of, or that has ended `_TRIES` mappers while they took it in, is
    set aside under another name, never deleted; the edge goes on with a fresh one.
    """

    def __init__(
        self, store: MapStore | None, known_m: float, said: Callable[[str], None], has_keys: bool = False
    ) -> None:
        """known_m: as `share.protocol.peer.known_runs`. has_keys: whether agents of this edge have keys."""
        self.store = store  # None also once a map that may not be written is no longer used
        self._known_m, self._said, self._has_keys = known_m, said, has_keys
        self._backoff = Backoff(time.monotonic_ns())
        self._is_restoring = False
        self._tries = 0

    @property
    def writable(self) -> bool:
        return self.store is not None and self.store.writable

    def restored(self) -> None:
        """The mapper has taken the map in."""
        self._is_restoring, self._tries = False, 0

    def died(self) -> float:
        """Seconds until the next may begin."""
        self._tries += self._is_restoring
        return self._backoff.died(time.monotonic_ns())

    def found(self) -> tuple[Kept | None, list[Known]]:
        """What a new life begins with. Raises StoreError if the file cannot be read at the moment."""
        self._is_restoring = False
        if self._tries >= _TRIES:
            self._set_aside(f"{self._tries} mappers, one after the other, have died of it")
        if self.store is None:
            return None, []
        try:
            kept = with_keys(self.store.load()) if self._has_keys else self.store.load()
            known = known_runs(kept, self._known_m)
        except ShareError:
            raise
        except Exception as error:  # whatever is in a file, the edge goes on
            self._set_aside(f"{type(error).__name__}: {error}")
            return None, []
        self._is_restoring = bool(kept.keyframes)
        return kept, known

    def _set_aside(self, why: str) -> None:
        self._tries = 0
        if self.store is None:
            return
        if not self.store.writable:
            self.store = None
            self._said(f"the map is not used any more: {why}; nothing is kept")
            return
        kept = self.store.set_aside()
        self._said(f"the map is set aside as {kept.name}: {why}; a fresh one is begun")
