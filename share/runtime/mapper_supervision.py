"""Supervision of the mapper: its progress, recent troubles, and after its death the time and map of its
restart."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from share.errors import ShareError, StoreError, brief_reason
from share.mapping.map_changes import SaveObject, StoredMap, with_unknown_credentials
from share.protocol.edge import EdgeProtocol
from share.protocol.peer import RestoredRun, restored_runs
from share.runtime.map_reading import MapRead, read_map
from share.runtime.mapper_process import MapperReport, RestoreMap
from share.runtime.room_parts import RoomStore
from share.store.forgetting import damaged_copies
from share.store.salvage import ReadRows
from share.timing import Backoff

TROUBLE_SHOWN_S = 10.0  # how long the death of a process is shown as trouble
_SILENT_S = 5.0  # without a report of the mapper, which comes every second, it is stuck
_MAX_START_S = 60.0  # for a mapper to restore a map and to report
_MAX_SOLVE_S = 15.0  # for one solution; longer means the solver is stuck
_MAX_TRIES = 3  # mappers that may die while restoring one map, before it is set aside
_MAX_NAMES = 3  # of files, in a line


class MapperRestarts:
    """Restarts of one edge's mapper. `notify` reports what happens to the map file.

    A map that cannot be interpreted, or that `_MAX_TRIES` mappers died of while restoring it, is renamed,
    never deleted; the edge goes on with an empty one.
    """

    def __init__(
        self, store: RoomStore | None, known_m: float, notify: Callable[[str], None], has_keys: bool = False
    ) -> None:
        """known_m: see `share.protocol.peer.restored_runs`. has_keys: agents of this edge have keys."""
        self.store = store  # None also once a read-only map is no longer used
        self.objects: Sequence[SaveObject] | None = None  # of the room; None before the map was loaded
        self.forgotten: Mapping[str, int] | None = None  # as in `StoredMap`; None likewise
        self._known_m, self._notify, self._has_keys = known_m, notify, has_keys
        self._backoff = Backoff(time.monotonic_ns())
        self._is_restoring, self._restored_keyframes = False, 0
        self._has_begun = False  # the mapper runs, and restores the map
        self._tries = 0
        self._copies = [] if store is None else _copy_names(store.path)
        self._asides: list[str] = []  # a line each

    @property
    def writable(self) -> bool:
        return self.store is not None and self.store.writable

    @property
    def losses(self) -> list[str]:
        """Certain and possible losses of the map, a line each. A line stays until the edge is restarted
        without its cause, such as a damaged file that was kept beside the map."""
        lines = list(self._asides)
        if self.store is not None:
            name = self.store.path.name
            lines += [f"map {name}: {problem}" for problem in self.store.problems]
            if self.store.read_only_reason:  # a map that was closed at the end has none
                lines.append(f"map {name}: {self.store.read_only_reason}; nothing new is stored")
        said = "\n".join(lines)
        if earlier := [copy for copy in self._copies if not re.search(rf"{re.escape(copy)}\b", said)]:
            lines.append(f"earlier files are kept as {_listed(earlier)}: see what they hold, move them away")
        return lines

    @property
    def is_restoring(self) -> bool:
        """Whether the mapper has yet to restore the map."""
        return self._is_restoring

    def loading(self) -> dict[str, str]:
        """Return `loading` of edge.json while the mapper restores the map, else nothing."""
        return (
            {"loading": f"loading the map: {self._restored_keyframes} keyframes"}
            if self._is_restoring
            else {}
        )

    def record_begun(self) -> None:
        """Record that the mapper begins to restore the map. If it dies before, the machine lacks memory,
        files or threads, and the map is not to blame."""
        self._has_begun = True

    def record_restored(self) -> None:
        """Record that the mapper has restored the map."""
        self._is_restoring, self._tries = False, 0

    def record_death(self) -> float:
        """Record that the mapper died. Return the seconds until the next may start."""
        self._tries += self._is_restoring and self._has_begun
        return self.record_failure()

    def record_failure(self) -> float:
        """Record that no new session could be started. Return the seconds until the next try."""
        return self._backoff.record_failure(time.monotonic_ns())

    def keep(self, state_machine: EdgeProtocol) -> None:
        """Keep objects and forgotten runs of a session that ends now for the next one. What changes after its
        end is not saved."""
        self.objects = state_machine.room.kept_objects()
        self.forgotten = state_machine.forgotten_next_keyframes()

    @property
    def store_to_read(self) -> RoomStore | None:
        """The map file, if the next `load_map` needs its rows."""
        return None if self._tries >= _MAX_TRIES else self.store

    def load_map(self, read: MapRead | None = None) -> tuple[RestoreMap | None, list[RestoredRun]]:
        """Return the map for the mapper, and the agents' runs for a new session. read: of `store_to_read`;
        None: it is read now. Raises StoreError if the file is unreadable now."""
        self._is_restoring = self._has_begun = False
        if self._tries >= _MAX_TRIES:
            self._set_aside(f"{self._tries} mappers in a row have died while restoring it")
            read = None
        if self.store is None:
            return None, []
        try:
            rows, outline = self._found(read or read_map(self.store))
            restore = RestoreMap(rows, self._has_keys)
            outline = with_unknown_credentials(outline) if self._has_keys else outline
            self.forgotten = outline.forgotten if self.forgotten is None else self.forgotten
            known = restored_runs(outline, self._known_m)
            self.objects = outline.objects if self.objects is None else self.objects
        except ShareError:
            raise
        except (MemoryError, OSError) as error:  # of the machine, not of the file
            raise StoreError(f"the map file cannot be read now: {brief_reason(error)}") from None
        except Exception as error:  # no content of a file may end the edge
            self._set_aside(f"{type(error).__name__}: {error}")
            return None, []
        self._restored_keyframes = len(restore.rows.tables["keyframe"])
        self._is_restoring = self._restored_keyframes > 0
        return restore, known

    def _found(self, read: MapRead) -> tuple[ReadRows, StoredMap]:
        """Return what was read; say what is missing since the file was found damaged now. Raises what reading
        it has raised."""
        for problem in read.new_problems:
            self._notify(problem)
        if read.error is not None:
            raise read.error
        assert read.found is not None
        return read.found

    def _set_aside(self, reason: str) -> None:
        if self.store is None:
            return
        if not self.store.writable:
            self.store = None
            text = f"the map file is no longer used: {reason}; nothing is saved"
        else:
            try:
                renamed = self.store.set_aside(self.forgotten or {})
            finally:  # it may be renamed, and the new one still fail
                self._copies = _copy_names(self.store.path)
            self.forgotten = self.store.outline().forgotten  # of the file too, which may not have been read
            text = f"the map file is renamed to {renamed.name}: {reason}; a new one is started"
        self._tries = 0
        self._asides.append(text)
        self._notify(text)


class MapperProgress:
    """The newest report of one mapper, {} before the first, and what follows from it about its progress.

    start_delay_s: until it starts."""

    def __init__(self, start_delay_s: float = 0.0) -> None:
        self._silent_from_s = time.monotonic() + start_delay_s + _MAX_START_S
        self.report: dict[str, Any] = {}
        self.is_idle = False  # the mapper has nothing to do
        self._reported_s: float | None = None  # monotonic, as below
        self._solving_s = 0.0  # duration of the current solve at that time
        self._solved_s: float | None = None

    def record(self, report: MapperReport) -> None:
        self._reported_s, self._solving_s = time.monotonic(), report.solving_s
        self.is_idle = report.is_idle
        if _solve_count(report.report) > _solve_count(self.report):
            self._solved_s = self._reported_s
        self.report = report.report

    def last_solve(self) -> dict[str, float]:
        """Return {"last_solve_s": time since the last solution}, {} before the first."""
        return {} if self._solved_s is None else {"last_solve_s": round(time.monotonic() - self._solved_s, 3)}

    def stall(self) -> str | None:
        """Return which process makes no progress, None if both do."""
        if self._reported_s is None:
            late_s = time.monotonic() - self._silent_from_s
            silent = f"the mapper has not reported for {late_s + _MAX_START_S:.0f} s since it was to start"
            return f"{silent}: no corrections meanwhile" if late_s > 0.0 else None
        if (silent_s := time.monotonic() - self._reported_s) > _SILENT_S:
            return f"the mapper has not answered for {silent_s:.0f} s: no corrections meanwhile"
        if (solving_s := self._solving_s + silent_s) > _MAX_SOLVE_S:
            return f"the solver has worked on one solution for {solving_s:.0f} s: no corrections meanwhile"
        return None


def _copy_names(path: Path) -> list[str]:
    return [copy.name for copy in damaged_copies(path)]


def _listed(names: list[str]) -> str:
    further = len(names) - _MAX_NAMES
    return ", ".join(names[:_MAX_NAMES]) + (f" and {further} more" if further > 0 else "")


def _solve_count(report: Mapping[str, Any]) -> int:
    return int(report.get("solve_ms", {}).get("n", 0))


class RecentTroubles:
    """Lines that are shown as trouble for a while."""

    def __init__(self) -> None:
        self._until_s: dict[str, float] = {}  # monotonic

    def add(self, text: str, duration_s: float = TROUBLE_SHOWN_S) -> None:
        self._until_s[text] = time.monotonic() + duration_s

    def current(self) -> list[str]:
        now_s = time.monotonic()
        self._until_s = {text: until_s for text, until_s in self._until_s.items() if now_s < until_s}
        return list(self._until_s)
