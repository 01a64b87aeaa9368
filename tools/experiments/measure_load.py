"""Capacity of one edge: a real `share edge --map`, and N agents simulated by one process.

    python tools/experiments/measure_load.py [--agents 3 6 12 24 32 48] [--seconds 40] [--out out/load]

Writes load.json to --out and prints a Markdown table. CPU is that of the edge's three processes, in seconds
per second; the agents share the machine. The first 10 s do not count. docs/lab/edge-load.md has the figures.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from share import child_processes, startup

startup.prepare_process()

from tool_main import exit_code, line  # noqa: E402

from share.errors import ShareError  # noqa: E402
from share.files.writing import atomic_write, writable_dir  # noqa: E402

COUNTED_FROM_S = 10.0
_CLOCK_TICKS = os.sysconf("SC_CLK_TCK")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
HERE = Path(__file__).parent
HEAD = (
    "agents",
    "CPU front",
    "mapper",
    "solver",
    "generator",
    "correction p50",
    "p95",
    "p99",
    "any p95",
    "looked up %",
    "answered %",
    "waiting max",
    "ack p99",
    "pong p99",
    "RSS MB",
    "file MB",
    "load avg",
)

Row = dict[str, Any]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--agents", type=int, nargs="*", default=[3, 6, 12, 24, 32, 48])
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--config", type=Path, help="settings of the edge")
    parser.add_argument("--out", type=Path, default=Path("out/load"))
    options = parser.parse_args()
    return exit_code("measure_load", lambda: measure(options))


def measure(options: argparse.Namespace) -> None:
    """Measure all loads, one after the other."""
    rows: list[Row] = []
    writable_dir(options.out)
    print("\n".join(line(cells) for cells in (HEAD, ["---"] * len(HEAD))), flush=True)
    for agents in options.agents:
        rows.append(carry(agents, options.seconds, options.config))
        print(line(cells_of(rows[-1])), flush=True)
        atomic_write(options.out / "load.json", json.dumps(rows, indent=2) + "\n")


def carry(agents: int, seconds: float, config: Path | None) -> Row:
    """Run one edge with N agents from start to end."""
    with tempfile.TemporaryDirectory(prefix="load-") as name, edge(Path(name), config) as (front, said):
        address, status = said
        command = [sys.executable, HERE / "load_agents.py", address, str(agents), str(seconds)]
        with subprocess.Popen(
            [*command, str(COUNTED_FROM_S)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=child_processes.child_environment(),
        ) as generator:
            used = _watch(generator, front, status)
            output, _ = generator.communicate("\n")
        if generator.returncode:
            raise ShareError("the agents' process failed; see above")
        size = sum(file.stat().st_size for file in Path(name).glob("map.sqlite*"))
        front.send_signal(signal.SIGINT)
        front.wait(30)
        report = json.loads((Path(name) / "out" / "edge.json").read_text())
    return {"agents": agents, "seconds": seconds} | used | json.loads(output) | _of_edge(report, size)


@contextmanager
def edge(folder: Path, config: Path | None) -> Iterator[tuple[subprocess.Popen[str], tuple[str, str]]]:
    """Run a `share edge`; yield the process, its address, and its status file."""
    command = [sys.executable, "-m", "share", "edge", "--bind", "tcp://127.0.0.1:0", "--http", "0"]
    command += ["--map", folder / "map.sqlite", "--out", folder / "out"]
    command += [] if config is None else ["--config", config]
    front = subprocess.Popen(
        [str(word) for word in command],
        stderr=subprocess.PIPE,
        text=True,
        env=child_processes.child_environment(),
    )
    try:
        assert front.stderr is not None
        found: dict[str, str] = {}
        while len(found) < 2:
            text = front.stderr.readline()
            if not text:
                raise ShareError("the edge did not start")
            for sign in ("listening on ", "status at "):
                if text.startswith(sign):
                    found[sign] = text.removeprefix(sign).split(",")[0].strip()
        yield front, (found["listening on "], found["status at "])
    finally:
        front.kill()
        front.wait()


def _watch(generator: subprocess.Popen[str], front: subprocess.Popen[str], status: str) -> Row:
    """Return CPU, memory and queue of the edge's processes in the counted time."""
    assert generator.stderr is not None
    _until(generator, "counted")
    mapper = worker_of(front.pid)
    pids = {"front": front.pid, "mapper": mapper, "solver": worker_of(mapper)}
    began, before = time.monotonic(), {name: cpu_s(pid) for name, pid in pids.items()}
    waiting, load = [], []
    os.set_blocking(generator.stderr.fileno(), False)
    while generator.poll() is None and "over" not in (generator.stderr.readline() or ""):
        with urllib.request.urlopen(f"{status}snapshot.json") as answer:
            waiting.append(json.loads(answer.read()).get("waiting", 0))
        load.append(os.getloadavg()[0])
        time.sleep(1.0)
    passed = time.monotonic() - began
    return {
        "cpu": {name: (cpu_s(pid) - before[name]) / passed for name, pid in pids.items()},
        "rss_mb": {name: rss_mb(pid) for name, pid in pids.items()},
        "waiting": waiting,
        "load_average": sum(load) / len(load),
    }


