"""A session: several agents in one place at one time, in one folder.

session.yaml     agents, kinds, sensors, calibration, clock offsets, provenance
NAME.mcap        one recording an agent
truth/NAME.tum   pose of the body in the world, if known
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from share.errors import ConfigError, UsageError
from share.io.files import atomic_write
from share.io.section import Section, read_yaml
from share.types import AgentKind

SESSION = "session.yaml"
VERSION = 1


@dataclass(frozen=True)
class SessionAgent:
    """sensors: the rig's kind, e.g. `stereo+imu`. calibration: file or folder below the session's folder,
    or "" for what the recording carries. clock_offset_ms: what to add to its stamps for session time."""

    kind: AgentKind
    sensors: str
    calibration: str = ""
    clock_offset_ms: float = 0.0


@dataclass(frozen=True)
class Session:
    """agents by name; provenance: where it comes from, plain values for a person and a paper."""

    agents: dict[str, SessionAgent]
    provenance: dict[str, Any] = field(default_factory=dict)


def is_session(folder: Path) -> bool:
    return (folder / SESSION).is_file()


def write_session(folder: Path, session: Session) -> None:
    """Write session.yaml into `folder`. Raises UsageError if that cannot be done."""
    import yaml

    agents = {name: {**asdict(agent), "kind": str(agent.kind)} for name, agent in session.agents.items()}
    data = {"version": VERSION, "agents": agents, "provenance": session.provenance}
    atomic_write(folder / SESSION, yaml.safe_dump(data, sort_keys=False, allow_unicode=True))


def read_session(folder: Path) -> Session:
    """Raises ConfigError naming the key that is wrong."""
    top = read_yaml(folder / SESSION)
    version = top.number("version")
    if version != VERSION:
        raise ConfigError(
            f"{top.where}: version {version:g} is not known; this SHARE reads version {VERSION}"
        )
    agents = top.section("agents")
    if not agents.data:
        raise ConfigError(f"{agents.where}: names nobody")
    provenance = top.section("provenance").data if "provenance" in top else {}
    return Session({str(name): _agent(agents.section(name)) for name in agents.data}, provenance)


def recording_of(folder: Path, name: str) -> tuple[Path, Path | None]:
    """(recording, calibration or None) of agent `name`. Raises UsageError if there is no such agent."""
    agents = read_session(folder).agents
    if name not in agents:
        raise UsageError(f"{folder}: has no agent '{name}'; it has {', '.join(agents)}")
    recording = folder / f"{name}.mcap"
    if not recording.is_file():
        raise UsageError(f"{recording}: no such file, although {folder / SESSION} names it")
    calibration = agents[name].calibration
    return recording, folder / calibration if calibration else None


def _agent(section: Section) -> SessionAgent:
    known = SessionAgent.__dataclass_fields__
    unknown = [key for key in section.data if key not in known]
    if unknown:
        raise ConfigError(f"{section.where}: unknown key '{unknown[0]}'; known: {', '.join(known)}")
    kind = section.text("kind")
    if kind not in list(AgentKind):
        raise ConfigError(f"{section.where}: kind '{kind}' is not known; known: {', '.join(AgentKind)}")
    return SessionAgent(
        AgentKind(kind),
        section.text("sensors", ""),
        section.text("calibration", ""),
        section.number("clock_offset_ms", 0.0),
    )
