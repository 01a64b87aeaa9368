"""The thread that writes the map file, so that the edge never waits for the disk."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from share.errors import ShareError
from share.mapping.map_changes import SavePoses
from share.protocol.edge_events import ChangesSaved, SaveChanges
from share.runtime.output_writer import JobThread
from share.runtime.room_parts import RoomStore

_RETRY_S = 1.0  # after a failed write
_SLOW_WRITE_S = 5.0  # duration of one write from which it is reported as trouble
_MAX_PER_COMMIT = 64  # requests
CLOSE_S = 5.0  # for the remaining writes at the end
_NOT_ACKNOWLEDGED = "keyframes are not acknowledged"
_NOT_IN_FILE = "are not in the map file"


class MapWriter:
    """Writes submitted changes in order. Calls `on_saved` once they are in the file and `notify` on errors,
    both from the thread.

    While the file cannot be written, changes are held in memory and retried. Their number is bounded: an
    agent sends at most its window without an acknowledgement, the edge accepts a bounded number
    (`share.protocol.edge`), of objects too (`share.protocol.object_service`), loops arise from keyframes
    only, and of solutions only the newest is held.
    """

    def __init__(
        self, store: RoomStore, on_saved: Callable[[ChangesSaved], None], notify: Callable[[str], None]
    ) -> None:
        self._store, self._on_saved, self._notify = store, on_saved, notify
        self._pending: deque[SaveChanges] = deque()  # of the thread
        self._failure: str | None = None
        self._retry_due_s = 0.0  # monotonic
        self._thread = JobThread("map writer", on_idle=self._write_pending)

    @property
    def trouble(self) -> str | None:
        """Why changes cannot be saved now, None if they can. Safe from any thread."""
        if self._failure is not None:
            return f"{self._failure}; {_NOT_ACKNOWLEDGED}"
        if (took_s := self._thread.busy_s) < _SLOW_WRITE_S:
            return None
        return f"a write to the map file has taken {took_s:.0f} s so far; {_NOT_ACKNOWLEDGED}"

    @property
    def pending_changes(self) -> int:
        """Number of changes that are not in the file yet."""
        return sum(len(keep.changes) for keep in tuple(self._pending))

    def submit(self, request: SaveChanges) -> None:
        self._thread.submit(lambda: self._pending.append(request))

    def drain(self, timeout_s: float) -> bool:
        """Write the remaining changes, retry failed ones once, report unsaved ones, and end the thread.
        Return False if that takes longer than `timeout_s`. May be repeated."""
        self._thread.submit(self._write_all)
        if not self._thread.stop(timeout_s):
            return False
        if unsaved := self.pending_changes:
            self._notify(f"{unsaved} changes {_NOT_IN_FILE}; none of their keyframes was acknowledged")
        return True

    def close(self, timeout_s: float = CLOSE_S) -> str | None:
        """Drain and close the file; abandon it where that takes longer than `timeout_s`. Return why the
        file is or may be incomplete, None if it is complete."""
        if not self.drain(timeout_s):
            self._store.abandon()
            return "the disk of the map file does not answer: keyframes not acknowledged may be missing"
        self._store.close()
        unsaved = self.pending_changes
        return f"{self._failure}: {unsaved} changes {_NOT_IN_FILE}" if unsaved else None

    def _write_pending(self) -> float | None:
        """Write a batch if there is one and no failed write waits for its retry. Return the seconds until
        there is more to do, None if all is written."""
        wait_s = 0.0 if self._failure is None else self._retry_due_s - time.monotonic()
        if self._pending and wait_s <= 0.0:
            wait_s = 0.0 if self._write() else _RETRY_S
        return max(wait_s, 0.0) if self._pending else None

    def _write_all(self) -> None:
        while self._pending and self._write():
            pass

    def _write(self, max_requests: int = _MAX_PER_COMMIT) -> bool:
        """Write the next batch. Return False if the file cannot be written."""
        if self._failure is not None:
            self._pending = newest_poses_only(self._pending)
        known_problems = self._store.problems
        batch = [self._pending[i] for i in range(min(max_requests, len(self._pending)))]
        try:
            self._store.write([change for keep in batch for change in keep.changes])
        except ShareError as error:
            self._notify_failure(str(error))
            return False
        except Exception as error:  # a change is faulty, not the disk: skip only that change
            if len(batch) > 1:
                return self._write(max_requests=1)
            self._notify(f"a change cannot be saved and is skipped: {type(error).__name__}: {error}")
        for problem in self._store.problems[len(known_problems) :]:
            self._notify(problem)
        for _ in batch:
            self._pending.popleft()
        if self._failure is not None:
            self._failure = None
            self._notify("the map is saved again")
        self._on_saved(ChangesSaved(batch[-1].ticket))
        return True

    def _notify_failure(self, reason: str) -> None:
        self._retry_due_s = time.monotonic() + _RETRY_S
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
