"""Carry out the trials of a simulated study that are missing, on several processes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Protocol, TypeVar

from share.lab.emulate.recipe import Progress
from share.lab.emulate.session import make_cached_session
from share.lab.study.simulated_study import OWN_AGENTS, SimulatedStudy
from share.lab.study.simulated_trial import TrialDone, TrialJob, carry_out, sessions_of

# CPU seconds a simulated second of one trial takes, of 320 x 240 at 15 Hz on an AMD EPYC: before the first
# trial is done, the estimate is by these
_CPU_OF_TRIAL, _CPU_OF_AGENT, _CPU_OF_DRAWING = 0.9, 0.08, 0.6

Job = TypeVar("Job")
Result = TypeVar("Result")


class TrialPool(Protocol):
    """The interface of `share.lab.pool.Pool`."""

    def run(self, work: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[tuple[Job, Result]]: ...


def estimated_s(study: SimulatedStudy, workers: int) -> float:
    """Return about how long the missing trials take, s, if each of `workers` processes has a core."""
    missing = study.missing()
    others = study.settings.agents - OWN_AGENTS
    simulated_s = sum(study.participant_plan(k).seconds for k, _ in missing)
    drawn_s = sum(2 * study.participant_plan(k).seconds for k in {k for k, _ in missing})
    drawn_s += study.others_recipe.seconds if study.others_recipe else 0.0
    trials_s = simulated_s * (_CPU_OF_TRIAL + others * _CPU_OF_AGENT)
    return (trials_s + drawn_s * _CPU_OF_DRAWING) / workers


def run_missing(
    study: SimulatedStudy, workers: int, pool: TrialPool | None, progress: Progress
) -> Iterator[TrialDone]:
    """Draw what is missing and carry out the trials, a few participants at a time; yield each trial as it is
    done. workers: of the pool, and processes that draw; pool None: in this process.

    Raises ShareError; all trials that were yielded are on the disk.
    """
    missing = study.missing()
    for people in _batches(sorted({k for k, _ in missing}), workers, len(study.plan.letters)):
        for recipe in sessions_of(study, people):
            make_cached_session(recipe, workers=workers, progress=progress)
        jobs = [TrialJob(study.folder, k, place) for k, place in missing if k in people]
        if pool is None:
            yield from map(carry_out, jobs)
        else:
            yield from (done for _, done in pool.run(carry_out, jobs))


def _batches(people: Sequence[int], workers: int, conditions: int) -> Iterator[list[int]]:
    """Yield so many participants that all workers have a trial each."""
    size = max(1, -(-workers // conditions))
    for first in range(0, len(people), size):
        yield list(people[first : first + size])


class TimeLeft:
    """Estimates what is left from the trials so far. now_s: a monotonic clock's."""

    def __init__(self, total: int, now_s: float | None = None) -> None:
        self._total, self._began_s, self._done = total, time.monotonic() if now_s is None else now_s, 0

    def after_one(self, now_s: float | None = None) -> float:
        """Return about how many seconds are left after one more trial."""
        self._done += 1
        elapsed_s = (time.monotonic() if now_s is None else now_s) - self._began_s
        return elapsed_s / self._done * (self._total - self._done)
