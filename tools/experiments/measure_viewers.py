"""What looking on costs: edge CPU and agents' pose latency without a live room, and with 0, 1 and 5 viewers.

    python tools/experiments/measure_viewers.py SESSION [--rounds N] [--out DIR] [--virtual SECONDS]

Plays SESSION in real time once a round and setup, in another order each round, so that what else the machine
does meets all setups alike. A viewer reads all that the live room sends. Prints a Markdown table of means and
of differences from the setup without a live room in the same round (mean, standard error); writes
viewers.json. With --virtual it measures the CPU time of the edge's calls to the live room, and of the thread
that sends to it, while the session is simulated: that does not depend on what else the machine does.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from math import comb
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

import numpy as np  # noqa: E402
from helpers.observed_simulation import observed_simulation  # noqa: E402
from tool_main import exit_code, line  # noqa: E402

from share.config import Config  # noqa: E402
from share.files.writing import atomic_write, writable_dir  # noqa: E402
from share.lab.evaluate.real_time import share_command  # noqa: E402
from share.recordings.session import Session, read_session  # noqa: E402
from share.runtime.edge_observer import EdgeObserver  # noqa: E402
from share.view.feed import ViewFeed  # noqa: E402
from share.view.viewer import LiveRoom  # noqa: E402

SETUPS: tuple[int | None, ...] = (None, 0, 1, 5)  # viewers; None: no live room
_TICKS = os.sysconf("SC_CLK_TCK")
_POLL_S = 0.25


@dataclass(frozen=True)
class Played:
    """One run. edge_s, view_s: CPU of the edge's processes but the live room, and of that."""

    viewers: int | None
    load: float
    edge_s: float
    view_s: float
    keyframes: int
    pose_p50_ms: float
    pose_p95_ms: float
    corrected_p50_ms: float
    messages: int


class Cpu:
    """CPU time of the processes under one, s, as far as they were seen."""

    def __init__(self, root: int) -> None:
        self._root, self._own = root, dict[int, tuple[float, bool]]()

    def sample(self) -> None:
        stats = _stats()
        edges = [pid for pid, one in stats.items() if one[0] == self._root and " edge " in _words(pid)]
        known = set(edges)
        for _ in range(3):
            known |= {pid for pid, one in stats.items() if one[0] in known}
        for pid in known:
            is_view = self._own.get(pid, (0.0, False))[1] or _is_live_room(pid)
            self._own[pid] = stats[pid][1], is_view

    def split(self) -> tuple[float, float]:
        """Return the edge's and the live room's."""
        return tuple(sum(s for s, one in self._own.values() if one is view) for view in (False, True))


def _is_live_room(pid: int) -> bool:
    """Return whether a process has loaded what only viser needs."""
    try:
        return "zstandard" in Path(f"/proc/{pid}/maps").read_text()
    except OSError:
        return False


