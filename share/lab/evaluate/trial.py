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
from share.files.json_file import read_json, to_plain
from share.files.writing import atomic_write, new_folder
from share.lab.evaluate.real_time import Progress, RunOptions, play_in_real_time
from share.lab.evaluate.virtual_time import play_in_virtual_time
from share.plain_data import from_mapping, to_mapping
from share.recordings.session import Session, read_session
from share.runtime.machine import code_digest, describe_machine
from share.runtime.source import open_source
from share.sensors.measurement import CAM0

RUN_FILE = "run.json"
SETTINGS_FILE = "config.yaml"
SCHEMA = 1
_OPTION_NAMES = [field.name for field in dataclasses.fields(RunOptions) if field.name != "config"]


@dataclass(frozen=True, eq=False)
class Trial:
    """One that is over. record: run.json."""

    folder: Path
    session: Session
    options: RunOptions
    record: dict[str, Any]

    @property
    def folders(self) -> dict[str, Path]:
        """Of each agent's files, by name."""
        return {name: self.folder / name for name in self.session.agents}

    @property
    def clock(self) -> str:
        """By which time it was played, for a reader."""
        if self.options.virtual:
            return "virtual time" + (
                f", as long as in {Path(self.options.costs).name}" if self.options.costs else ""
            )
        return "real time" + (", agents first" if self.options.agents_first else "")

    @property
    def error_source(self) -> str:
        """What the edge takes for an agent's error, for a reader."""
        model = self.record.get("error_model")
        if self.options.true_error:
            return "the true error"
        return f"what the error model says ({Path(model).name})" if model else "odometry's sigma"


def run_trial(
    session: Session, options: RunOptions, config: Config, out: Path, show: Callable[[Progress], None]
) -> Trial:
    """Plays it. `out` is whole or not there. config: for all; what it draws is drawn by the seed of
    `options`.

    Raises UsageError where `out` is there already or the session has no truth, ShareError where an agent or
    the edge fails.
    """
    seconds = _duration_s(session)
    with new_folder(out) as work:
        atomic_write(work / SETTINGS_FILE, settings_yaml(config, options.seed))
        began, machine = datetime.now(UTC), describe_machine()
        play_options = dataclasses.replace(options, config=str(work / SETTINGS_FILE))
        (play_in_virtual_time if options.virtual else play_in_real_time)(
            session, seconds, play_options, work, show
        )
        record = {
            "schema": SCHEMA,
            "session": str(session.folder.resolve()),
            "provenance": session.provenance,
            **{name: getattr(options, name) for name in _OPTION_NAMES},
            "error_model": config.agent.error_model,
            "seconds": seconds,
            "began": began.isoformat(timespec="seconds"),
            "took_s": round((datetime.now(UTC) - began).total_seconds(), 1),
            "version": __version__,
            "code": code_digest(),
            "machine": machine,
        }
        atomic_write(work / RUN_FILE, json.dumps(record, indent=2, default=str) + "\n")
    return read_trial(out)


def read_trial(folder: Path) -> Trial:
    """Raises UsageError or DataError where `folder` is not one that is over, or its session is another."""
    path = folder / RUN_FILE
    if not path.is_file():
        raise UsageError(f"{folder}: has no {RUN_FILE}; it is not a run by `share evaluate run`")
    record = read_json(path)
    try:
        options = from_mapping(
            RunOptions, {name: record[name] for name in _OPTION_NAMES if name in record}, "terms"
        )
    except ConfigError as error:
        raise DataError(f"{path}: is damaged: {error}") from None
    session, texts = record.get("session"), [record.get(name) for name in ("error_model", "code")]
    if not isinstance(session, str) or not all(isinstance(one, str | None) for one in texts):
        raise DataError(f"{path}: is damaged: session, error_model or code is no text")
    if not Path(session).is_dir():
        raise UsageError(f"{path}: its session {session} is not there any more, and with it the truth")
    opened = read_session(Path(session))
    if record.get("provenance", to_plain(opened.provenance)) != to_plain(opened.provenance):
        raise UsageError(
            f"{path}: its session {session} was made anew since, with another truth; play it again"
        )
    return Trial(folder, opened, options, record)


def settings_yaml(config: Config, seed: int) -> str:
    """The text of config.yaml: `config`, with draws of the scheduler of their own for each seed."""
    import yaml

    control = config.control
    seeded = dataclasses.replace(
        control, gate_seed=control.gate_seed + seed, random_seed=control.random_seed + seed
    )
    text: str = yaml.safe_dump(to_mapping(dataclasses.replace(config, control=seeded)), sort_keys=False)
    return text


def _duration_s(session: Session) -> float:
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
