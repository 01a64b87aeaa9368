"""The thread that writes the map file, so that the edge never waits for the disk."""

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

_RETRY_S = 1.0  # after a failed write
_SLOW_WRITE_S = 5.0  # duration of one write from which it is reported as trouble
_MAX_PER_COMMIT = 64  # requests
_TIMEOUT_S = 5.0  # for the remaining writes at the end
_NOT_ACKNOWLEDGED = "keyframes are not acknowledged"
_NOT_IN_FILE = "are not in the map file"


class MapWriter:
    """Writes submitted changes in order. Calls `on_saved` once they are in the file and `notify` on errors,
    both from the thread.

    While the file cannot be written, changes are held in memory and retried. Their number is bounded: an
    agent sends at most its window without an acknowledgement, the edge accepts a bounded number
    (`share.protocol.edge`), loops arise from keyframes only, and of solutions only the newest is held.
    """

    def __init__(
        self, store: MapStore, on_saved: Callable[[ChangesSaved], None], notify: Callable[[str], None]
    ) -> None:
        self._store, self._on_saved, self._notify = store, on_saved, notify
        self._incoming: queue.SimpleQueue[SaveChanges | None] = queue.SimpleQueue()
        self._pending: deque[SaveChanges] = deque()
        self._failure: str | None = None
        self._writing_since: float | None = None
        self._thread = threading.Thread(target=self._run, name="map writer", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str | None:
        """Why changes cannot be saved now, None if they can. Safe from any thread."""
        if self._failure is not None:
            return f"{self._failure}; {_NOT_ACKNOWLEDGED}"
        since = self._writing_since
        took_s = 0.0 if since is None else time.monotonic() - since
        if took_s < _SLOW_WRITE_S:
            return None
        return f"a write to the map file has taken {took_s:.0f} s so far; {_NOT_ACKNOWLEDGED}"

    @property
    def pending_changes(self) -> int:
        """Number of changes that are not in the file yet."""
        return sum(len(keep.changes) for keep in tuple(self._pending))

    def submit(self, request: SaveChanges) -> None:
        self._incoming.put(request)

    def drain(self, timeout_s: float) -> bool:
        """Write the remaining changes, retry failed ones once, report unsaved ones, and end the thread.
        Return False if that takes longer than `timeout_s`. May be repeated."""
        self._incoming.put(None)
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            return False
        if unsaved := self.pending_changes:
            self._notify(f"{unsaved} changes {_NOT_IN_FILE}; none of their keyframes was acknowledged")
        return True

    def close(self) -> str | None:
        """Drain and close the file. Return why the file is or may be incomplete, None if it is complete."""
        if not self.drain(_TIMEOUT_S):
            self._store.abandon()
            return "the disk of the map file does not answer: keyframes not acknowledged may be missing"
        self._store.close()
        unsaved = self.pending_changes
        return f"{self._failure}: {unsaved} changes {_NOT_IN_FILE}" if unsaved else None

    def _run(self) -> None:
        ended = False
        while not ended:
            ended = self._collect()
            while self._pending and self._write():
                pass

    def _collect(self) -> bool:
        """Move new requests to `_pending`; wait for one, or until a retry is due. Return True at the end."""
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
        """Write the next batch. Return False if the file cannot be written."""
        if self._failure is not None:
            self._pending = newest_poses_only(self._pending)
        batch = [self._pending[i] for i in range(min(max_requests, len(self._pending)))]
        self._writing_since = time.monotonic()
        try:
            self._store.write([change for keep in batch for change in keep.changes])
        except StoreError as error:
            self._notify_failure(str(error))
            return False
        except Exception as error:  # a change is faulty, not the disk: skip only that change
            if len(batch) > 1:
                return self._write(max_requests=1)
            self._notify(f"a change cannot be saved and is skipped: {type(error).__name__}: {error}")
        finally:
            self._writing_since = None
        for _ in batch:
            self._pending.popleft()
        if self._failure is not None:
            self._failure = None
            self._notify("the map is saved again")
        self._on_saved(ChangesSaved(batch[-1].ticket))
        return True

    def _notify_failure(self, reason: str) -> None:
        if self._failure != reason:
            self._failure = reason
            self._notify(f"{reason}; {_NOT_ACKNOWLEDGED} until a write succeeds")


def newest_poses_only(pending: deque[SaveChanges]) -> deque[SaveChanges]:
    """Return the requests without solutions that a later one replaces. Tickets stay."""
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
