"""Faults beside honest agents: processes killed and stopped, a bad network, clocks that are set, a full disk.

After each: what was acknowledged is in the map's file, everything is acknowledged in the end, both agents are
in one map, and no process is left behind.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import harness
import pytest
from harness import EdgeProgram, HonestAgents, Result, Setup, until
from helpers.preloaded import WallClock
from relay import Relay, Weather

SEED = 20261126
MAP = Setup(map=True)


@dataclass
class Room:
    """An edge with a map file and two honest agents; the edge can be started again."""

    folder: Path
    result: Result
    env: dict[str, str] | None = None
    relay: Relay | None = None
    map_folder: Path | None = None
    strays: list[int] = field(default_factory=list)

    def __enter__(self) -> Room:
        self.edge = EdgeProgram(self.folder, MAP, env=self.env, map_folder=self.map_folder)
        address = self.edge.address
        if self.relay is not None:
            self.relay.target = address
            address = self.relay.start()
        self.address = address
        self.generation = 0
        self.begin_agents()
        return self

    def begin_agents(self, env: dict[str, str] | None = None) -> None:
        self.honest = HonestAgents(self.address, self.folder / f"honest{self.generation}.log", env=env)
        self.generation += 1
        self.honest.wait_for("welcomed", 60)

    def __exit__(self, *error: object) -> None:
        for program in (self.honest, self.edge):
            program.kill()
        if self.relay is not None:
            self.relay.close()

    def restart_edge(self) -> None:
        self.edge = EdgeProgram(
            self.folder, MAP, bind=self.edge.bound, env=self.env, map_folder=self.map_folder
        )

    def pid(self, role: str) -> int:
        if role == "agents":
            return self.honest.process.pid
        return int(until(f"a {role}", lambda: self._roles().get(role), 30))

    def _roles(self) -> dict[str, int]:
        return self.edge.roles() if self.edge.running else {}

    def conclude(self) -> None:
        """All ended in good order; the judgement."""
        if self.relay is not None:
            self.relay.weather = Weather()
        self._wait_for_one_map()
        agents, result = self.honest.finish(), self.result
        self.strays += harness.family(self.edge.process.pid)
        code = self.edge.interrupt()
        result.expect(code == 0, f"the edge's exit code: {code}: {self.edge.said[-300:]}")
        for agent in agents:
            name, open_ = agent["name"], agent["open"]
            result.expect(agent["error"] is None, f"{name}: {agent['error']}")
            result.expect(
                not open_ and not agent["drop_oldest"], f"{name}: {open_} not acknowledged in the end"
            )
            result.figures[name] = {k: agent[k] for k in ("keyframes", "open", "sessions", "map")}
        maps = {agent["map"] for agent in agents}
        result.expect(len(maps) == 1, f"in {len(maps)} maps in the end: {maps}")
        self.compare_acknowledged()
        left = harness.left_of(self.strays)
        result.expect(not left, f"left behind: processes {left}")

    def _wait_for_one_map(self, seconds: float = 40.0) -> None:
        """Until the edge has both in one map; whether their own last words agree is judged after."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            with contextlib.suppress(OSError, ValueError):
                agents = self.edge.snapshot()["agents"]
                maps = {agents.get(name, {}).get("map_id") for name in ("hope", "faith")}
                if len(maps) == 1 and maps != {None}:
                    time.sleep(5.0)  # until a correction reaches them, or the next if it was lost
                    return
            time.sleep(0.3)

    def compare_acknowledged(self) -> None:
        """Every acknowledgement that any agent ever got, with the file."""
        assert self.edge.map is not None
        kept = harness.kept_by_run(self.edge.map)
        acked = missing = 0
        for log in self.folder.glob("honest*.acks"):
            for name, run_id, number in (line.split() for line in log.read_text().splitlines()):
                acked += 1
                missing += int(number) not in kept.get((name, int(run_id)), ())
        self.result.figures["acknowledged"] = acked
        self.result.expect(acked > 0, "nothing was ever acknowledged")
        self.result.expect(not missing, f"{missing} of {acked} acknowledged keyframes are not in the file")


Forms = pytest.mark.parametrize(
    "times", [pytest.param(2, marks=pytest.mark.slow), pytest.param(50, marks=pytest.mark.torture)]
)


