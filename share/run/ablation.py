"""Every policy on every session with every seed, in turn, so that a noisy machine treats all alike."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from share.config import Config
from share.errors import DataError, ShareError, UsageError
from share.io.session import Session
from share.run.play import Progress, Terms
from share.run.trial import RUN, SETTINGS, Trial, read_trial, run_trial, settings_of


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
    runs: Sequence[Planned], config: Config, show: Callable[[int, Progress | None], None]
) -> Iterator[tuple[Planned, Trial | ShareError]]:
    """What is not done yet is played; each with what came of it. show: which of `runs`, and how far it is.

    Raises UsageError where a run is there that was on other terms.
    """
    for number, planned in enumerate(runs):
        if planned.is_done:
            yield planned, _as_planned(planned, config)
            continue
        show(number, None)

        def shown(now: Progress, number: int = number) -> None:
            show(number, now)

        try:
            yield planned, run_trial(planned.session, planned.terms, config, planned.out, shown)
        except (UsageError, DataError):
            raise
        except ShareError as error:
            yield planned, error


def _as_planned(planned: Planned, config: Config) -> Trial:
    trial = read_trial(planned.out)
    played = trial.session.folder.resolve(), trial.terms, (planned.out / SETTINGS).read_text()
    wanted = planned.session.folder.resolve(), planned.terms, settings_of(config, planned.terms.seed)
    if played != wanted:
        raise UsageError(f"{trial.folder}: was played on other terms or settings; give another --out")
    return trial
