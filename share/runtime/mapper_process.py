"""The mapper's process: adds keyframes and looks them up; a child process solves the pose graph."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from share.config import Config
from share.mapping.corrections import MapEvent
from share.mapping.graph.solver import PoseGraphSolver
from share.mapping.map_changes import StoredMap, with_unknown_credentials
from share.mapping.mapper import Mapper
from share.mapping.places import FindKeyframe, PlaceNews, PlaceNewsLog
from share.mapping.steps import SolveStep
from share.protocol.edge_events import AddKeyframe, AddRun, DropRun, MapperResult, SetCredential, SetPresence
from share.protocol.keyframe_intake import FairQueue
from share.runtime.keyframe_handover import KeyframesAdded
from share.runtime.worker_process import END, Inbox, WorkerProcess
from share.startup import HeapTrimmer
from share.store.keyframe_archive import KeyframeArchive
from share.store.loading import decode_map
from share.store.salvage import ReadRows
from share.timing import Backoff

T = TypeVar("T")

_REPORT_S = 1.0  # period of reports
_SAVE_POSES_S = 5.0  # period of saving all poses
_EXPIRE_S = 60.0  # period of forgetting old keyframes


@dataclass(frozen=True)
class StartMapper:
    """First message to the mapper. map_file: where images and views are read. has_other_rooms: a directory
    of places wants to know what is in the map."""

    settings: Config
    map_file: Path | None = None
    has_other_rooms: bool = False

    def mapper(self) -> Mapper:
        archive = None if self.map_file is None else KeyframeArchive(self.map_file)
        return Mapper(self.settings, archive, PlaceNewsLog() if self.has_other_rooms else None)


@dataclass(frozen=True, eq=False)
class RestoreMap:
    """Second message to the mapper, if any: the map of an earlier session, as rows of its file.

    has_keys: agents of this edge have keys.
    """

    rows: ReadRows
    has_keys: bool = False

    @property
    def stored_map(self) -> StoredMap:
        """Decoding takes seconds for a large map, so the mapper does it."""
        decoded = decode_map(self.rows.copy())
        return with_unknown_credentials(decoded) if self.has_keys else decoded


@dataclass(frozen=True)
class MapperReport:
    """The mapper's report, every second and at the end. solving_s: duration of the current solve so far.
    is_idle: it has nothing to do."""

    report: dict[str, Any]
    solving_s: float = 0.0
    is_idle: bool = False


@dataclass(frozen=True, eq=False)
class PlaceNewsBatch:
    """What a directory of places needs to know of the map."""

    news: tuple[PlaceNews, ...]


@dataclass(frozen=True)
class RestoreBegun:
    """The mapper and its solver run, and restore the map: a death from now on may be caused by it."""


@dataclass(frozen=True)
class MapRestored:
    """All of `RestoreMap` is restored: a later death is not caused by the file's contents."""


@dataclass(frozen=True)
class SolverDied:
    """The solver's process has died. text: how, and when it restarts, for the event log."""

    text: str


@dataclass(frozen=True)
class _SolverProcessDied:
    """To the mapper's own inbox: the solver's process has died."""

    reason: str


@dataclass(frozen=True, eq=False)
class _SolveResult:
    result: object  # of the step, or the exception that it raised
    ms: float


def start_mapper_process(
    on_answer: Callable[[Any], None], on_death: Callable[[str], None], start_delay_s: float | None = 0.0
) -> WorkerProcess:
    """Return a mapper's process, which takes a StartMapper first. start_delay_s: see `WorkerProcess`."""
    return WorkerProcess("mapping", run_mapper, (), on_answer, on_death, start_delay_s)


