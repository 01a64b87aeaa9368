"""The thread that writes the map to its file: the edge goes on while the disk works, or does not."""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from share.errors import StoreError
from share.mapping.map_changes import SavePoses
from share.protocol.edge_events import ChangesSaved, SaveChanges
from share.store.map_store import MapStore

_RETRY_S = 1.0  # after a write that failed
_SLOW_WRITE_S = 5.0  # for one write: from then on it is said
_MAX_PER_COMMIT = 64  # in one commit
_TIMEOUT_S = 5.0  # for what is left at the end
_NOT_ACKNOWLEDGED = "keyframes are not acknowledged"
_NOT_IN_FILE = "are not in the map's file"


class MapWriter:
    """`keep` what is to be safe; `on_saved` is told once it is, `notify` what goes wrong, from the thread.

    Only what is in the file is `ChangesSaved`. While it cannot be written, that is said, changes are held in
    memory
    and tried again. They are few: an agent sends no more than its window without an acknowledgement, the edge
    takes in a bounded number (`share.protocol.edge`), loops come of keyframes alone, and of solutions only
    the newest is held."""

    def __init__(
        self, store: MapStore, on_saved: Callable[[ChangesSaved], None], notify: Callable[[str], None]
    ) -> None:
        self._store, self._on_saved, self._notify = store, on_saved, notify
        self._incoming: queue.SimpleQueue[SaveChanges | None] = queue.SimpleQueue()
        self._pending: deque[SaveChanges] = deque()
        self._failure: str | None = None
        self._writing_since: float | None = None
        self._thread = threading.Thread(target=self._run, name="keeper", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str | None:
        """Why nothing is kept at the moment, if so. From any thread."""
        if self._failure is not None:
            return f"{self._failure}; {_NOT_ACKNOWLEDGED}"
        since = self._writing_since
        took_s = 0.0 if since is None else time.monotonic() - since
        if took_s < _SLOW_WRITE_S:
            return None
        return f"the map's disk has been writing for {took_s:.0f} s; {_NOT_ACKNOWLEDGED}"

    @property
    def pending_changes(self) -> int:
        """Changes that wait because the file cannot be written."""
        return sum(len(keep.changes) for keep in tuple(self._pending))

    def submit(self, request: SaveChanges) -> None:
        self._incoming.put(request)

    def drain(self, timeout_s: float) -> bool:
        """Writes what is left, tries once more what could not be written, says what is not kept, and ends.
        False: the disk has not answered for so long. May be repeated."""
        self._incoming.put(None)
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            return False
        if unsaved := self.pending_changes:
            self._notify(f"{unsaved} changes {_NOT_IN_FILE}; none of their keyframes was acknowledged")
        return True

    def close(self) -> str | None:
        """The same, and closes the file. What is wrong if not all is in it, or nobody knows."""
        if not self.drain(_TIMEOUT_S):
            self._store.abandon()
            return "the map's disk does not answer: what was not acknowledged may not be in its file"
        self._store.close()
        return (
            f"{self._failure}: {self.pending_changes} changes {_NOT_IN_FILE}"
            if self.pending_changes
            else None
        )

    def _run(self) -> None:
        ended = False
        while not ended:
            ended = self._collect()
            while self._pending and self._write():
                pass

    def _collect(self) -> bool:
        """What has come, into `_pending`; waits for it, or until it is time to try again. Whether all has."""
        failing, until = self._failure is not None, time.monotonic() + _RETRY_S
        while True:
            wait = failing or not self._pending
            try:
                request = self._incoming.get(wait, max(0.0, until - time.monotonic()) if failing else None)
            except queue.Empty:
                return False
            if request is None:
                return True
            self._pending.append(request)

    def _write(self, max_requests: int = _MAX_PER_COMMIT) -> bool:
        """A batch; whether it is done with now."""
        if self._failure is not None:
            self._pending = newest_poses_only(self._pending)
        batch = [self._pending[i] for i in range(min(max_requests, len(self._pending)))]
        self._writing_since = time.monotonic()
        try:
            self._store.write([change for keep in batch for change in keep.changes])
        except StoreError as error:
            self._notify_failure(str(error))
            return False
        except Exception as error:  # not the disk's fault but a change's: it alone is left out
            if len(batch) > 1:
                return self._write(max_requests=1)
            self._notify(f"a change cannot be kept and is left out: {type(error).__name__}: {error}")
        finally:
            self._writing_since = None
        for _ in batch:
            self._pending.popleft()
        if self._failure is not None:
            self._failure = None
            self._notify("the map is kept again")
        self._on_saved(ChangesSaved(batch[-1].ticket))
        return True

    def _notify_failure(self, reason: str) -> None:
        if self._failure != reason:
            self._failure = reason
            self._notify(f"{reason}; {_NOT_ACKNOWLEDGED} until it can")


def newest_poses_only(pending: deque[SaveChanges]) -> deque[SaveChanges]:
    """The same changes but for solutions that a later one takes the place of. Tickets stay."""
    out: deque[SaveChanges] = deque()
    has_poses = False
    for request in reversed(pending):
        changes = []
        for change in reversed(request.changes):
            if isinstance(change, SavePoses):
                if has_poses:
                    continue
                has_poses = True
            changes.append(change)
        out.appendleft(replace(request, changes=tuple(reversed(changes))))
    return out
