"""The thread that writes the map to its file: the edge goes on while the disk works, or does not."""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable

from share.core.edge_events import Keep, Kept
from share.errors import StoreError
from share.io.map_store import MapStore

_AGAIN_S = 5.0  # after a write that failed
_MOST = 4000  # changes that are held back for a disk that is full; then the oldest are lost
_AT_ONCE = 64  # in one commit


class Keeper:
    """`keep` what is to be safe; `done` is told once it is, `said` what goes wrong, from the thread.

    Where the file cannot be written, nobody is kept waiting: it is said once, changes are held in memory
    and tried again, and counted as kept meanwhile; agents still hold what was acknowledged last.
    """

    def __init__(self, store: MapStore, done: Callable[[Kept], None], said: Callable[[str], None]) -> None:
        self._store, self._done, self._said = store, done, said
        self._new: queue.SimpleQueue[Keep | None] = queue.SimpleQueue()
        self._held: deque[Keep] = deque()
        self._failing = False
        self._lost = 0
        self._thread = threading.Thread(target=self._work, name="keeper", daemon=True)
        self._thread.start()

    @property
    def failing(self) -> bool:
        """Whether the file cannot be written at the moment."""
        return self._failing

    def keep(self, keep: Keep) -> None:
        self._new.put(keep)

    def drain(self) -> None:
        """Writes what is left, tries once more what could not be written, and ends."""
        self._new.put(None)
        self._thread.join()

    def close(self) -> None:
        """The same, and closes the file."""
        self.drain()
        self._store.close()

    def _work(self) -> None:
        ended = False
        while not ended:
            ended = self._take()
            while self._held and self._write():
                pass

    def _take(self) -> bool:
        """What has come, into `_held`; waits for it, or until it is time to try again. Whether all has."""
        try:
            keep = self._new.get(timeout=_AGAIN_S if self._failing else None)
            while keep is not None:
                self._held.append(keep)
                keep = self._new.get_nowait()
        except queue.Empty:
            return False
        return True

    def _write(self, most: int = _AT_ONCE) -> bool:
        """A batch; whether it is done with now."""
        batch = [self._held[i] for i in range(min(most, len(self._held)))]
        try:
            self._store.write([change for keep in batch for change in keep.changes])
        except StoreError as error:
            self._fail(str(error))
            return False
        except ValueError as error:  # what it hangs on was lost while the disk was full
            if len(batch) > 1:
                return self._write(most=1)
            self._said(f"not kept: {error}")
        for _ in batch:
            self._held.popleft()
        if self._failing:
            self._failing = False
            self._said("the map is kept again" + (f"; {self._lost} changes were lost" if self._lost else ""))
        self._done(Kept(batch[-1].ticket))
        return True

    def _fail(self, reason: str) -> None:
        if not self._failing:
            self._failing = True
            self._said(f"{reason}; the edge goes on without it and tries again")
        while len(self._held) > _MOST:
            self._held.popleft()
            self._lost += 1
        self._done(Kept(self._held[-1].ticket))
