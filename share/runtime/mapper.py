"""The mapper's process: it looks keyframes up itself, and has a process of its own for the pose graph."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from share.config import Config, GraphConfig
from share.mapping.changes import Kept
from share.mapping.graph.solver import Solver
from share.mapping.mapper import Mapper
from share.mapping.steps import Finding, Solve
from share.protocol.edge_events import Add, Forget, Found, Join, Present, Speaks
from share.protocol.edge_records import Turns
from share.rates import Backoff
from share.runtime.worker import END, Companion, Inbox
from share.startup import Heap

T = TypeVar("T")

_REPORT_S = 1.0
_POSES_S = 5.0  # between two keepings of where everything lies


@dataclass(frozen=True, eq=False)
class Restore:
    """To the mapper, before anything else: what an earlier life of the edge knew."""

    kept: Kept


@dataclass(frozen=True)
class Mapped:
    """The mapper's report, every second, and at the end. solving_s: for how long the solver has been at what
    it does now."""

    report: dict[str, Any]
    solving_s: float = 0.0


@dataclass(frozen=True)
class Restored:
    """Everything of `Restore` has been taken in: it was not what is in the file that a later death is of."""


@dataclass(frozen=True)
class SolverLost:
    """For a person: how it ended, and when the next begins."""

    text: str


@dataclass(frozen=True)
class _Lost:
    """The solver's process has died."""

    how: str


@dataclass(frozen=True, eq=False)
class _Solved:
    result: object
    ms: float


def map_all(inbox: Inbox, answer: Callable[[Any], None], settings: Config) -> None:
    """For a `Companion`: takes Restore, Join, Speaks, Present, Add and Forget, until END; answers Found,
    Mapped, Restored and SolverLost."""
    _Mapping(inbox, answer, settings).go()


class _Mapping:
    def __init__(self, inbox: Inbox, answer: Callable[[Any], None], settings: Config) -> None:
        self._inbox, self._answer, self._settings = inbox, answer, settings
        self._mapper = Mapper(settings)
        self._backoff = Backoff(time.monotonic_ns())
        self._solver = self._new_solver(0.0)
        self._is_restoring = False
        self._solving: Solve | None = None
        self._solving_since = 0.0
        self._turns = Turns[Add]()
        self._findings: list[Finding] = []
        self._report_at = self._poses_at = 0.0
        self._is_moved = False
        self._heap = Heap()
        self._ended = False

    def go(self) -> None:
        try:
            self._work()
        finally:  # whatever ended us: a process does not end while one of its own goes on
            self._solver.close()
        self._answer(Found(tuple(self._findings), (*self._mapper.take_changes(), self._mapper.poses())))
        self._answer(Mapped(self._mapper.report()))

    def _work(self) -> None:
        look = None
        while not self._ended:
            for message in self._arrived(wait=look is None and not self._turns):
                self._hear(message)
            self._take_in()
            self._give_solver()
            self._tell()
            look = self._guarded("place", self._mapper.next_look, None)
            if self._is_restoring:  # the views have been gone through by now
                self._is_restoring = False
                self._answer(Restored())
            if look is not None:
                self._findings += self._mapper.done(look, *_timed(look.run))

    def _arrived(self, wait: bool) -> Iterator[Any]:
        """What is in the inbox; if `wait`, at least one message, unless none comes for a while."""
        try:
            yield self._inbox.get(wait, _REPORT_S if wait else None)
            while True:
                yield self._inbox.get_nowait()
        except queue.Empty:
            return

    def _hear(self, message: Any) -> None:
        match message:
            case Restore():
                self._mapper.restore(message.kept)
                self._is_restoring = True
            case Join():
                self._mapper.join(message.key, message.hello, message.voice)
            case Speaks():
                self._mapper.speaks(message.key, message.voice)
            case Present():
                self._mapper.present(message.key, message.here)
            case Forget():
                self._guarded("forget", partial(self._mapper.forget, message.key), None)
            case Add():
                self._turns.add(self._mapper.name(message.key), message)
            case _Solved():
                self._solved(message.result, message.ms)
            case _Lost():
                self._replace_solver(message.how)
            case _ if message is END:
                self._ended = True

    def _take_in(self) -> None:
        """Keyframes that wait; at the end all of them."""
        began = time.perf_counter()
        while True:
            spent_ms = 0.0 if self._ended else 1e3 * (time.perf_counter() - began)
            if (add := self._turns.next(spent_ms)) is None:
                return
            work = partial(self._mapper.add, add.key, add.keyframe, add.is_extra)
            self._findings += self._guarded("keyframe", work, [], add.key)

    def _guarded(self, what: str, work: Callable[[], T], otherwise: T, agent: str | None = None) -> T:
        """A fault of ours costs this message or step, never the process: the map file would bring it back."""
        try:
            return work()
        except Exception as error:
            self._findings += self._mapper.failed(what, error, agent)
            return otherwise

    def _give_solver(self) -> None:
        step = self._guarded("solve", self._mapper.next_solve, None)
        if step is not None:
            self._solving, self._solving_since = step, time.monotonic()
            self._solver.send(step)

    def _solved(self, result: object, ms: float) -> None:
        step, self._solving = self._solving, None
        self._is_moved = True
        if step is not None:
            self._findings += self._mapper.done(step, result, ms)

    def _new_solver(self, after_s: float) -> Companion:
        about = (self._settings.graph,)
        return Companion("solver", solve_all, about, self._inbox.put, self._solver_lost, after_s)

    def _solver_lost(self, how: str) -> None:
        """From another thread."""
        self._inbox.put(_Lost(how))

    def _replace_solver(self, how: str) -> None:
        """It costs the solution that it was at, and telling it all again."""
        self._solver.close()
        pause_s = self._backoff.died(time.monotonic_ns())
        self._answer(SolverLost(f"its process {how}; a new one begins in {pause_s:g} s"))
        self._solver = self._new_solver(pause_s)
        self._mapper.solver_lost()
        self._solved(RuntimeError(f"the solver {how}"), 0.0)

    def _tell(self) -> None:
        changes = self._mapper.take_changes()
        if self._is_moved and time.monotonic() >= self._poses_at:
            self._is_moved, self._poses_at = False, time.monotonic() + _POSES_S
            changes = (*changes, self._mapper.poses())
        emptied = self._mapper.take_emptied()
        if self._findings or changes or emptied:
            self._answer(Found(tuple(self._findings), changes, emptied))
            self._findings = []
        if time.monotonic() >= self._report_at:
            self._report_at = time.monotonic() + _REPORT_S
            solving_s = 0.0 if self._solving is None else time.monotonic() - self._solving_since
            self._answer(Mapped(self._mapper.report(), solving_s))
            self._heap.tidy(time.monotonic())


def solve_all(inbox: Inbox, answer: Callable[[Any], None], settings: GraphConfig) -> None:
    """For a `Companion`: takes Solve, answers with what came of it, until END."""
    solver, heap = Solver(settings), Heap()
    while (step := inbox.get()) is not END:
        answer(_Solved(*_timed(partial(step.run, solver))))
        heap.tidy(time.monotonic())


def _timed(work: Callable[[], object]) -> tuple[object, float]:
    began = time.perf_counter()
    result: object
    try:
        result = work()
    except Exception as error:  # a step that fails costs its keyframe, never the edge
        result = error
    return result, 1e3 * (time.perf_counter() - began)
