"""A trial: one run of a session, kept with all that is needed to repeat it.

Its folder holds the files of the agents and of the edge, `config.yaml` (the effective settings) and
`run.json`.
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
from share.config import Config, with_policy
from share.errors import ConfigError, DataError, UsageError
from share.files.json_file import read_json, to_plain
from share.files.writing import atomic_write, new_folder
from share.lab.evaluate.provenance import code_digest, describe_machine
from share.lab.evaluate.real_time import Progress, RunOptions, RunPages, played_in_real_time
from share.lab.evaluate.virtual_time import play_in_virtual_time
from share.plain_data import from_mapping, to_mapping
from share.recordings.session import Session, read_session
from share.runtime.source import open_source
from share.sensors.measurement import CAM0

RUN_FILE = "run.json"
SETTINGS_FILE = "config.yaml"
SCHEMA = 1
_OPTION_NAMES = [field.name for field in dataclasses.fields(RunOptions) if field.name != "config"]


@dataclass(frozen=True, eq=False)
class Trial:
    """A finished trial. `record`: the contents of run.json."""

    folder: Path
    session: Session
    options: RunOptions
    record: dict[str, Any]

    @property
    def folders(self) -> dict[str, Path]:
        """Folder of each agent's files, by name."""
        return {name: self.folder / name for name in self.session.agents}

    @property
    def clock(self) -> str:
        """The clock by which it was played, for readers."""
        if self.options.virtual:
            return "virtual time" + (
                f", delays of {Path(self.options.costs).name}" if self.options.costs else ""
            )
        return "real time" + (", agents first" if self.options.agents_first else "")

    @property
    def error_source(self) -> str:
        """The source of the agents' estimated errors, for readers."""
        model = self.record.get("error_model")
        if self.options.true_error:
            return "the true error"
        return f"the error model ({Path(model).name})" if model else "odometry's sigma"


def run_trial(
    session: Session,
    options: RunOptions,
    config: Config,
    out: Path,
    show: Callable[[Progress], None],
    pages: RunPages | None = None,
) -> Trial:
    """Play a session. `out` is complete or absent. The scheduler's random numbers follow the seed of
    `options`. pages: what to serve meanwhile, in real time.

    Raises UsageError where `out` exists or the session has no truth, ShareError where an agent or the edge
    fails.
    """
    seconds = _duration_s(session)
    with new_folder(out) as work:
        atomic_write(work / SETTINGS_FILE, settings_yaml(with_policy(config, options.policy), options.seed))
        began, machine = datetime.now(UTC), describe_machine()
        play_options = dataclasses.replace(options, config=str(work / SETTINGS_FILE))
        if options.virtual:
            play_in_virtual_time(session, seconds, play_options, work, show)
        else:
            with played_in_real_time(session, seconds, play_options, work, show, pages):
                pass
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
    """Read a finished trial. Raises UsageError or DataError where `folder` is none, or its session has
    changed."""
    path = folder / RUN_FILE
    if not path.is_file():
        raise UsageError(f"{folder}: has no {RUN_FILE}; not a folder of `share evaluate run`")
    record = read_json(path)
    try:
        options = from_mapping(
            RunOptions, {name: record[name] for name in _OPTION_NAMES if name in record}, "terms"
        )
    except ConfigError as error:
        raise DataError(f"{path}: is damaged: {error}") from None
    session, texts = record.get("session"), [record.get(name) for name in ("error_model", "code")]
    if not isinstance(session, str) or not all(isinstance(one, str | None) for one in texts):
        raise DataError(f"{path}: is damaged: session, error_model or code is not text")
    if not Path(session).is_dir():
        raise UsageError(
            f"{path}: its session {session}, which has the truth, does not exist any more; restore it"
        )
    opened = read_session(Path(session))
    if record.get("provenance", to_plain(opened.provenance)) != to_plain(opened.provenance):
        raise UsageError(
            f"{path}: its session {session} was generated again since, with another truth; play it again"
        )
    return Trial(folder, opened, options, record)


def settings_yaml(config: Config, seed: int) -> str:
    """Return the text of config.yaml: `config`, with the scheduler's seed shifted by `seed`."""
    import yaml

    control = config.control
    seeded = dataclasses.replace(control, random_seed=control.random_seed + seed)
    text: str = yaml.safe_dump(to_mapping(dataclasses.replace(config, control=seeded)), sort_keys=False)
    return text


def _duration_s(session: Session) -> float:
    """Return the time from the first image of all agents to the last, by the session's clock."""
    first, last = [], []
    for name, agent in session.agents.items():
        path = session.folder / "truth" / f"{name}.tum"
        if not path.is_file():
            raise UsageError(f"{path}: no such file; scoring needs the truth of all agents")
        stamps_ns = open_source(f"{session.folder}/{name}").stamps()[CAM0]
        first.append(int(stamps_ns[0]) - agent.clock_offset_ns)
        last.append(int(stamps_ns.max()) - agent.clock_offset_ns)
    return (max(last) - min(first)) / 1e9
