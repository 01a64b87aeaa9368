"""A trial: a session played on stated terms, kept with what is needed to do it again.

Its folder holds what the agents and the edge left, `config.yaml` (the settings in effect) and `run.json`.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from share import __version__
from share.config import Config
from share.errors import ConfigError, DataError, UsageError
from share.files.json_file import plain, read_json
from share.files.writing import atomic_write, new_folder
from share.lab.evaluate.play import Progress, Terms, play
from share.lab.evaluate.virtual import play_virtually
from share.plain_data import from_mapping, to_mapping
from share.recordings.session import Session, read_session
from share.runtime.machine import code_state, describe_machine
from share.runtime.source import open_source
from share.sensors.measurement import CAM0

RUN = "run.json"
SETTINGS = "config.yaml"
SCHEMA = 1
_TERMS = [field.name for field in dataclasses.fields(Terms) if field.name != "config"]


@dataclass(frozen=True, eq=False)
class Trial:
    """One that is over. record: run.json."""

    folder: Path
    session: Session
    terms: Terms
    record: dict[str, Any]

    @property
    def folders(self) -> dict[str, Path]:
        """Of each agent's files, by name."""
        return {name: self.folder / name for name in self.session.agents}

    @property
    def clock(self) -> str:
        """By which time it was played, for a reader."""
        if self.terms.virtual:
            return "virtual time" + (
                f", as long as in {Path(self.terms.costs).name}" if self.terms.costs else ""
            )
        return "real time" + (", agents first" if self.terms.agents_first else "")

    @property
    def told(self) -> str:
        """What the edge takes for an agent's error, for a reader."""
        model = self.record.get("error_model")
        if self.terms.true_error:
            return "the true error"
        return f"what the error model says ({Path(model).name})" if model else "odometry's sigma"


def run_trial(
    session: Session, terms: Terms, config: Config, out: Path, show: Callable[[Progress], None]
) -> Trial:
    """Plays it. `out` is whole or not there. config: for all; what it draws is drawn by the seed of `terms`.

    Raises UsageError where `out` is there already or the session has no truth, ShareError where an agent or
    the edge fails.
    """
    seconds = _seconds(session)
    with new_folder(out) as work:
        atomic_write(work / SETTINGS, settings_of(config, terms.seed))
        began, machine = datetime.now(UTC), describe_machine()
        told = dataclasses.replace(terms, config=str(work / SETTINGS))
        (play_virtually if terms.virtual else play)(session, seconds, told, work, show)
        record = {
            "schema": SCHEMA,
            "session": str(session.folder.resolve()),
            "provenance": session.provenance,
            **{name: getattr(terms, name) for name in _TERMS},
            "error_model": config.agent.error_model,
            "seconds": seconds,
            "began": began.isoformat(timespec="seconds"),
            "took_s": round((datetime.now(UTC) - began).total_seconds(), 1),
            "version": __version__,
            "code": code_state(),
            "machine": machine,
        }
        atomic_write(work / RUN, json.dumps(record, indent=2, default=str) + "\n")
    return read_trial(out)


def read_trial(folder: Path) -> Trial:
    """Raises UsageError or DataError where `folder` is not one that is over, or its session is another."""
    path = folder / RUN
    if not path.is_file():
        raise UsageError(f"{folder}: has no {RUN}; it is not a run by `share evaluate run`")
    record = read_json(path)
    try:
        terms = from_mapping(Terms, {name: record[name] for name in _TERMS if name in record}, "terms")
    except ConfigError as error:
        raise DataError(f"{path}: is damaged: {error}") from None
    session, told = record.get("session"), [record.get(name) for name in ("error_model", "code")]
    if not isinstance(session, str) or not all(isinstance(one, str | None) for one in told):
        raise DataError(f"{path}: is damaged: session, error_model or code is no text")
    if not Path(session).is_dir():
        raise UsageError(f"{path}: its session {session} is not there any more, and with it the truth")
    opened = read_session(Path(session))
    if record.get("provenance", plain(opened.provenance)) != plain(opened.provenance):
        raise UsageError(
            f"{path}: its session {session} was made anew since, with another truth; play it again"
        )
    return Trial(folder, opened, terms, record)


def settings_of(config: Config, seed: int) -> str:
    """The text of config.yaml: `config`, with draws of the scheduler of their own for each seed."""
    import yaml

    control = config.control
    drawn = dataclasses.replace(
        control, gate_seed=control.gate_seed + seed, random_seed=control.random_seed + seed
    )
    text: str = yaml.safe_dump(to_mapping(dataclasses.replace(config, control=drawn)), sort_keys=False)
    return text


def _seconds(session: Session) -> float:
    """From the first image of all to the last, by the session's clock."""
    first, last = [], []
    for name, agent in session.agents.items():
        path = session.folder / "truth" / f"{name}.tum"
        if not path.is_file():
            raise UsageError(f"{path}: no such file; without the truth of all agents nothing can be scored")
        stamps_ns = open_source(f"{session.folder}/{name}").stamps()[CAM0]
        first.append(int(stamps_ns[0]) - agent.clock_offset_ns)
        last.append(int(stamps_ns.max()) - agent.clock_offset_ns)
    return (max(last) - min(first)) / 1e9
