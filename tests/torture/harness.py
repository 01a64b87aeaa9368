"""What all attacks need: an edge and agents as real processes, samples of /proc, and results."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from raw_wire import unpack

HERE = Path(__file__).resolve().parent
TESTS, ROOT = HERE.parent, HERE.parents[1]
PYTHON = sys.executable
SHARE = [PYTHON, "-m", "share"]
ENV = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
PAGE = os.sysconf("SC_PAGE_SIZE")
SAMPLE_S = 0.25
AGENTS_OF = {"hope": ("hope", "faith"), "eve": tuple(f"eve{k}" for k in range(20))}  # names a key speaks for
ALL_KEPT = "edge:\n  max_keyframes: 100000\n"  # none is taken out for want of room


def say(text: str) -> None:
    """A line of progress, past pytest's capture where it was asked for (-s)."""
    print(f"[torture] {text}", file=sys.stderr, flush=True)


def until(what: str, condition: Callable[[], Any], seconds: float) -> Any:
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < deadline, f"{what}: not within {seconds:g} s"
        time.sleep(0.05)
    return found


# ------------------------------------------------------------------ processes


def family(pid: int) -> list[int]:
    """The process and all its descendants that are alive."""
    found, todo = [], [pid]
    while todo:
        at = todo.pop()
        try:
            state = Path(f"/proc/{at}/stat").read_text().rpartition(")")[2].split()[0]
            if state in "ZX":
                continue
            found.append(at)
            for task in Path(f"/proc/{at}/task").iterdir():
                todo += map(int, (task / "children").read_text().split())
        except (FileNotFoundError, ProcessLookupError):
            continue
    return found


def alive(pid: int) -> bool:
    return pid in family(pid)


def left_of(pids: list[int], seconds: float = 10.0) -> list[int]:
    """Those that are still alive when the others have had so long to end."""
    deadline = time.monotonic() + seconds
    while (left := [pid for pid in pids if alive(pid)]) and time.monotonic() < deadline:
        time.sleep(0.1)
    return left


def figures(pid: int) -> dict[str, float] | None:
    """RSS in MB, open files, threads, CPU seconds; None if it is gone."""
    try:
        rss = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE / 1e6
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        fds = len(os.listdir(f"/proc/{pid}/fd"))
    except (FileNotFoundError, ProcessLookupError, PermissionError):
        return None
    cpu = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return {"rss_mb": rss, "fds": fds, "threads": int(fields[17]), "cpu_s": cpu}


class Program:
    """A process whose output goes to a file; in a session of its own, so that all of it can be ended."""

    def __init__(
        self, log: Path, arguments: Sequence[str], env: dict[str, str] | None = None, **more: Any
    ) -> None:
        self.log = log
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("ab") as sink:
            self.process = subprocess.Popen(
                list(arguments), stdout=sink, stderr=sink, env=env or ENV, start_new_session=True,
                **({"stdin": subprocess.DEVNULL} | more),
            )  # fmt: skip
        self.family = [self.process.pid]

    @property
    def said(self) -> str:
        return self.log.read_text(errors="replace")

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def wait_for(self, pattern: str, seconds: float = 60) -> re.Match[str]:
        def look() -> re.Match[str] | None:
            found = re.search(pattern, self.said)
            assert found or self.running, (
                f"ended ({self.process.returncode}) before it said {pattern!r}: {self.said[-2000:]}"
            )
            return found

        found = until(f"{self.log.name} says {pattern!r}", look, seconds)
        assert isinstance(found, re.Match)
        return found

    def interrupt(self, seconds: float = 30) -> int | None:
        """Exit code after SIGINT; None if it does not end, and then it is killed."""
        if self.running:
            self.family = family(self.process.pid)
            self.process.send_signal(signal.SIGINT)
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.kill()
            return None

    def kill(self) -> None:
        pids = family(self.process.pid)
        for pid in pids or [self.process.pid]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        if self.process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                self.process.stdin.close()
        self.process.wait()


# ------------------------------------------------------------------ an edge


@dataclass(frozen=True)
class Setup:
    """How the edge is started."""

    map: bool = False
    http: bool = True
    keys: bool = False

    def __str__(self) -> str:
        on = [name for name in ("map", "http", "keys") if getattr(self, name)]
        return "+".join(on) or "bare"


SETUPS = (
    Setup(),
    Setup(map=True),
    Setup(map=True, keys=True),
    Setup(http=False),
    Setup(map=True, http=False),
)


