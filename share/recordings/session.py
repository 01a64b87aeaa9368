"""A session: several agents in one place at one time, in one folder.

session.yaml     agents, kinds, sensors, calibration, clock offsets, provenance
NAME.mcap        one recording an agent
truth/NAME.tum   pose of the body in the world, if known
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from share.agent_names import checked_name
from share.errors import ConfigError, UsageError
from share.files.reading import path_inside
from share.files.yaml_file import Section, read_yaml
from share.recordings.calibration import Calibration, calibration_from_kalibr, read_calibration
from share.types import AgentKind

SESSION_FILE = "session.yaml"
SCHEMA = 1
AGENT_NAME_RULE = "1 to 64 letters, digits, '_', '-' or '.'"
_MAX_OFFSET_NS = 2**62  # of a clock's offset
_AGENT_KEYS = ("kind", "sensors", "rate_hz", "clock_offset_ns", "calibration")


@dataclass(frozen=True, eq=False)
class SessionAgent:
    """sensors: the rig's kind, e.g. `stereo+imu`. A stamp in its files is session time + clock_offset_ns.
    calibration: None where the recording's own is to be used."""

    kind: AgentKind
    sensors: str
    rate_hz: float
    clock_offset_ns: int
    calibration: Calibration | None


@dataclass(frozen=True, eq=False)
class Session:
    """agents by name; provenance: where it comes from, plain values for a person and a paper."""

    folder: Path
    agents: dict[str, SessionAgent]
    provenance: dict[str, Any]

    def recording(self, name: str) -> Path:
        """The recording of agent `name`. Raises UsageError if there is none."""
        if name not in self.agents:
            raise UsageError(f"{self.folder}: has no agent '{name}'; it has {', '.join(self.agents)}")
        recording = self.folder / f"{name}.mcap"
        if not recording.is_file():
            raise UsageError(f"{recording}: no such file, although {self.folder / SESSION_FILE} names it")
        return recording


def is_agent_name(text: str) -> bool:
    """Whether it can be an agent's, and so a file's."""
    try:
        checked_name(text)
    except ValueError:
        return False
    return re.fullmatch(r"[\w.-]+", text) is not None and not text.startswith(".")


def is_session(folder: Path) -> bool:
    return (folder / SESSION_FILE).is_file()


def read_session(folder: Path) -> Session:
    """Raises ConfigError naming the key that is wrong, UsageError where it is no session."""
    if not is_session(folder):
        what = f"has no {SESSION_FILE}" if folder.is_dir() else "there is no such folder"
        raise UsageError(f"{folder}: {what}; give a session, by `share emulate` or `share dataset align`")
    top = read_yaml(folder / SESSION_FILE)
    schema = top.number("schema")
    if schema != SCHEMA:
        raise ConfigError(f"{top.where}: schema {schema:g} is not known; this SHARE reads schema {SCHEMA}")
    agents = top.section("agents")
    if not agents.data:
        raise ConfigError(f"{agents.where}: names nobody")
    provenance = top.section("provenance").data if "provenance" in top else {}
    session_agents = {
        _checked_agent_name(name, agents.where): _read_agent(agents.section(name), folder)
        for name in agents.data
    }
    return Session(folder, session_agents, provenance)


def _checked_agent_name(name: Any, where: str) -> str:
    """That of an agent, which its files have too. Raises ConfigError."""
    if not isinstance(name, str | int) or not is_agent_name(str(name)):
        raise ConfigError(f"{where}: '{name!s:.80}' is no name of an agent: use {AGENT_NAME_RULE}")
    return str(name)


def _read_agent(section: Section, folder: Path) -> SessionAgent:
    unknown = [key for key in section.data if key not in _AGENT_KEYS]
    if unknown:
        raise ConfigError(f"{section.where}: unknown key '{unknown[0]}'; known: {', '.join(_AGENT_KEYS)}")
    kind = section.text("kind")
    if kind not in list(AgentKind):
        raise ConfigError(f"{section.where}: kind '{kind}' is not known; known: {', '.join(AgentKind)}")
    offset = section.data.get("clock_offset_ns", 0)
    if type(offset) is not int or abs(offset) >= _MAX_OFFSET_NS:
        raise ConfigError(f"{section.where}: clock_offset_ns: expected whole nanoseconds, found {offset!r}")
    return SessionAgent(
        AgentKind(kind),
        section.text("sensors", ""),
        section.number("rate_hz", 0.0),
        offset,
        _read_agent_calibration(section, folder) if "calibration" in section else None,
    )


def _read_agent_calibration(section: Section, folder: Path) -> Calibration:
    """A file or folder below the session's, or Kalibr's chains written out: cam0, cam1, depth, imu0."""
    if isinstance(section.get("calibration"), str):
        return read_calibration(path_inside(folder, section.text("calibration"), section.where))
    chain = section.section("calibration")
    return calibration_from_kalibr(chain, chain.section("imu0") if "imu0" in chain else None)
