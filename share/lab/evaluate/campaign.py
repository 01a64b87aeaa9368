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
from share.config import Config, load
from share.errors import DataError, ShareError, UsageError
from share.files.yaml_file import read_settings
from share.lab.evaluate.play import Progress, Terms
from share.lab.evaluate.trial import RUN, SETTINGS, Trial, read_trial, run_trial, settings_of
from share.recordings.session import Session
from share.runtime.pool import Pool

Came = Trial | ShareError
Show = Callable[[int, Progress | None], None]  # which of the runs, and how far it is


@dataclass(frozen=True, eq=False)
class Planned:
    """One run, by which settings, and in which folder it is or will be."""

    session: Session
    terms: Terms
    out: Path
    config: Config

    @property
    def is_done(self) -> bool:
        return (self.out / RUN).is_file()


Job = list[Planned]  # of one session, which is tracked once for all


class Workers(Protocol):
    """As `share.runtime.pool.Pool`."""

    @property
    def count(self) -> int: ...

    def run(
        self, work: Callable[[Job], list[Came]], jobs: Iterable[Job]
    ) -> Iterator[tuple[Job, list[Came]]]: ...


def check_names(sessions: Sequence[Session]) -> None:
    """Raises UsageError where two have one name, since their runs would."""
    names = [session.folder.resolve().name for session in sessions]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"two sessions are called {twice[0]}; rename a folder")


def side_by_side(workers: int) -> AbstractContextManager[Workers] | None:
    """So many processes on this machine; None: one run after the other."""
    return None if workers == 1 else Pool(workers, startup.prepare, ())


def go_through(
    runs: Sequence[Planned], show: Show, workers: AbstractContextManager[Workers] | None = None
) -> Iterator[tuple[Planned, Came]]:
    """What is not done yet is played; each of `runs` with what came of it.

    workers: play sessions side by side, which only virtual time stands. Raises UsageError where a run is
    there that was on other terms.
    """
    ready = {planned.out: _as_planned(planned) for planned in runs if planned.is_done}
    yield from ((planned, ready[planned.out]) for planned in runs if planned.out in ready)
    left = [(number, planned) for number, planned in enumerate(runs) if planned.out not in ready]
    if workers is None:
        for number, planned in left:
            show(number, None)
            yield planned, _play(planned, partial(show, number))
        return
    done = len(ready)
    with workers as pool:
        for job, came in pool.run(play_all, dealt([planned for _, planned in left], pool.count)):
            done += len(job)
            show(done - 1, None)
            yield from zip(job, came, strict=True)


def dealt(runs: Sequence[Planned], workers: int) -> list[Job]:
    """By session, and each session in as many parts as it takes for nobody to stand idle."""
    by_session = sorted(runs, key=lambda one: str(one.session.folder))
    sessions = [list(group) for _, group in groupby(by_session, key=lambda one: one.session.folder)]
    parts = -(-workers // max(1, len(sessions)))
    cut = [np.array_split(np.arange(len(mine)), min(parts, len(mine))) for mine in sessions]
    return [[mine[k] for k in part] for mine, pieces in zip(sessions, cut, strict=True) for part in pieces]


def play_all(job: Job) -> list[Came]:
    return [_play(planned, lambda now: None) for planned in job]


def _play(planned: Planned, show: Callable[[Progress], None]) -> Came:
    """A run that fails is no reason not to play the next. Who does a dead worker's job takes what it left."""
    if planned.is_done:
        return _as_planned(planned)
    try:
        return run_trial(planned.session, planned.terms, planned.config, planned.out, show)
    except (UsageError, DataError):
        raise
    except ShareError as error:
        return error


def _as_planned(planned: Planned) -> Trial:
    """A setting that the run did not know yet counts as it is shipped."""
    trial = read_trial(planned.out)
    text = settings_of(planned.config, planned.terms.seed)
    settings = read_settings(planned.out / SETTINGS)
    played = trial.session.folder.resolve(), trial.terms, settings
    wanted = planned.session.folder.resolve(), planned.terms, load(text)
    if played != wanted:
        raise UsageError(f"{trial.folder}: was played on other terms or settings; give another --out")
    return trial


# ---- Every policy on every session with every seed, in turn, so that a noisy machine treats all alike.


def plan(
    sessions: Sequence[Session],
    policies: Sequence[str],
    seeds: Sequence[int],
    terms: Terms,
    out: Path,
    config: Config | None = None,
) -> list[Planned]:
    """All runs in order: of a session, the policies follow each other, each time another one first.

    config: by default, every setting as it is shipped. Raises UsageError where two sessions have one name.
    """
    check_names(sessions)
    policies = list(dict.fromkeys(policies))
    runs = []
    for turn, (seed, session) in enumerate((seed, session) for seed in seeds for session in sessions):
        for k in range(len(policies)):
            policy = policies[(turn + k) % len(policies)]
            name = f"{session.folder.resolve().name}-{policy}-{seed}"
            told = replace(terms, policy=policy, seed=seed)
            runs.append(Planned(session, told, out / name, Config() if config is None else config))
    return runs
