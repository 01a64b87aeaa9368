"""Read a session: a folder with the recordings of several agents in one place at one time.

session.yaml     agents, kinds, sensors, calibration, clock offsets, provenance
NAME.mcap        the recording of each agent
truth/NAME.tum   poses of its body in the world, if known
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from share.agent_names import checked_name
from share.checks import MAX_STAMP_NS
from share.errors import ConfigError, UsageError
from share.files.reading import path_inside
from share.files.yaml_file import Section, read_yaml
from share.recordings.calibration import Calibration, calibration_from_kalibr, read_calibration
from share.types import AgentKind

SESSION_FILE = "session.yaml"
SCHEMA = 1
AGENT_NAME_RULE = "1 to 64 letters, digits, '_', '-' or '.'"
_AGENT_KEYS = ("kind", "sensors", "rate_hz", "clock_offset_ns", "calibration")


@dataclass(frozen=True, eq=False)
class SessionAgent:
    """One agent of a session. sensors: the rig's kind, e.g. `stereo+imu`. clock_offset_ns: stamps in its
    files minus session time. calibration: None to use the recording's own."""

    kind: AgentKind
    sensors: str
    rate_hz: float
    clock_offset_ns: int
    calibration: Calibration | None


@dataclass(frozen=True, eq=False)
class Session:
    """A session. agents: by name. provenance: how it was made, as plain values."""

    folder: Path
    agents: dict[str, SessionAgent]
    provenance: dict[str, Any]

    def recording(self, name: str) -> Path:
        """Return the recording of agent `name`. Raises UsageError if there is none."""
        if name not in self.agents:
            raise UsageError(f"{self.folder}: no agent '{name}'; agents: {', '.join(self.agents)}")
        recording = self.folder / f"{name}.mcap"
        if not recording.is_file():
            raise UsageError(f"{recording}: no such file, although {self.folder / SESSION_FILE} names it")
        return recording


def is_agent_name(text: str) -> bool:
    """Return whether `text` is a valid agent name, and so a valid file name."""
    try:
        checked_name(text)
    except ValueError:
        return False
    return re.fullmatch(r"[\w.-]+", text) is not None and not text.startswith(".")


def is_session(folder: Path) -> bool:
    return (folder / SESSION_FILE).is_file()


def read_session(folder: Path) -> Session:
    """Read a session. Raises ConfigError that names a wrong key, UsageError if it is not a session."""
    if not is_session(folder):
        if is_session(folder.parent):
            raise UsageError(f"{folder}: is one agent of a session; give the session: {folder.parent}")
        what = f"has no {SESSION_FILE}" if folder.is_dir() else "there is no such folder"
        raise UsageError(f"{folder}: {what}; give a session made by `share emulate` or `share dataset align`")
    top = read_yaml(folder / SESSION_FILE)
    schema = top.number("schema")
    if schema != SCHEMA:
        raise ConfigError(f"{top.where}: schema {schema:g} is not known; this SHARE reads schema {SCHEMA}")
    agents = top.section("agents")
    if not agents.data:
        raise ConfigError(f"{agents.where}: lists no agents")
    provenance = top.section("provenance").data if "provenance" in top else {}
    session_agents = {
        _checked_agent_name(name, agents.where): _read_agent(agents.section(name), folder)
        for name in agents.data
    }
    return Session(folder, session_agents, provenance)


def _checked_agent_name(name: Any, where: str) -> str:
    """Return an agent's name. Raises ConfigError if it cannot be a file name."""
    if not isinstance(name, str | int) or not is_agent_name(str(name)):
        raise ConfigError(f"{where}: '{name!s:.80}' is not a valid agent name; use {AGENT_NAME_RULE}")
    return str(name)


def _read_agent(section: Section, folder: Path) -> SessionAgent:
    unknown = [key for key in section.data if key not in _AGENT_KEYS]
    if unknown:
        raise ConfigError(f"{section.where}: unknown key '{unknown[0]}'; known: {', '.join(_AGENT_KEYS)}")
    kind = section.text("kind")
    if kind not in list(AgentKind):
        raise ConfigError(f"{section.where}: kind '{kind}' is not known; known: {', '.join(AgentKind)}")
    offset = section.data.get("clock_offset_ns", 0)
    if type(offset) is not int or abs(offset) >= MAX_STAMP_NS:
        raise ConfigError(f"{section.where}: clock_offset_ns: expected whole nanoseconds, found {offset!r}")
    return SessionAgent(
        AgentKind(kind),
        section.text("sensors", ""),
        section.number("rate_hz", 0.0),
        offset,
        _read_agent_calibration(section, folder) if "calibration" in section else None,
    )


def _read_agent_calibration(section: Section, folder: Path) -> Calibration:
    """Read `calibration`: a path in the session's folder, or Kalibr's sections (cam0, cam1, depth, imu0)."""
    if isinstance(section.get("calibration"), str):
        return read_calibration(path_inside(folder, section.text("calibration"), section.where))
    chain = section.section("calibration")
    return calibration_from_kalibr(chain, chain.section("imu0") if "imu0" in chain else None)