@dataclass
class Watch:
    """Samples of the family of a process, and of /health, until `stop`."""

    pid: int
    http: str | None = None
    samples: list[dict[str, Any]] = field(default_factory=list)
    health_ms: list[float] = field(default_factory=list)
    health_failed: list[str] = field(default_factory=list)
    every_s: float = SAMPLE_S

    def start(self) -> Watch:
        self._end = threading.Event()
        self._threads = [threading.Thread(target=self._sample, daemon=True)]
        if self.http:
            self._threads.append(threading.Thread(target=self._ask, daemon=True))
        for thread in self._threads:
            thread.start()
        return self

    def stop(self) -> None:
        self._end.set()
        for thread in self._threads:
            thread.join(15)

    def _sample(self) -> None:
        while not self._end.wait(self.every_s):
            at = time.monotonic()
            found = {pid: f for pid in family(self.pid) if (f := figures(pid)) is not None}
            if found:
                self.samples.append({"t": at, "of": found})

    def _ask(self) -> None:
        while not self._end.wait(0.5):
            began = time.monotonic()
            try:
                get(f"{self.http}/health", 10)
                self.health_ms.append(1e3 * (time.monotonic() - began))
            except (OSError, ValueError) as error:
                self.health_failed.append(f"{error}"[:200])

    def rss_mb(self, since: float = 0.0) -> tuple[float, float]:
        """Return the memory of all processes: at `since` (or at first), and the most from then on."""
        sums = [(s["t"], sum(f["rss_mb"] for f in s["of"].values())) for s in self.samples]
        before = [mb for t, mb in sums if t <= since] or [mb for _, mb in sums[:1]]
        return (before[-1], max(mb for t, mb in sums if t >= min(since, sums[-1][0]))) if sums else (0.0, 0.0)

    def processes(self) -> int:
        return max((len(s["of"]) for s in self.samples), default=0)


def get(url: str, timeout_s: float = 10) -> bytes:
    """The body; a 503 has one too."""
    try:
        with urllib.request.urlopen(url, timeout=timeout_s) as answer:
            return bytes(answer.read())
    except urllib.error.HTTPError as error:
        if error.code != 503:
            raise
        return error.read()


@dataclass
class Keys:
    """Folders of key pairs: the edge's, and one for each of `names`; all authorized but the last."""

    folder: Path
    server: str = ""
    edge: Path = Path()

    @staticmethod
    def make(folder: Path, names: Sequence[str] = ("hope", "eve", "mallory")) -> Keys:
        keys = Keys(folder, edge=folder / "edge")
        keys.server = _keys(keys.edge, "generate", "--name", "edge")
        for name in names:
            public = _keys(folder / name, "generate", "--name", name)
            if name != names[-1]:
                of = [f"--agent={agent}" for agent in AGENTS_OF.get(name, ())]
                _keys(keys.edge, "authorize", name, public, *of, "--commands", "--objects")
        return keys

    def of(self, name: str) -> tuple[str, str, str]:
        """Public, secret, and the edge's public key."""
        public, secret = (
            (self.folder / name / f"{name}.{end}").read_text().split()[-1] for end in ("public", "secret")
        )
        return public, secret, self.server


def _keys(folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        [*SHARE, "keys", *arguments, "--keys", str(folder)],
        check=True,
        capture_output=True,
        text=True,
        env=ENV,
    )
    return done.stdout.strip()