def run_mapper(inbox: Inbox, answer: Callable[[Any], None]) -> None:
    """Work of a `WorkerProcess`: takes StartMapper, then RestoreMap, AddRun, SetCredential, SetPresence,
    AddKeyframe, DropRun and FindKeyframe until END; answers KeyframesAdded, MapperResult, MapperReport,
    RestoreBegun, MapRestored, SolverDied and KeyframeSought, and where there are other rooms
    PlaceNewsBatch."""
    solver = _start_solver(inbox, 0.0)
    if isinstance(start := inbox.get(), StartMapper):
        _MapperProcess(inbox, answer, start.mapper(), solver).run()
    else:  # it was not needed, or its solver has died
        solver.close()


class _MapperProcess:
    def __init__(
        self, inbox: Inbox, answer: Callable[[Any], None], mapper: Mapper, solver: WorkerProcess
    ) -> None:
        self._inbox, self._answer, self._mapper, self._solver = inbox, answer, mapper, solver
        self._backoff = Backoff(time.monotonic_ns())
        self._is_restoring = False
        self._running_solve: SolveStep | None = None
        self._solve_start_s = 0.0
        self._keyframe_queue = FairQueue[AddKeyframe]()
        self._map_events: list[MapEvent] = []
        self._report_due_s = self._poses_due_s = self._expire_due_s = 0.0  # monotonic
        self._has_new_poses = False
        self._heap = HeapTrimmer()
        self._is_idle = self._is_ended = False

    def run(self) -> None:
        try:
            self._loop()
        finally:  # a process does not end while a child of it runs
            self._solver.close()
        self._answer(
            MapperResult(
                tuple(self._map_events), (*self._mapper.take_changes(), self._mapper.current_poses())
            )
        )
        self._answer(MapperReport(self._mapper.report()))

    def _loop(self) -> None:
        step = None
        while not self._is_ended:
            has_work = step is not None or self._keyframe_queue or self._mapper.has_place_answers
            for message in self._receive(wait=not has_work):
                self._handle(message)
            self._expire()
            self._add_keyframes()
            self._send_to_solver()
            self._publish()
            step = self._guarded("lookup", self._mapper.next_lookup, None)
            self._is_idle = step is None and self._running_solve is None
            if self._is_restoring:  # the mapper has read all restored views by now
                self._is_restoring = False
                self._answer(MapRestored())
            if step is not None:
                self._map_events += self._mapper.finish_step(step, *_run_timed(step.run))

    def _receive(self, wait: bool) -> Iterator[Any]:
        """Yield all messages in the inbox; if `wait`, wait up to _REPORT_S for the first."""
        try:
            yield self._inbox.get(wait, _REPORT_S if wait else None)
            while True:
                yield self._inbox.get_nowait()
        except queue.Empty:
            return

    def _handle(self, message: Any) -> None:
        match message:
            case RestoreMap():
                self._answer(RestoreBegun())
                self._mapper.restore(message.stored_map)
                self._is_restoring, self._expire_due_s = True, 0.0
            case AddRun():
                self._mapper.add_run(message.key, message.hello, message.credential)
            case SetCredential():
                self._mapper.set_credential(message.key, message.credential)
            case SetPresence():
                self._mapper.set_present(message.key, message.is_present)
            case DropRun():
                self._guarded("forget", partial(self._mapper.remove_run, message.key), None)
            case AddKeyframe():
                self._keyframe_queue.add(self._mapper.agent_name(message.key), message)
            case FindKeyframe():
                self._mapper.search.add(message)
            case _SolveResult():
                self._finish_solve(message.result, message.ms)
            case _SolverProcessDied():
                self._restart_solver(message.reason)
            case _ if message is END:
                self._is_ended = True

    def _expire(self) -> None:
        """Forget keyframes that are too old: at once after a restart, then every minute."""
        if time.monotonic() >= self._expire_due_s:
            self._expire_due_s = time.monotonic() + _EXPIRE_S
            self._map_events += self._guarded("forget", partial(self._mapper.expire, time.time()), [])

    def _add_keyframes(self) -> None:
        """Add waiting keyframes as far as the queue's time budget allows; at the end all of them."""
        start_s, added = time.perf_counter(), 0
        while True:
            spent_ms = 0.0 if self._is_ended else 1e3 * (time.perf_counter() - start_s)
            if (add := self._keyframe_queue.take_next(spent_ms)) is None:
                break
            added += 1
            work = partial(self._mapper.add_keyframe, add.key, add.keyframe, add.is_over_rate)
            self._map_events += self._guarded("keyframe", work, [], add.key)
        if added:
            self._answer(KeyframesAdded(added))

    def _guarded(self, step: str, work: Callable[[], T], default: T, agent: str | None = None) -> T:
        """Return `work()`, or `default` if it fails. A failure must not end the process: the map file would
        bring it back at each restart."""
        try:
            return work()
        except Exception as error:
            self._map_events += self._mapper.report_failure(step, error, agent)
            return default

    def _send_to_solver(self) -> None:
        step = self._guarded("solve", self._mapper.next_solve, None)
        self._map_events += self._mapper.take_events()
        if step is not None:
            self._running_solve, self._solve_start_s = step, time.monotonic()
            self._solver.send(step)

    def _finish_solve(self, result: object, ms: float) -> None:
        step, self._running_solve = self._running_solve, None
        self._has_new_poses = True
        if step is not None:
            self._map_events += self._mapper.finish_step(step, result, ms)

    def _restart_solver(self, reason: str) -> None:
        """Start a new solver; the current solution is lost and the whole graph is sent again."""
        self._solver.close()
        pause_s = self._backoff.record_failure(time.monotonic_ns())
        self._answer(SolverDied(f"its process {reason}; restarted in {pause_s:g} s"))
        self._solver = _start_solver(self._inbox, pause_s)
        self._mapper.reset_solver()
        self._finish_solve(RuntimeError(f"the solver {reason}"), 0.0)

    def _publish(self) -> None:
        for answer in self._mapper.search.take_answers():
            self._answer(answer)
        if news := self._mapper.take_place_news():
            self._answer(PlaceNewsBatch(news))
        changes = self._mapper.take_changes()
        if self._has_new_poses and time.monotonic() >= self._poses_due_s:
            self._has_new_poses, self._poses_due_s = False, time.monotonic() + _SAVE_POSES_S
            changes = (*changes, self._mapper.current_poses())
        emptied = self._mapper.take_empty_runs()
        if self._map_events or changes or emptied:
            self._answer(MapperResult(tuple(self._map_events), changes, emptied))
            self._map_events = []
        if time.monotonic() >= self._report_due_s:
            self._report_due_s = time.monotonic() + _REPORT_S
            solving_s = 0.0 if self._running_solve is None else time.monotonic() - self._solve_start_s
            self._answer(MapperReport(self._mapper.report(), solving_s, self._is_idle))
            self._heap.trim_if_due(time.monotonic())


def _start_solver(mapper_inbox: Inbox, start_delay_s: float) -> WorkerProcess:
    def post_death(reason: str) -> None:  # from another thread
        mapper_inbox.put(_SolverProcessDied(reason))

    return WorkerProcess("solver", run_solver, (), mapper_inbox.put, post_death, start_delay_s)


def run_solver(inbox: Inbox, answer: Callable[[Any], None]) -> None:
    """Work of a `WorkerProcess`: takes a SolveStep, answers its _SolveResult, until END."""
    solver, heap = PoseGraphSolver(), HeapTrimmer()
    while (step := inbox.get()) is not END:
        answer(_SolveResult(*_run_timed(partial(step.run, solver))))
        heap.trim_if_due(time.monotonic())


def _run_timed(work: Callable[[], object]) -> tuple[object, float]:
    start_s = time.perf_counter()
    result: object
    try:
        result = work()
    except Exception as error:  # a failed step costs its keyframe, not the edge
        result = error
    return result, 1e3 * (time.perf_counter() - start_s)