def _until(generator: subprocess.Popen[str], word: str) -> None:
    assert generator.stderr is not None
    while word not in (text := generator.stderr.readline()):
        if not text:
            raise ShareError("the agents' process ended too early")
        print(text, end="", file=sys.stderr)


def _of_edge(report: Row, size: int) -> Row:
    agents = report["agents"].values()
    keyframes = sum(agent["keyframes"] for agent in agents)
    skipped = sum(agent["queries_skipped"] for agent in agents)
    steps = {name: report[name] for name in ("place_ms", "verify_ms", "solve_ms")}
    maps = sum(size > 0 for size in report["maps"].values())
    counts = {"file_mb": size / 1e6, "looked_up": 1 - skipped / max(1, keyframes), "maps": maps}
    return counts | steps | {"loops": report["loops"], "removed_keyframes": report["removed_keyframes"]}


def cells_of(row: Row) -> list[str]:
    """Return a row of the table."""
    cpu, ms = row["cpu"], row["correction_ms"]
    return [
        str(row["agents"]),
        *(f"{cpu[name]:.2f}" for name in ("front", "mapper", "solver")),
        f"{row['generator_cpu']:.2f}",
        *(f"{ms[name] or 0:.0f}" for name in ("p50", "p95", "p99")),
        f"{row['any_correction_ms']['p95'] or 0:.0f}",
        f"{100 * row['looked_up']:.0f}",
        f"{100 * row['answered']:.0f}",
        str(max(row["waiting"])),
        f"{row['ack_ms']['p99'] or 0:.0f}",
        f"{row['pong_ms']['p99'] or 0:.0f}",
        " ".join(f"{mb:.0f}" for mb in row["rss_mb"].values()),
        f"{row['file_mb']:.0f}",
        f"{row['load_average']:.1f}",
    ]


# ---- CPU time and memory of a process, from /proc (Linux)


def cpu_s(pid: int) -> float:
    """Return CPU seconds of all its threads, in user and kernel mode, without ended children (proc(5))."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _CLOCK_TICKS


def rss_mb(pid: int) -> float:
    """Return its resident memory, shared pages included, MB."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE_BYTES / 1e6


def worker_of(pid: int) -> int:
    """Return its worker process. Raises LookupError unless there is exactly one."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    children = [int(child) for task in tasks for child in (task / "children").read_text().split()]
    workers = [c for c in children if b"spawn_main" in Path(f"/proc/{c}/cmdline").read_bytes()]
    if len(workers) != 1:
        raise LookupError(f"process {pid} has {len(workers)} workers, not one")
    return workers[0]


if __name__ == "__main__":
    sys.exit(main())