def _stats() -> dict[int, tuple[int, float]]:
    """Return parent and CPU seconds of all processes."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        cpu_s = (int(fields[11]) + int(fields[12])) / _TICKS
        found[int(path.parent.name)] = int(fields[1]), cpu_s
    return found


def _words(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except OSError:
        return ""


def _look_on(url: str, counts: list[int]) -> None:
    """Read all that the live room sends until it ends."""
    import viser
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    protocol: Any = [f"viser-v{viser.__version__}"]
    address = url.replace("http", "ws", 1)
    try:
        with connect(address, subprotocols=protocol, max_size=None, open_timeout=30) as connection:
            while True:
                connection.recv()
                counts.append(1)
    except (ConnectionClosed, OSError):
        return


def play(session: Path, viewers: int | None, out: Path) -> Played:
    view = [] if viewers is None else ["--view"]
    command = share_command("evaluate", "run", str(session), "--agents-first", "--out", str(out), *view)
    load, messages = os.getloadavg()[0], list[int]()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    cpu = Cpu(process.pid)

    def read_lines() -> None:
        assert process.stderr is not None
        for text in process.stderr:
            if found := re.match(r"live room at (http://\S+)", text):
                for _ in range(viewers or 0):
                    threading.Thread(target=_look_on, args=(found[1], messages), daemon=True).start()

    threading.Thread(target=read_lines, daemon=True).start()
    while process.poll() is None:
        cpu.sample()
        time.sleep(_POLL_S)
    if process.returncode:
        sys.exit(f"measure_viewers: the run in {out} failed")
    edge_s, view_s = cpu.split()
    edge = json.loads((out / "edge" / "edge.json").read_text())
    reports = [json.loads((out / name / "report.json").read_text()) for name in edge["agents"]]

    def mean(part: str, quantile: str) -> float:
        return float(np.mean([one[part][quantile] for one in reports if one[part][quantile] is not None]))

    return Played(
        viewers,
        load,
        edge_s,
        view_s,
        sum(one["keyframes"] for one in edge["agents"].values()),
        mean("track_ms", "p50"),
        mean("track_ms", "p95"),
        mean("corrected_ms", "p50"),
        len(messages),
    )


def table(runs: list[Played]) -> str:
    """Return medians, and paired differences from the setup without a live room."""
    rounds = [runs[k : k + len(SETUPS)] for k in range(0, len(runs), len(SETUPS))]
    by_setup = {setup: [next(r for r in one if r.viewers == setup) for one in rounds] for setup in SETUPS}
    head = ("viewers", "edge CPU s", "a keyframe, ms", "difference %", "live room CPU s")
    rows = [line((*head, "pose p50 ms", "difference", "p95", "difference", "messages"))]
    rows.append(line(["---"] * (len(head) + 5)))
    bare = by_setup[None]
    for setup, played in by_setup.items():
        each = [1e3 * one.edge_s / max(1, one.keyframes) for one in played]
        each_bare = [1e3 * one.edge_s / max(1, one.keyframes) for one in bare]
        cells = [
            "no live room" if setup is None else str(setup),
            f"{np.median([one.edge_s for one in played]):.2f}",
            f"{np.median(each):.1f}",
            _difference([100 * (a / b - 1) for a, b in zip(each, each_bare, strict=True)], 1),
            f"{np.median([one.view_s for one in played]):.2f}",
        ]
        for field in ("pose_p50_ms", "pose_p95_ms"):
            values, others = ([getattr(one, field) for one in of] for of in (played, bare))
            cells.append(f"{np.median(values):.1f}")
            cells.append(_difference([a - b for a, b in zip(values, others, strict=True)], 2))
        cells.append(str(int(np.mean([one.messages for one in played]))))
        rows.append(line(cells))
    return "\n".join(rows)


def _difference(values: list[float], digits: int) -> str:
    low, high = median_interval(values)
    return f"{np.median(values):+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]"


def median_interval(values: Sequence[float], least: float = 0.9) -> tuple[float, float]:
    """Return the narrowest pair of order statistics that hold the median with at least this probability,
    whatever the distribution; the extremes where there are too few for it."""
    ordered = sorted(values)
    n, outside, k = len(ordered), 0.0, 0
    while k < n // 2 and outside + 2 * comb(n, k) / 2**n <= 1 - least:
        outside += 2 * comb(n, k) / 2**n
        k += 1
    k = max(k - 1, 0)
    return ordered[k], ordered[n - 1 - k]


# In virtual time: the edge's own CPU, which does not depend on what else the machine does


class TimedObserver(EdgeObserver):
    """Passes on what an edge shows, and counts the CPU time of the calls."""

    def __init__(self, feed: ViewFeed) -> None:
        self._feed, self.cpu_s = feed, 0.0

    def begin_session(self, map_file: Path | None, known: Any) -> None:
        self._timed(self._feed.begin_session, map_file, known)

    def add_effect(self, effect: Any) -> None:
        self._timed(self._feed.add_effect, effect)

    def add_result(self, result: Any) -> None:
        self._timed(self._feed.add_result, result)

    def add_poses(self, poses: Any) -> None:
        self._timed(self._feed.add_poses, poses)

    def add_report(self, report: Any) -> None:
        self._timed(self._feed.add_report, report)

    def _timed(self, call: Callable[..., None], *arguments: Any) -> None:
        start_s = time.thread_time()
        call(*arguments)
        self.cpu_s += time.thread_time() - start_s


def play_virtually(session: Session, seconds: float, viewers: int) -> dict[str, float]:
    """Play a session at the pace of its clock; return CPU seconds: of edge, mapper and agents together, of
    the edge's calls to the live room, of the thread that sends to it, and of its process."""
    counts = list[int]()
    with closing(LiveRoom("0", None, "measured")) as live:
        observer = TimedObserver(live.feed)
        room = observed_simulation(session, Config(), observer)
        for _ in range(viewers):
            address = f"http://{live.endpoint}/"
            threading.Thread(target=_look_on, args=(address, counts), daemon=True).start()
        start_s, cpu_s = time.monotonic(), time.thread_time()

        def keep_pace(t_s: float) -> None:
            time.sleep(max(0.0, start_s + t_s - time.monotonic()))

        sender = next(one for one in threading.enumerate() if one.name == "view")
        room.play(seconds, keep_pace)
        cpu_s = time.thread_time() - cpu_s
        return {
            "all": cpu_s,
            "calls": observer.cpu_s,
            "sender": time.clock_gettime(time.pthread_getcpuclockid(sender.ident or 0)),
            "process": _stats()[live.pid or 0][1],
            "messages": len(counts),
        }


def virtual_table(session: Session, seconds: float, rounds: int) -> str:
    rows = [line(("viewers", "all, s", "calls, ms", "sender, ms", "of all, %", "live room, s", "messages"))]
    rows.append(line(["---"] * 7))
    for viewers in SETUPS[1:]:
        played = [play_virtually(session, seconds, viewers or 0) for _ in range(rounds)]
        mean = {name: float(np.mean([one[name] for one in played])) for name in played[0]}
        share = 100 * (mean["calls"] + mean["sender"]) / mean["all"]
        cells = [
            f"{mean['all']:.2f}",
            f"{1e3 * mean['calls']:.1f}",
            f"{1e3 * mean['sender']:.0f}",
            f"{share:.2f}",
        ]
        rows.append(line((str(viewers), *cells, f"{mean['process']:.2f}", f"{mean['messages']:.0f}")))
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("session", type=Path)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--out", type=Path, default=Path("viewers"))
    parser.add_argument("--virtual", type=float, metavar="SECONDS", help="measure the edge's calls alone")
    given = parser.parse_args()
    if given.virtual is not None:
        print(virtual_table(read_session(given.session.resolve()), given.virtual, given.rounds))
        return
    writable_dir(given.out)
    runs = list[Played]()
    for number in range(given.rounds):
        for k in range(len(SETUPS)):
            setup = SETUPS[(number + k) % len(SETUPS)]
            runs.append(play(given.session, setup, given.out / f"{number}-{setup}"))
            print(runs[-1], file=sys.stderr, flush=True)
    atomic_write(given.out / "viewers.json", json.dumps([asdict(one) for one in runs], indent=2) + "\n")
    loads = [one.load for one in runs]
    print(f"{given.rounds} rounds, load before a run {min(loads):.1f} to {max(loads):.1f}\n\n{table(runs)}")


if __name__ == "__main__":
    sys.exit(exit_code("measure_viewers", main))
