"""Play a session in real time on this machine: an edge and one agent per recording, each in a process of its
own."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from share import child_processes
from share.config import STREAMED
from share.errors import ShareError
from share.files.line_file import GrowingFile
from share.files.reading import MAX_LOG_BYTES, read_bytes
from share.files.writing import open_new, writable_dir
from share.lab.evaluate.emulated_network import LinkAssignment
from share.recordings.session import Session


class MapMembership:
    """`map_ids`: the map of each agent's last correction, by agent."""

    def __init__(self) -> None:
        self.map_ids: dict[str, str] = {}

    def add_correction(self, agent: str, map_id: str) -> None:
        """Add the next correction, in the order in which they are sent."""
        self.map_ids[agent] = map_id

    @property
    def sharing_agents(self) -> list[str]:
        """Agents that are not alone in their map."""
        members = Counter(self.map_ids.values())
        return [agent for agent, map_id in self.map_ids.items() if members[map_id] > 1]


EDGE_START_TIMEOUT_S = 20.0  # until the edge listens
AGENT_GRACE_S = 60.0  # how much longer than its recording an agent may run
_POLL_S = 0.5
_STOP_S = 30.0  # until a child that was asked to end is killed; on a busy machine an edge took 10 s
_MERGE_EVENTS = ("maps merged", "merge undone")
_EDGE_NICENESS = 10  # on a shared core, about a tenth of an agent's time
Processes = dict[str, subprocess.Popen[bytes]]


@dataclass(frozen=True)
class Progress:
    """Progress of a run, for the live line: frames per agent, agents that share a map, corrections sent.

    merges: a line for each merge of maps so far; its time is since the first agent joined.
    """

    frames: dict[str, int]
    joined: int
    corrections: int
    merges: tuple[str, ...] = ()

    def __str__(self) -> str:
        frames = "  ".join(f"{name} {count}" for name, count in self.frames.items())
        return f"frames: {frames}   in a shared map: {self.joined}   corrections: {self.corrections}"


@dataclass(frozen=True)
class RunOptions:
    """How to play a session.

    `link`: emulated networks, in the syntax of `LinkAssignment`. `seed`: of the networks' random numbers.
    `true_error`: agents send their true tracking error in place of an estimate. `virtual`: play in virtual
    time (`share.lab.evaluate.virtual_time`), with delays measured in the run in folder `costs`, if given.
    `agents_first`: run the edge at low priority, so that it takes only the CPU time that the agents leave.
    `config`: a configuration file for edge and agents.
    """

    policy: str
    link: str | None = None
    seed: int = 0
    true_error: bool = False
    virtual: bool = False
    agents_first: bool = False
    costs: str | None = None
    config: str | None = None

    def edge_arguments(self) -> tuple[str, ...]:
        """Return arguments of `share edge`."""
        return ("--policy", self.policy, *self._config_arguments())

    def agent_arguments(self, number: int, link: str | None) -> tuple[str, ...]:
        """Return arguments of `share agent` number `number` on its `link`. Each agent has a different link
        seed."""
        link_arguments = (
            () if link is None else ("--link", link, "--link-seed", str(1000 * self.seed + number))
        )
        flags = (("--true-error", self.true_error), ("--streamed", self.policy == STREAMED))
        return (*link_arguments, *(flag for flag, is_on in flags if is_on), *self._config_arguments())

    def _config_arguments(self) -> tuple[str, ...]:
        return () if self.config is None else ("--config", self.config)


@dataclass(frozen=True)
class RunPages:
    """The pages that the edge of a run serves. has_view: the live room beside the status page. show: is
    called with a line with the address of each page."""

    has_view: bool
    show: Callable[[str], None]

    def edge_arguments(self) -> tuple[str, ...]:
        return ("--http", "0", *(("--view", "0") if self.has_view else ()))

    def show_addresses(self, log: str) -> None:
        for line in log.splitlines():
            if line.startswith(PAGE_LINES):
                self.show(line)


PAGE_LINES = ("status at ", "live room at ")  # of the edge


@contextmanager
def played_in_real_time(
    session: Session,
    seconds: float,
    options: RunOptions,
    out: Path,
    show: Callable[[Progress], None],
    pages: RunPages | None = None,
) -> Iterator[dict[str, Path]]:
    """Run `session` in real time until its agents have ended; the edge serves its pages until the block is
    left. Yields the folder of each agent's files, by name.

    pages: what to serve; None: nothing.

    Raises ShareError with the process that failed and the last line of its log, UsageError for a link of an
    unknown agent.
    """
    links = LinkAssignment.parse(options.link)
    links.check(session.agents)
    folders = {name: out / name for name in session.agents}
    logs = {name: out / f"{name}.log" for name in (*folders, "edge")}
    writable_dir(out, *(log.name for log in logs.values()))
    with ExitStack() as stack:
        served = () if pages is None else pages.edge_arguments()
        bind = ("--bind", "tcp://127.0.0.1:0", "--out", str(out / "edge"), *options.edge_arguments(), *served)
        edge = stack.enter_context(running_child(logs["edge"], "edge", *bind))
        if options.agents_first:
            os.setpriority(os.PRIO_PROCESS, edge.pid, _EDGE_NICENESS)  # before it starts child processes
        address = _wait_for_line(edge, logs["edge"], r"listening on (tcp://\S+?),")
        if pages is not None:
            _wait_for_line(edge, logs["edge"], f"^({PAGE_LINES[pages.has_view]}.*)\n")
            pages.show_addresses(_log_text(logs["edge"]))
        agents: Processes = {}
        for number, (name, agent) in enumerate(session.agents.items()):
            identity = (f"{session.folder}/{name}", "--name", name, "--kind", str(agent.kind))
            destination = ("--edge", address, "--out", str(folders[name]))
            terms = options.agent_arguments(number, links.name_for(name))
            child = running_child(logs[name], "agent", *identity, *destination, *terms)
            agents[name] = stack.enter_context(child)
        _watch(agents, _RunMonitor(folders, out / "edge" / "events.jsonl"), seconds + AGENT_GRACE_S, show)
        _stop_children(agents, logs)
        yield folders
        _stop_children({"edge": edge}, logs)