PEACE_S = 10.5  # after which a process was well, and one more run of a name may come


def needs_peace(role: str, kills: int) -> bool:
    """Whether the next one would be a crash loop, of which the edge waits out ever longer pauses, or too many
    runs of one name."""
    return kills >= 7 if role == "agents" else kills % 3 == 2


@Forms
@pytest.mark.parametrize("role", ["front", "mapper", "solver", "agents"])
def test_kill(role: str, times: int, tmp_path: Path, results: Path) -> None:
    result, draw = Result(f"kill -9 x {times}: {role}", str(MAP), SEED), random.Random(SEED)
    with Room(tmp_path, result) as room:
        for k in range(times):
            time.sleep(draw.uniform(0.5, 3.0) + (PEACE_S if needs_peace(role, k) else 0.0))
            pid = room.pid(role)
            room.strays += harness.family(pid)
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
            if role == "front":
                room.edge.process.wait()
                room.restart_edge()
            elif role == "agents":
                room.honest.kill()  # what is left of it
                room.begin_agents()
            else:
                until(f"another {role}", lambda old=pid: room.pid(role) != old, 30)
        time.sleep(5.0)
        room.conclude()
    result.write(results).check()


@pytest.mark.parametrize(
    "seconds", [pytest.param(4.0, marks=pytest.mark.slow), pytest.param(10.0, marks=pytest.mark.torture)]
)
@pytest.mark.parametrize("role", ["front", "mapper", "solver", "agents"])
def test_stop_and_go_on(role: str, seconds: float, tmp_path: Path, results: Path) -> None:
    result = Result(f"SIGSTOP {seconds:g} s: {role}", str(MAP), SEED)
    with Room(tmp_path, result) as room:
        time.sleep(3.0)
        pid = room.pid(role)
        os.kill(pid, signal.SIGSTOP)
        time.sleep(seconds)
        os.kill(pid, signal.SIGCONT)
        time.sleep(5.0)
        room.conclude()
    result.write(results).check()


WEATHERS = {
    "loss": Weather(loss=0.2),
    "doubled and overtaken": Weather(twice=0.2, late=0.4),
    "all of it": Weather(loss=0.2, twice=0.1, late=0.25, late_s=0.5),
}


@pytest.mark.parametrize(
    "seconds", [pytest.param(10.0, marks=pytest.mark.slow), pytest.param(60.0, marks=pytest.mark.torture)]
)
@pytest.mark.parametrize("weather", WEATHERS)
def test_bad_network(weather: str, seconds: float, tmp_path: Path, results: Path) -> None:
    result = Result(f"network: {weather}", str(MAP), SEED)
    relay = Relay("", WEATHERS[weather], SEED)
    with Room(tmp_path, result, relay=relay) as room:
        time.sleep(seconds)
        result.figures["relay"] = dict(relay.counts)
        room.conclude()
    result.write(results).check()


@pytest.mark.parametrize(
    "seconds", [pytest.param(12.0, marks=pytest.mark.slow), pytest.param(60.0, marks=pytest.mark.torture)]
)
@pytest.mark.parametrize("how", ["cut", "blind"])
def test_broken_connections(how: str, seconds: float, tmp_path: Path, results: Path) -> None:
    """Closed every other second; or standing while nothing goes by for 5 s."""
    result = Result(f"connections {how}", str(MAP), SEED)
    relay = Relay("", seed=SEED)
    with Room(tmp_path, result, relay=relay) as room:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(2.0)
            if how == "cut":
                relay.cut()
            else:
                relay.weather = Weather(blind=True)
                time.sleep(5.0)
                relay.weather = Weather()
        result.figures["relay"] = dict(relay.counts)
        room.conclude()
    result.write(results).check()


