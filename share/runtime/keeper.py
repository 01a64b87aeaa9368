"""The thread that writes the map to its file: the edge goes on while the disk works, or does not."""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from share.errors import StoreError
from share.mapping.changes import KeepPoses
from share.protocol.edge_events import Keep, Kept
from share.store.map_store import MapStore

_AGAIN_S = 1.0  # after a write that failed
_SLOW_S = 5.0  # for one write: from then on it is said
_AT_ONCE = 64  # in one commit
_PATIENCE_S = 5.0  # for what is left at the end
_NOT_ACKNOWLEDGED = "keyframes are not acknowledged"
_NOT_IN = "are not in the map's file"


class Keeper:
    """`keep` what is to be safe; `done` is told once it is, `said` what goes wrong, from the thread.

    Only what is in the file is `Kept`. While it cannot be written, that is said, changes are held in memory
    and tried again. They are few: an agent sends no more than its window without an acknowledgement, the edge
    takes in a bounded number (`share.protocol.edge`), loops come of keyframes alone, and of solutions only
    the newest is held."""

    def __init__(self, store: MapStore, done: Callable[[Kept], None], said: Callable[[str], None]) -> None:
        self._store, self._done, self._said = store, done, said
        self._new: queue.SimpleQueue[Keep | None] = queue.SimpleQueue()
        self._held: deque[Keep] = deque()
        self._failing: str | None = None
        self._writing_since: float | None = None
        self._thread = threading.Thread(target=self._work, name="keeper", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str | None:
        """Why nothing is kept at the moment, if so. From any thread."""
        if self._failing is not None:
            return f"{self._failing}; {_NOT_ACKNOWLEDGED}"
        since = self._writing_since
        took_s = 0.0 if since is None else time.monotonic() - since
        if took_s < _SLOW_S:
            return None
        return f"the map's disk has been writing for {took_s:.0f} s; {_NOT_ACKNOWLEDGED}"

    @property
    def held(self) -> int:
        """Changes that wait because the file cannot be written."""
        return sum(len(keep.changes) for keep in tuple(self._held))

    def keep(self, keep: Keep) -> None:
        self._new.put(keep)

    def drain(self, patience_s: float) -> bool:
        """Writes what is left, tries once more what could not be written, says what is not kept, and ends.
        False: the disk has not answered for so long. May be repeated."""
        self._new.put(None)
        self._thread.join(patience_s)
        if self._thread.is_alive():
            return False
        if left := self.held:
            self._said(f"{left} changes {_NOT_IN}; none of their keyframes was acknowledged")
        return True

    def close(self) -> str | None:
        """The same, and closes the file. What is wrong if not all is in it, or nobody knows."""
        if not self.drain(_PATIENCE_S):
            self._store.abandon()
            return "the map's disk does not answer: what was not acknowledged may not be in its file"
        self._store.close()
        return f"{self._failing}: {self.held} changes {_NOT_IN}" if self.held else None

    def _work(self) -> None:
        ended = False
        while not ended:
            ended = self._take()
            while self._held and self._write():
                pass

    def _take(self) -> bool:
        """What has come, into `_held`; waits for it, or until it is time to try again. Whether all has."""
        failing, until = self._failing is not None, time.monotonic() + _AGAIN_S
        while True:
            wait = failing or not self._held
            try:
                keep = self._new.get(wait, max(0.0, until - time.monotonic()) if failing else None)
            except queue.Empty:
                return False
            if keep is None:
                return True
            self._held.append(keep)

    def _write(self, most: int = _AT_ONCE) -> bool:
        """A batch; whether it is done with now."""
        if self._failing is not None:
            self._held = newest_poses_only(self._held)
        batch = [self._held[i] for i in range(min(most, len(self._held)))]
        self._writing_since = time.monotonic()
        try:
            self._store.write([change for keep in batch for change in keep.changes])
        except StoreError as error:
            self._fail(str(error))
            return False
        except Exception as error:  # not the disk's fault but a change's: it alone is left out
            if len(batch) > 1:
                return self._write(most=1)
            self._said(f"a change cannot be kept and is left out: {type(error).__name__}: {error}")
        finally:
            self._writing_since = None
        for _ in batch:
            self._held.popleft()
        if self._failing is not None:
            self._failing = None
            self._said("the map is kept again")
        self._done(Kept(batch[-1].ticket))
        return True

    def _fail(self, reason: str) -> None:
        if self._failing != reason:
            self._failing = reason
            self._said(f"{reason}; {_NOT_ACKNOWLEDGED} until it can")


def newest_poses_only(held: deque[Keep]) -> deque[Keep]:
    """The same changes but for solutions that a later one takes the place of. Tickets stay."""
    out: deque[Keep] = deque()
    found = False
    for keep in reversed(held):
        changes = []
        for change in reversed(keep.changes):
            if isinstance(change, KeepPoses):
                if found:
                    continue
                found = True
            changes.append(change)
        out.appendleft(replace(keep, changes=tuple(reversed(changes))))
    return out
