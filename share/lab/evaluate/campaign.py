"""Runs that are planned together: those that are there are taken, the others are played."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Protocol

import numpy as np

from share import startup
from share.config import Config, load_config
from share.errors import DataError, ShareError, UsageError
from share.files.yaml_file import read_settings
from share.lab.evaluate.real_time import Progress, RunOptions
from share.lab.evaluate.trial import RUN_FILE, SETTINGS_FILE, Trial, read_trial, run_trial, settings_yaml
from share.recordings.session import Session
from share.runtime.pool import Pool

TrialResult = Trial | ShareError
ShowRun = Callable[[int, Progress | None], None]  # which of the runs, and how far it is


@dataclass(frozen=True, eq=False)
class PlannedRun:
    """One run, by which settings, and in which folder it is or will be."""

    session: Session
    terms: RunOptions
    out: Path
    config: Config

    @property
    def is_done(self) -> bool:
        return (self.out / RUN_FILE).is_file()


SessionJob = list[PlannedRun]  # of one session, which is tracked once for all


class WorkerPool(Protocol):
    """As `share.runtime.pool.Pool`."""

    @property
    def worker_count(self) -> int: ...

    def run(
        self, work: Callable[[SessionJob], list[TrialResult]], jobs: Iterable[SessionJob]
    ) -> Iterator[tuple[SessionJob, list[TrialResult]]]: ...


def check_unique_names(sessions: Sequence[Session]) -> None:
    """Raises UsageError where two have one name, since their runs would."""
    names = [session.folder.resolve().name for session in sessions]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"two sessions are called {twice[0]}; rename a folder")


def worker_pool(workers: int) -> AbstractContextManager[WorkerPool] | None:
    """So many processes on this machine; None: one run after the other."""
    return None if workers == 1 else Pool(workers, startup.prepare_process, ())


def run_all(
    runs: Sequence[PlannedRun], show: ShowRun, workers: AbstractContextManager[WorkerPool] | None = None
) -> Iterator[tuple[PlannedRun, TrialResult]]:
    """What is not done yet is played; each of `runs` with what came of it.

    workers: play sessions side by side, which only virtual time stands. Raises UsageError where a run is
    there that was on other terms.
    """
    ready = {run.out: _read_matching_trial(run) for run in runs if run.is_done}
    yield from ((run, ready[run.out]) for run in runs if run.out in ready)
    pending = [(number, run) for number, run in enumerate(runs) if run.out not in ready]
    if workers is None:
        for number, run in pending:
            show(number, None)
            yield run, _play_run(run, partial(show, number))
        return
    done = len(ready)
    with workers as pool:
        for job, result in pool.run(play_job, split_jobs([run for _, run in pending], pool.worker_count)):
            done += len(job)
            show(done - 1, None)
            yield from zip(job, result, strict=True)


def split_jobs(runs: Sequence[PlannedRun], workers: int) -> list[SessionJob]:
    """By session, and each session in as many parts as it takes for nobody to stand idle."""
    by_session = sorted(runs, key=lambda one: str(one.session.folder))
    sessions = [list(group) for _, group in groupby(by_session, key=lambda one: one.session.folder)]
    parts = -(-workers // max(1, len(sessions)))
    pieces_of_session = [
        np.array_split(np.arange(len(session_runs)), min(parts, len(session_runs)))
        for session_runs in sessions
    ]
    return [
        [session_runs[k] for k in part]
        for session_runs, pieces in zip(sessions, pieces_of_session, strict=True)
        for part in pieces
    ]


def play_job(job: SessionJob) -> list[TrialResult]:
    return [_play_run(run, lambda now: None) for run in job]


def _play_run(run: PlannedRun, show: Callable[[Progress], None]) -> TrialResult:
    """A run that fails is no reason not to play the next. Who does a dead worker's job takes what it left."""
    if run.is_done:
        return _read_matching_trial(run)
    try:
        return run_trial(run.session, run.terms, run.config, run.out, show)
    except (UsageError, DataError):
        raise
    except ShareError as error:
        return error


def _read_matching_trial(run: PlannedRun) -> Trial:
    """A setting that the run did not know yet counts as it is shipped."""
    trial = read_trial(run.out)
    text = settings_yaml(run.config, run.terms.seed)
    settings = read_settings(run.out / SETTINGS_FILE)
    actual = trial.session.folder.resolve(), trial.options, settings
    expected = run.session.folder.resolve(), run.terms, load_config(text)
    if actual != expected:
        raise UsageError(f"{trial.folder}: was played on other terms or settings; give another --out")
    return trial


# ---- Every policy on every session with every seed, in turn, so that a noisy machine treats all alike.


def plan_policies(
    sessions: Sequence[Session],
    policies: Sequence[str],
    seeds: Sequence[int],
    terms: RunOptions,
    out: Path,
    config: Config | None = None,
) -> list[PlannedRun]:
    """All runs in order: of a session, the policies follow each other, each time another one first.

    config: by default, every setting as it is shipped. Raises UsageError where two sessions have one name.
    """
    check_unique_names(sessions)
    policies = list(dict.fromkeys(policies))
    runs = []
    for round_number, (seed, session) in enumerate((seed, session) for seed in seeds for session in sessions):
        for k in range(len(policies)):
            policy = policies[(round_number + k) % len(policies)]
            name = f"{session.folder.resolve().name}-{policy}-{seed}"
            options = replace(terms, policy=policy, seed=seed)
            runs.append(PlannedRun(session, options, out / name, Config() if config is None else config))
    return runs
