"""Every policy on every session with every seed, in turn, so that a noisy machine treats all alike."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path

from share import process
from share.config import Config
from share.errors import DataError, ShareError, UsageError
from share.io.pool import Pool
from share.io.session import Session
from share.run.play import Progress, Terms
from share.run.trial import RUN, SETTINGS, Trial, read_trial, run_trial, settings_of

Came = Trial | ShareError
Show = Callable[[int, Progress | None], None]  # which of the runs, and how far it is


@dataclass(frozen=True, eq=False)
class Planned:
    """One run, and in which folder it is or will be."""

    session: Session
    terms: Terms
    out: Path

    @property
    def is_done(self) -> bool:
        return (self.out / RUN).is_file()


def plan(
    sessions: Sequence[Session], policies: Sequence[str], seeds: Sequence[int], terms: Terms, out: Path
) -> list[Planned]:
    """All runs in order: of a session, the policies follow each other, each time another one first.

    Raises UsageError where two sessions have one name, since their runs would.
    """
    names = [session.folder.resolve().name for session in sessions]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"two sessions are called {twice[0]}; rename a folder")
    runs = []
    for turn, (seed, session) in enumerate((seed, session) for seed in seeds for session in sessions):
        for k in range(len(policies)):
            policy = policies[(turn + k) % len(policies)]
            name = f"{session.folder.resolve().name}-{policy}-{seed}"
            runs.append(Planned(session, replace(terms, policy=policy, seed=seed), out / name))
    return runs


def go_through(
    runs: Sequence[Planned], config: Config, show: Show, workers: int = 1
) -> Iterator[tuple[Planned, Came]]:
    """What is not done yet is played; each of `runs` with what came of it.

    workers: sessions that are played side by side, which only virtual time stands. Raises UsageError where
    a run is there that was on other terms.
    """
    ready = {planned.out: _as_planned(planned, config) for planned in runs if planned.is_done}
    yield from ((planned, ready[planned.out]) for planned in runs if planned.out in ready)
    left = [(number, planned) for number, planned in enumerate(runs) if planned.out not in ready]
    if workers == 1:
        for number, planned in left:
            show(number, None)
            yield planned, _play(planned, config, partial(show, number))
        return
    by_session = sorted(left, key=lambda one: str(one[1].session.folder))
    jobs = [
        ([planned for _, planned in group], config)
        for _, group in groupby(by_session, key=lambda one: one[1].session.folder)
    ]
    with Pool(min(workers, max(1, len(jobs))), process.prepare, ()) as pool:
        for done, (_, came) in enumerate(pool.run(_play_all, jobs)):
            show(done, None)
            yield from came


def _play_all(job: tuple[list[Planned], Config]) -> list[tuple[Planned, Came]]:
    """Of one session."""
    runs, config = job
    return [(planned, _play(planned, config, lambda now: None)) for planned in runs]


def _play(planned: Planned, config: Config, show: Callable[[Progress], None]) -> Came:
    """A run that fails is no reason not to play the next."""
    try:
        return run_trial(planned.session, planned.terms, config, planned.out, show)
    except (UsageError, DataError):
        raise
    except ShareError as error:
        return error


def _as_planned(planned: Planned, config: Config) -> Trial:
    trial = read_trial(planned.out)
    played = trial.session.folder.resolve(), trial.terms, (planned.out / SETTINGS).read_text()
    wanted = planned.session.folder.resolve(), planned.terms, settings_of(config, planned.terms.seed)
    if played != wanted:
        raise UsageError(f"{trial.folder}: was played on other terms or settings; give another --out")
    return trial
