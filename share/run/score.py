"""What agents of one session came to, against their truth: for `share demo` and `share evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from share.errors import DataError
from share.io.json_file import read_json
from share.io.session import Session
from share.io.trajectory import Trajectory, read_tum
from share.metrics.ate import Ate, JointAte, ate, joint_ate


@dataclass(frozen=True, eq=False)
class AgentScore:
    """odometry: ATE of odom.tum alone, SE3-aligned. report: its report.json. map: its map.tum."""

    report: dict[str, Any]
    odometry: Ate | None
    map: Trajectory | None
    truth: Trajectory


@dataclass(frozen=True, eq=False)
class SessionScore:
    """joint: map.tum of all agents in the largest map, one alignment; None where no two are in one, since
    everybody has a map of its own from its first moments on. An agent that plays alone is all there are."""

    agents: dict[str, AgentScore]
    joint: JointAte | None


def score(session: Session, folders: dict[str, Path]) -> SessionScore:
    """Reads what `share agent --out` left in `folders`. Raises DataError on damaged files."""
    agents = {}
    for name, folder in folders.items():
        truth = read_tum(session.folder / "truth" / f"{name}.tum")
        report = read_json(folder / "report.json")
        odometry = _ate(_trajectory(folder / "odom.tum"), truth)
        agents[name] = AgentScore(report, odometry, _trajectory(folder / "map.tum"), truth)
    return SessionScore(agents, _joint(agents))


def _trajectory(path: Path) -> Trajectory | None:
    return read_tum(path) if path.stat().st_size else None


def _ate(estimate: Trajectory | None, truth: Trajectory) -> Ate | None:
    try:
        return None if estimate is None else ate(estimate, truth)
    except DataError:  # too few poses
        return None


def _joint(agents: dict[str, AgentScore]) -> JointAte | None:
    """Of the map that most agents were in when their last pose was told."""
    members: dict[str, list[str]] = {}
    for name, agent in agents.items():
        if agent.map is not None:
            by_report = agent.report["protocol"]["map_id"]  # of runs before map_tum was written
            members.setdefault(agent.report.get("map_tum", by_report), []).append(name)
    if not members:
        return None
    largest = max(members.values(), key=len)
    if len(largest) < min(2, len(agents)):
        return None
    pairs = {name: (agents[name].map, agents[name].truth) for name in largest}
    try:
        return joint_ate({name: (m, t) for name, (m, t) in pairs.items() if m is not None})
    except DataError:
        return None
