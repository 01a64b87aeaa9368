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
from share.files.reading import MAX_LOG_BYTES, read_bytes
from share.files.writing import writable_dir
from share.lab.evaluate.map_membership import MapMembership
from share.metrics.ate import Ate, JointAte, ate, joint_ate
from share.net.emulated_link import LinkAssignment
from share.recordings.session import Session
from share.recordings.trajectory import Trajectory, read_tum
from share.runtime.child_commands import running_child, stop_child

EDGE_START_TIMEOUT_S = 20.0  # how long the edge may take until it listens
AGENT_GRACE_S = 60.0  # how much longer than its recording an agent may take
_POLL_S = 0.5  # between two looks at what a run has come to
_EDGE_NICENESS = 10  # niceness: a tenth of an agent's part of a core that both want
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
class RunOptions:
    """On which a session is played. link: emulated networks, as `LinkAssignment` reads them; seed: of what
    they do.
    true_error: agents tell the edge how wrong they are by the truth. virtual: in virtual time
    (`share.lab.evaluate.virtual_time`), where things take as long as in the run in folder `costs`.
    agents_first:
    the edge gets what the agents leave of this machine, as if they had their own. config: a file, for all."""

    policy: str
    link: str | None = None
    seed: int = 0
    true_error: bool = False
    virtual: bool = False
    agents_first: bool = False
    costs: str | None = None
    config: str | None = None

    def edge_arguments(self) -> tuple[str, ...]:
        """What `share edge` is told."""
        return ("--policy", self.policy, *self._config_arguments())

    def agent_arguments(self, number: int, link: str | None) -> tuple[str, ...]:
        """What `share agent` is told, each another seed. link: its own."""
        link_arguments = (
            () if link is None else ("--link", link, "--link-seed", str(1000 * self.seed + number))
        )
        flags = (("--true-error", self.true_error), ("--streamed", self.policy == STREAMED))
        return (*link_arguments, *(flag for flag, is_on in flags if is_on), *self._config_arguments())

    def _config_arguments(self) -> tuple[str, ...]:
        return () if self.config is None else ("--config", self.config)


def play_in_real_time(
    session: Session, seconds: float, options: RunOptions, out: Path, show: Callable[[Progress], None]
) -> dict[str, Path]:
    """Runs `session` in real time. The folder of each agent's files, by name.

    Raises ShareError naming the process that failed and what it said last, UsageError for a link of nobody.
    """
    links = LinkAssignment.parse(options.link)
    links.check(session.agents)
    folders = {name: out / name for name in session.agents}
    logs = {name: out / f"{name}.log" for name in (*folders, "edge")}
    writable_dir(out, *(log.name for log in logs.values()))
    with ExitStack() as stack:
        bind = ("--bind", "tcp://127.0.0.1:0", "--out", str(out / "edge"), *options.edge_arguments())
        edge = stack.enter_context(running_child(logs["edge"], "edge", *bind))
        if options.agents_first:
            os.setpriority(os.PRIO_PROCESS, edge.pid, _EDGE_NICENESS)  # before it has processes of its own
        address = _wait_for_address(edge, logs["edge"])
        agents: Processes = {}
        for number, (name, agent) in enumerate(session.agents.items()):
            identity = (f"{session.folder}/{name}", "--name", name, "--kind", str(agent.kind))
            destination = ("--edge", address, "--out", str(folders[name]))
            agents[name] = stack.enter_context(
                running_child(
                    logs[name],
                    "agent",
                    *identity,
                    *destination,
                    *options.agent_arguments(number, links.name_for(name)),
                )
            )
        _watch(agents, _RunMonitor(folders, out / "edge" / "events.jsonl"), seconds + AGENT_GRACE_S, show)
        for name, process in {**agents, "edge": edge}.items():
            if stop_child(process) != 0:
                raise ShareError(f"{name} failed: {_last_line(logs[name])}")
    return folders


def _wait_for_address(edge: subprocess.Popen[bytes], log: Path) -> str:
    """Where the edge listens, as it says itself."""
    deadline = time.monotonic() + EDGE_START_TIMEOUT_S
    while time.monotonic() < deadline:
        match = re.search(r"listening on (tcp://\S+?),", _log_text(log))
        if match:
            return match[1]
        if edge.poll() is not None:
            break
        time.sleep(0.05)
    raise ShareError(f"the edge did not start: {_last_line(log)}")


def _watch(agents: Processes, monitor: _RunMonitor, limit_s: float, show: Callable[[Progress], None]) -> None:
    """Until every agent has ended, or one has failed."""
    deadline = time.monotonic() + limit_s
    while any(process.poll() is None for process in agents.values()):
        if any(process.poll() for process in agents.values()):
            return
        if time.monotonic() > deadline:
            raise ShareError(f"the agents have not ended {AGENT_GRACE_S:g} s after their recordings")
        show(monitor.progress())
        time.sleep(_POLL_S)
    show(monitor.progress())


class _RunMonitor:
    """How far a run is, by what its files have grown; it costs the processes that are measured next to
    nothing, however long they go on."""

    def __init__(self, folders: dict[str, Path], events: Path) -> None:
        self._odometry = {
            name: GrowingFile(folder / "odom.tum", folder / "odom.tum.partial")
            for name, folder in folders.items()
        }
        self._frames = dict.fromkeys(folders, 0)
        self._events, self._corrections, self._membership = GrowingFile(events), 0, MapMembership()

    def progress(self) -> Progress:
        for name, file in self._odometry.items():
            self._frames[name] += len(file.new_lines())
        for line in self._events.new_lines():
            event = json.loads(line)
            if event["event"] == "correction":
                self._corrections += 1
                self._membership.add_correction(event["agent"], event["map_id"])
        return Progress(dict(self._frames), len(self._membership.sharing_agents), self._corrections)


def _last_line(log: Path) -> str:
    lines = [line for line in _log_text(log).splitlines() if line.strip()]
    return lines[-1] if lines else "it said nothing"


def _log_text(log: Path) -> str:
    return read_bytes(log, MAX_LOG_BYTES).decode(errors="replace")


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


def score_session(session: Session, folders: dict[str, Path]) -> SessionScore:
    """Reads what `share agent --out` left in `folders`. Raises DataError on damaged files."""
    agents = {}
    for name, folder in folders.items():
        truth = read_tum(session.folder / "truth" / f"{name}.tum")
        report = read_json(folder / "report.json")
        odometry = _ate(_trajectory(folder / "odom.tum"), truth)
        agents[name] = AgentScore(report, odometry, _trajectory(folder / "map.tum"), truth)
    return SessionScore(agents, _joint_ate(agents))


def _trajectory(path: Path) -> Trajectory | None:
    return read_tum(path) if path.stat().st_size else None


def _ate(estimate: Trajectory | None, truth: Trajectory) -> Ate | None:
    try:
        return None if estimate is None else ate(estimate, truth)
    except DataError:  # too few poses
        return None


def _joint_ate(agents: dict[str, AgentScore]) -> JointAte | None:
    """Of the map that most agents were in when their last pose was told."""
    members: dict[str, list[str]] = {}
    for name, agent in agents.items():
        if agent.map is not None:
            fallback_map = agent.report["protocol"]["map_id"]  # of runs before map_tum was written
            members.setdefault(agent.report.get("map_tum", fallback_map), []).append(name)
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