@pytest.mark.slow
@pytest.mark.parametrize("who", ["edge", "agents", "both"])
def test_clock_is_set(who: str, tmp_path: Path, results: Path) -> None:
    """An hour ahead, two back, and right again: the wall clock of one side or both, as a person sets it."""
    result = Result(f"clock set: {who}", str(MAP), SEED)
    clock = WallClock(tmp_path)
    env = harness.ENV | clock.env
    with Room(tmp_path, result, env=None if who == "agents" else env) as room:
        if who != "edge":
            room.honest.kill()
            until("those are silent", lambda: room.edge.said.count(" silent: ") == 2, 20)
            room.begin_agents(env)
        silent = room.edge.said.count(" silent: ")
        for off_s in (3600, -3600, 0):
            time.sleep(4.0)
            clock.set(off_s)
            time.sleep(1.0)
            agents = room.edge.snapshot()["agents"]
            of_now = [agents[name]["last_received_s"] < 1.0 for name in ("hope", "faith")]
            result.expect(all(of_now), f"set by {off_s} s, an agent is not heard")
        time.sleep(4.0)
        result.expect(room.edge.said.count(" silent: ") == silent, "an agent was taken for silent")
        room.conclude()
    result.write(results).check()


@contextlib.contextmanager
def small_disk(folder: Path, size: str) -> Iterator[Callable[..., None]]:
    """A file system of its own, and how to mount it anew with other options."""
    folder.mkdir(parents=True)
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "torture", str(folder)], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("needs root, to mount a small disk")

    def remount(options: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{options}", str(folder)], check=True)

    try:
        yield remount
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False)


@pytest.mark.slow
@pytest.mark.parametrize("lasting", [False, True], ids=["for a while", "to the end"])
def test_full_disk(lasting: bool, tmp_path: Path, results: Path) -> None:
    """The map's disk is full. What is acknowledged meanwhile is in the file; there is room again, or not."""
    result = Result(f"full disk {'to the end' if lasting else 'for a while'}", str(MAP), SEED)
    disk = tmp_path / "disk"
    with small_disk(disk, "600k") as remount, Room(tmp_path, result, map_folder=disk) as room:
        until("the edge says that it cannot write", lambda: "map" in _trouble(room.edge), 60)
        time.sleep(3.0)
        assert room.edge.map is not None
        room.compare_acknowledged()  # while it is full
        if lasting:
            room.honest.kill()
            room.strays += harness.family(room.edge.process.pid)
            code = room.edge.interrupt()
            result.expect(code is not None, "it does not end on a full disk")
            room.compare_acknowledged()
        else:
            remount("size=200m")
            time.sleep(8.0)
            room.conclude()
    result.write(results).check()


def _trouble(edge: EdgeProgram) -> str:
    try:
        return (
            harness.get(f"{edge.http}/health").decode().partition('"agents"')[0].replace('"trouble": []', "")
        )
    except OSError:
        return ""


@pytest.mark.slow
def test_out_folder_is_full(tmp_path: Path, results: Path) -> None:
    """events.jsonl cannot be written: said, and everything else goes on; the exit code tells."""
    result = Result("full disk: --out", str(MAP), SEED)
    out = tmp_path / "edge0"
    with small_disk(out, "16k"):
        (out / "ballast").write_bytes(bytes(8192))
        with Room(tmp_path, result) as room:
            time.sleep(12.0)
            agents = room.honest.finish()
            result.expect(all(not a["open"] for a in agents), "keyframes not acknowledged")
            room.strays += harness.family(room.edge.process.pid)
            code = room.edge.interrupt()
            result.figures["exit_code"] = code
            result.expect(
                code in (0, 1) and "Traceback" not in room.edge.said, f"{code}: {room.edge.said[-300:]}"
            )
            room.compare_acknowledged()
    result.write(results).check()


@pytest.mark.slow
def test_read_only_map(tmp_path: Path, results: Path) -> None:
    """The disk of a map became read-only: it is used, that nothing is kept is said, and it ends well."""
    result = Result("read-only disk", str(MAP), SEED)
    disk = tmp_path / "disk"
    with small_disk(disk, "100m") as remount, Room(tmp_path, result, map_folder=disk) as room:
        time.sleep(4.0)
        room.edge.interrupt()
        remount("ro")
        room.restart_edge()
        time.sleep(5.0)
        result.expect("nothing new is stored" in room.edge.said, f"not said: {room.edge.said[-300:]}")
        room.honest.finish()
        room.strays += harness.family(room.edge.process.pid)
        code = room.edge.interrupt()
        result.expect(code == 0, f"exit code {code}: {room.edge.said[-300:]}")
    result.write(results).check()