class EdgeProgram(Program):
    """`share edge`, listening; its map file and its address stay over restarts."""

    def __init__(
        self,
        folder: Path,
        setup: Setup,
        bind: str | None = None,
        keys: Keys | None = None,
        env: dict[str, str] | None = None,
        policy: str = "share",
        map_folder: Path | None = None,
        settings: str = ALL_KEPT,
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.setup, self.keys = folder, setup, keys
        self.map = (map_folder or folder) / "room.sqlite" if setup.map else None
        life = len(list(folder.glob("edge*.log")))
        self.out = folder / f"edge{life}"
        config = folder / "share.yaml"
        config.write_text(settings)
        host = "0.0.0.0" if setup.keys else "127.0.0.1"
        arguments = ["--bind", bind or f"tcp://{host}:0", "--config", str(config), "--out", str(self.out)]
        arguments += ["--map", str(self.map)] if self.map else []
        arguments += ["--http", "127.0.0.1:0"] if setup.http else []
        arguments += ["--policy", policy]
        arguments += ["--keys", str(keys.edge)] if keys else ["--allow", "commands", "--allow", "objects"]
        super().__init__(folder / f"edge{life}.log", [*SHARE, "edge", *arguments], env)
        port = self.wait_for(r"listening on tcp://\S+?:(\d+),")[1]
        self.address = f"tcp://127.0.0.1:{port}"
        self.bound = f"tcp://{host}:{port}"
        self.http = self.wait_for(r"status at (http://\S+?)/\s")[1] if setup.http else None

    def roles(self) -> dict[str, int]:
        """front, mapper, solver: pids of those that are there."""
        found = {"front": self.process.pid}
        with contextlib.suppress(ValueError, FileNotFoundError, ProcessLookupError):
            (found["mapper"],) = _workers(self.process.pid)
            (found["solver"],) = _workers(found["mapper"])
        return found

    def bytes_said(self) -> int:
        events = self.out / "events.jsonl"
        return self.log.stat().st_size + (events.stat().st_size if events.exists() else 0)

    def snapshot(self) -> dict[str, Any]:
        return json.loads(get(f"{self.http}/snapshot.json"))  # type: ignore[no-any-return]


def _workers(pid: int) -> list[int]:
    out = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in (task / "children").read_text().split():
            if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                out.append(int(child))
    return out


def kept_by_run(path: Path) -> dict[tuple[str, int], set[int]]:
    """Ids of the keyframes in a map file by name and number of their run, by plain SQL and msgpack."""
    out: dict[tuple[str, int], set[int]] = {}
    with contextlib.closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as db:
        hellos = dict(db.execute("select key, hello from run"))
        for key, number in db.execute("select run, id from keyframe"):
            header: Any = unpack(unpack(hellos[key])[0])  # type: ignore[index]
            out.setdefault((header[2][0], header[2][2]), set()).add(number)
    return out


def kept_ids(path: Path, name: str) -> list[int]:
    """Return the ids of kept keyframes of the agent of that name."""
    return sorted(i for (who, _), ids in kept_by_run(path).items() if who == name for i in ids)


# ------------------------------------------------------------------ agents


def start_agent(folder: Path, name: str, source: Path, address: str, *more: str, **how: Any) -> Program:
    """A real `share agent`."""
    where = ("--name", name, "--kind", "ar", "--edge", address, "--out", str(folder / name))
    arguments = [*SHARE, "agent", str(source), *where, *more]
    return Program(folder / f"{name}.log", arguments, **how)


class HonestAgents(Program):
    """`honest.py`, until `finish`."""

    def __init__(
        self,
        edge_address: str,
        log: Path,
        keys: Keys | None = None,
        frames: int = 10**7,
        env: dict[str, str] | None = None,
    ) -> None:
        arguments = [
            PYTHON,
            str(HERE / "honest.py"),
            edge_address,
            str(frames),
            str(log.with_suffix(".acks")),
        ]
        if keys is not None:
            arguments += [str(keys.folder / "hope"), keys.server]
        super().__init__(log, arguments, env, stdin=subprocess.PIPE)

    def finish(self, seconds: float = 40) -> list[dict[str, Any]]:
        """What they met with."""
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(b"finish\n")
            self.process.stdin.close()
        try:
            self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.kill()
        return [json.loads(line) for line in self.said.splitlines() if line.startswith("[{")][-1]


def p95(values: Sequence[float]) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(0.95 * len(ordered)))] if ordered else float("nan")


def latencies(agents: list[dict[str, Any]], what: str, since: float, until_s: float) -> list[float]:
    """ms from a keyframe's first sending in that time to its acknowledgement or correction."""
    out = []
    for agent in agents:
        came = dict(map(tuple, agent[what]))  # type: ignore[arg-type]
        out += [1e3 * (came[k] - at) for k, at in agent["sent"] if k in came and since <= at < until_s]
    return out


# ------------------------------------------------------------------ results


@dataclass
class Result:
    """What an attack came to; written whatever happens."""

    attack: str
    setup: str
    seed: int
    findings: list[str] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)
    reproducer: str | None = None
    load: float = 0.0  # of the machine, the mean of the last minute

    def expect(self, holds: bool, otherwise: str) -> None:
        if not holds:
            self.findings.append(otherwise)

    def write(self, folder: Path) -> Result:
        folder.mkdir(parents=True, exist_ok=True)
        self.load = round(os.getloadavg()[0], 1)
        name = re.sub(r"[^\w+.-]+", "-", f"{self.attack}-{self.setup}")
        (folder / f"{name}.json").write_text(json.dumps(vars(self), indent=1) + "\n")
        say(f"{self.attack} [{self.setup}]: " + ("; ".join(self.findings) or "held"))
        return self

    def check(self) -> None:
        assert not self.findings, f"{self.attack} [{self.setup}], seed {self.seed}: " + "\n".join(
            self.findings
        )


@contextlib.contextmanager
def ended(*programs: Program) -> Iterator[None]:
    """All of them end with the block."""
    try:
        yield
    finally:
        for program in programs:
            if program.running:
                program.kill()