def _stop_children(processes: Processes, logs: dict[str, Path]) -> None:
    """Stop processes. Raises ShareError if one of them failed."""
    for name, process in processes.items():
        if code := stop_child(process):
            raise ShareError(f"{name} failed: {_why_it_failed(code, logs[name])}")


def _wait_for_line(edge: subprocess.Popen[bytes], log: Path, pattern: str) -> str:
    """Return what the first group of `pattern` matches in the edge's log. Raises ShareError if it does not
    start."""
    deadline = time.monotonic() + EDGE_START_TIMEOUT_S
    while time.monotonic() < deadline:
        match = re.search(pattern, _log_text(log), re.MULTILINE)
        if match:
            return match[1]
        if edge.poll() is not None:
            break
        time.sleep(0.05)
    raise ShareError(f"the edge did not start: {_last_line(log)}")


def _watch(agents: Processes, monitor: _RunMonitor, limit_s: float, show: Callable[[Progress], None]) -> None:
    """Wait until all agents have ended or one has failed. Raises ShareError after `limit_s`."""
    deadline = time.monotonic() + limit_s
    while any(process.poll() is None for process in agents.values()):
        if any(process.poll() for process in agents.values()):
            return
        if time.monotonic() > deadline:
            raise ShareError(f"agents still run {AGENT_GRACE_S:g} s after the end of their recordings")
        show(monitor.progress())
        time.sleep(_POLL_S)
    show(monitor.progress())


class _RunMonitor:
    """Follow a run by the growth of its output files, at next to no cost for the measured processes."""

    def __init__(self, folders: dict[str, Path], events: Path) -> None:
        self._odometry = {
            name: GrowingFile(folder / "odom.tum", folder / "odom.tum.partial")
            for name, folder in folders.items()
        }
        self._frames = dict.fromkeys(folders, 0)
        self._events, self._corrections, self._membership = GrowingFile(events), 0, MapMembership()
        self._merges: tuple[str, ...] = ()
        self._first_s: float | None = None  # when the first agent joined, as in `join_times`

    def progress(self) -> Progress:
        for name, file in self._odometry.items():
            self._frames[name] += len(file.new_lines())
        for line in self._events.new_lines():
            event = json.loads(line)
            if event["event"] == "agent joined" and self._first_s is None:
                self._first_s = event["t_s"]
            if event["event"] == "correction":
                self._corrections += 1
                self._membership.add_correction(event["agent"], event["map_id"])
            elif event["event"] in _MERGE_EVENTS:
                since_s = event["t_s"] - (self._first_s or 0.0)
                text = f"{since_s:7.1f} s {event['event']}: {event['agent']}: {event['reason']}"
                self._merges = (*self._merges, text)
        sharing = len(self._membership.sharing_agents)
        return Progress(dict(self._frames), sharing, self._corrections, self._merges)


def _why_it_failed(code: int, log: Path) -> str:
    if code == -signal.SIGKILL:
        return f"it was killed: out of memory, or it did not end within {_STOP_S:.0f} s on this busy machine"
    return _last_line(log)


def _last_line(log: Path) -> str:
    lines = [line for line in _log_text(log).splitlines() if line.strip()]
    return lines[-1] if lines else "its log is empty"


def _log_text(log: Path) -> str:
    return read_bytes(log, MAX_LOG_BYTES).decode(errors="replace")


def share_command(*arguments: str) -> list[str]:
    """Return the command line that runs `share ARGUMENTS` with this program, frozen or not."""
    if getattr(sys, "frozen", False):
        return [sys.executable, *arguments]
    # -P: ignore a folder `share` in the working directory
    return [sys.executable, "-P", "-m", "share", *arguments]


@contextmanager
def running_child(log: Path, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run `share ARGUMENTS` with its output in `log`; stop it when the block is left.

    The child ends with this process, however this one ends. It is in a process group of its own: Ctrl-C in a
    terminal reaches only this process.
    """
    with open_new(log) as sink:
        process = subprocess.Popen(
            share_command(*arguments),
            stdin=subprocess.DEVNULL,
            stdout=sink,
            stderr=subprocess.STDOUT,
            env=child_processes.child_environment(),
            process_group=0,
        )
        try:
            yield process
        finally:
            stop_child(process)


def stop_child(process: subprocess.Popen[bytes]) -> int:
    """Send SIGINT, kill after `_STOP_S`, and return the exit code."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        return process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()
