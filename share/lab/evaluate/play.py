"""A session in real time on this machine: an edge and an agent per recording, as processes of their own."""

from __future__ import annotations

import json
import os
import re
import subprocess
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from share.config import STREAMED
from share.errors import DataError, ShareError
from share.files.json_file import read_json
from share.files.line_file import GrowingFile
from share.files.reading import LOG, read_bytes
from share.files.writing import writable_dir
from share.lab.evaluate.together import Together
from share.metrics.ate import Ate, JointAte, ate, joint_ate
from share.net.emulated import Links
from share.recordings.session import Session
from share.recordings.trajectory import Trajectory, read_tum
from share.runtime.commands import child, end

START_S = 20.0  # how long the edge may take until it listens
PATIENCE_S = 60.0  # how much longer than its recording an agent may take
_LOOK_S = 0.5  # between two looks at what a run has come to
_AFTER_AGENTS = 10  # niceness: a tenth of an agent's part of a core that both want
Processes = dict[str, subprocess.Popen[bytes]]


@dataclass(frozen=True)
class Progress:
    """For the live line: frames per agent, agents that share a map with another, corrections sent."""

    frames: dict[str, int]
    joined: int
    corrections: int

    def __str__(self) -> str:
        frames = "  ".join(f"{name} {count}" for name, count in self.frames.items())
        return f"frames: {frames}   in a shared map: {self.joined}   corrections: {self.corrections}"


@dataclass(frozen=True)
class Terms:
    """On which a session is played. link: emulated networks, as `Links` reads them; seed: of what they do.
    true_error: agents tell the edge how wrong they are by the truth. virtual: in virtual time
    (`share.lab.evaluate.virtual`), where things take as long as in the run in folder `costs`. agents_first:
    the edge gets what the agents leave of this machine, as if they had their own. config: a file, for all."""

    policy: str
    link: str | None = None
    seed: int = 0
    true_error: bool = False
    virtual: bool = False
    agents_first: bool = False
    costs: str | None = None
    config: str | None = None

    def of_edge(self) -> tuple[str, ...]:
        """What `share edge` is told."""
        return ("--policy", self.policy, *self._settings())

    def of_agent(self, number: int, link: str | None) -> tuple[str, ...]:
        """What `share agent` is told, each another seed. link: its own."""
        shaped = () if link is None else ("--link", link, "--link-seed", str(1000 * self.seed + number))
        flags = (("--true-error", self.true_error), ("--streamed", self.policy == STREAMED))
        return (*shaped, *(flag for flag, wanted in flags if wanted), *self._settings())

    def _settings(self) -> tuple[str, ...]:
        return () if self.config is None else ("--config", self.config)


def play(
    session: Session, seconds: float, terms: Terms, out: Path, show: Callable[[Progress], None]
) -> dict[str, Path]:
    """Runs `session` in real time. The folder of each agent's files, by name.

    Raises ShareError naming the process that failed and what it said last, UsageError for a link of nobody.
    """
    links = Links.parse(terms.link)
    links.check(session.agents)
    folders = {name: out / name for name in session.agents}
    logs = {name: out / f"{name}.log" for name in (*folders, "edge")}
    writable_dir(out, *(log.name for log in logs.values()))
    with ExitStack() as stack:
        bind = ("--bind", "tcp://127.0.0.1:0", "--out", str(out / "edge"), *terms.of_edge())
        edge = stack.enter_context(child(logs["edge"], "edge", *bind))
        if terms.agents_first:
            os.setpriority(os.PRIO_PROCESS, edge.pid, _AFTER_AGENTS)  # before it has processes of its own
        address = _address(edge, logs["edge"])
        agents: Processes = {}
        for number, (name, agent) in enumerate(session.agents.items()):
            who = (f"{session.folder}/{name}", "--name", name, "--kind", str(agent.kind))
            where = ("--edge", address, "--out", str(folders[name]))
            agents[name] = stack.enter_context(
                child(logs[name], "agent", *who, *where, *terms.of_agent(number, links.of(name)))
            )
        _watch(agents, _Onlooker(folders, out / "edge" / "events.jsonl"), seconds + PATIENCE_S, show)
        for name, process in {**agents, "edge": edge}.items():
            if end(process) != 0:
                raise ShareError(f"{name} failed: {_last_line(logs[name])}")
    return folders


def _address(edge: subprocess.Popen[bytes], log: Path) -> str:
    """Where the edge listens, as it says itself."""
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        found = re.search(r"listening on (tcp://\S+?),", _said(log))
        if found:
            return found[1]
        if edge.poll() is not None:
            break
        time.sleep(0.05)
    raise ShareError(f"the edge did not start: {_last_line(log)}")


def _watch(agents: Processes, onlooker: _Onlooker, limit_s: float, show: Callable[[Progress], None]) -> None:
    """Until every agent has ended, or one has failed."""
    deadline = time.monotonic() + limit_s
    while any(process.poll() is None for process in agents.values()):
        if any(process.poll() for process in agents.values()):
            return
        if time.monotonic() > deadline:
            raise ShareError(f"the agents have not ended {PATIENCE_S:g} s after their recordings")
        show(onlooker.look())
        time.sleep(_LOOK_S)
    show(onlooker.look())


class _Onlooker:
    """How far a run is, by what its files have grown; it costs the processes that are measured next to
    nothing, however long they go on."""

    def __init__(self, folders: dict[str, Path], events: Path) -> None:
        self._odometry = {
            name: GrowingFile(folder / "odom.tum", folder / "odom.tum.partial")
            for name, folder in folders.items()
        }
        self._frames = dict.fromkeys(folders, 0)
        self._events, self._corrections, self._together = GrowingFile(events), 0, Together()

    def look(self) -> Progress:
        for name, file in self._odometry.items():
            self._frames[name] += len(file.lines())
        for line in self._events.lines():
            event = json.loads(line)
            if event["event"] == "correction":
                self._corrections += 1
                self._together.corrected(event["agent"], event["map_id"])
        return Progress(dict(self._frames), len(self._together.agents), self._corrections)


def _last_line(log: Path) -> str:
    lines = [line for line in _said(log).splitlines() if line.strip()]
    return lines[-1] if lines else "it said nothing"


def _said(log: Path) -> str:
    return read_bytes(log, LOG).decode(errors="replace")


# ---- What agents of one session came to, against their truth: for `share demo` and `share evaluate`.


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
