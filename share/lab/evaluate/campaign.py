"""Runs that are planned together: finished ones are read, the others are played here or on a cluster."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from types import TracebackType
from typing import Protocol, TypeVar

import numpy as np

from share import startup
from share.config import Config, load_config, with_policy
from share.errors import DataError, ShareError, UsageError, install_hint
from share.files.yaml_file import read_settings
from share.lab.evaluate.real_time import Progress, RunOptions
from share.lab.evaluate.trial import RUN_FILE, SETTINGS_FILE, Trial, read_trial, run_trial, settings_yaml
from share.lab.pool import Pool
from share.recordings.session import Session

TrialResult = Trial | ShareError
ShowRun = Callable[[int, Progress | None], None]  # number of the run, and its progress


@dataclass(frozen=True, eq=False)
class PlannedRun:
    """One run: its session, options, settings and folder."""

    session: Session
    options: RunOptions
    out: Path
    config: Config

    @property
    def is_done(self) -> bool:
        return (self.out / RUN_FILE).is_file()


SessionJob = list[PlannedRun]  # runs of one session, which is tracked once for all of them


class WorkerPool(Protocol):
    """The interface of `share.lab.pool.Pool`."""

    @property
    def worker_count(self) -> int: ...

    def run(
        self, work: Callable[[SessionJob], list[TrialResult]], jobs: Iterable[SessionJob]
    ) -> Iterator[tuple[SessionJob, list[TrialResult]]]: ...


def check_unique_names(sessions: Sequence[Session]) -> None:
    """Raise UsageError where two sessions have one name, since their runs would."""
    names = [session.folder.resolve().name for session in sessions]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"two sessions have the name {twice[0]}; rename a folder")


def worker_pool(workers: int) -> AbstractContextManager[WorkerPool] | None:
    """Return a pool of `workers` processes on this machine, None for one."""
    return None if workers == 1 else Pool(workers, startup.prepare_process, ())


def run_all(
    runs: Sequence[PlannedRun], show: ShowRun, workers: AbstractContextManager[WorkerPool] | None = None
) -> Iterator[tuple[PlannedRun, TrialResult]]:
    """Play the runs that are not done; yield each of `runs` with its result.

    `workers`: play sessions in parallel, in virtual time only. Raises UsageError where a finished run was
    played with other options or settings.
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
    """Return jobs by session, each session split into as many parts as keep all workers busy."""
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
    """Play a run, or read it if another worker that died had finished it. A failure is returned, so that
    the next run is played."""
    if run.is_done:
        return _read_matching_trial(run)
    try:
        return run_trial(run.session, run.options, run.config, run.out, show)
    except (UsageError, DataError):
        raise
    except ShareError as error:
        return error


def _read_matching_trial(run: PlannedRun) -> Trial:
    """Read a finished run. Settings that did not exist when it was played count as their defaults.

    Raises UsageError where its session, options or settings differ.
    """
    trial = read_trial(run.out)
    text = settings_yaml(with_policy(run.config, run.options.policy), run.options.seed)
    # 0.2.0 and older wrote another policy into the settings than they played
    settings = with_policy(read_settings(run.out / SETTINGS_FILE), trial.options.policy)
    actual = trial.session.folder.resolve(), trial.options, settings
    expected = run.session.folder.resolve(), run.options, load_config(text)
    if actual != expected:
        raise UsageError(f"{trial.folder}: was played with other options or settings; give another --out")
    return trial


def plan_policies(
    sessions: Sequence[Session],
    policies: Sequence[str],
    seeds: Sequence[int],
    options: RunOptions,
    out: Path,
    config: Config | None = None,
) -> list[PlannedRun]:
    """Return all runs in order. On each session the policies follow each other, every time starting with
    another one, so that a noisy machine treats all alike.

    `config`: defaults if None. Raises UsageError where two sessions have one name.
    """
    check_unique_names(sessions)
    policies = list(dict.fromkeys(policies))
    runs = []
    for round_number, (seed, session) in enumerate((seed, session) for seed in seeds for session in sessions):
        for k in range(len(policies)):
            policy = policies[(round_number + k) % len(policies)]
            name = f"{session.folder.resolve().name}-{policy}-{seed}"
            run_options = replace(options, policy=policy, seed=seed)
            runs.append(PlannedRun(session, run_options, out / name, Config() if config is None else config))
    return runs


Job = TypeVar("Job")
Result = TypeVar("Result")
_CONNECT_S = 10


class Cluster:
    """A pool with the interface of `share.lab.pool.Pool`, on the dask scheduler at `address`.

    Workers need SHARE, and the same files at the same paths.
    """

    def __init__(self, address: str) -> None:
        if importlib.util.find_spec("distributed") is None:
            raise UsageError(f"--scheduler: {install_hint('distributed', 'cluster')}")
        from distributed import Client

        try:
            self._client = Client(address, timeout=_CONNECT_S)
        except (OSError, ValueError) as error:
            raise UsageError(f"--scheduler {address}: no answer from a dask scheduler: {error}") from None

    @property
    def worker_count(self) -> int:
        """The number of workers now; 1 while none has connected."""
        return max(1, len(self._client.nthreads()))

    def run(self, work: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[tuple[Job, Result]]:
        """Yield every job with `work(job)`, in order of completion. Raises what a job raised."""
        from distributed import KilledWorker, as_completed

        running = {self._client.submit(work, job, pure=False): job for job in jobs}
        try:
            for future in as_completed(list(running)):
                yield running[future], future.result()
        except KilledWorker:
            raise ShareError(
                "a run has ended several workers, one after the other; do they have enough memory?"
            ) from None
        finally:
            self._client.cancel(list(running))

    def __enter__(self) -> Cluster:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._client.close()
