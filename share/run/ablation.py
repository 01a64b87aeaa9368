"""Every policy on every session with every seed, in turn, so that a noisy machine treats all alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from share.config import Config
from share.io.session import Session
from share.run.campaign import Planned, check_names
from share.run.play import Terms


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
