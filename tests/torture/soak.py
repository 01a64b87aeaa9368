"""Hours of an edge with three agents: does anything grow?

    python tests/torture/soak.py [--hours 8] [--warm-up-min 20] [--most-keyframes N] [--session DIR]
        [--out share-soak]

An edge (map file, HTTP) and three agents (`loop_agent.py`: ann, bob and ann's recording again as cy), all
real processes. RSS, open files and threads of each are sampled every 5 s. After the warm-up, of each: the
slope an hour by Theil and Sen on medians of a minute (memory moves in steps, which least squares takes for
slopes), with a 95 % interval by a moving-block bootstrap of what is left (blocks of the square root of the
number of minutes, since what memory does in one minute it mostly does in the next). A process started anew
begins anew. A map of 2,000 keyframes (the default) and its loops fill for hours; one of 300 is full in
minutes, after which what grows is a leak.

Writes soak.json, samples.csv and soak.png; prints a table. Exit code 1 if a slope is surely not below its
bound (1 MB, 1 file, 1 thread an hour: the lower end of the interval is above it), or is not surely below it
(the upper end) where the run was long enough to say, or a process died, or one did not end well.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import harness
import numpy as np
from harness import EdgeProgram, Program, Setup, say

from share.geometry.se3 import from_rt
from share.recordings.trajectory import Trajectory, format_tum

EVERY_S, BLOCKS = 5.0, 300
ROUND_S = 40.0  # of a recording, which is played again and again
BOUND = {"rss_mb": 1.0, "fds": 1.0, "threads": 1.0}  # an hour
LONG_ENOUGH_H = 2.0  # after the warm-up: from here on, not to know is to fail
AGENTS = {"ann": "ann", "bob": "bob", "cy": "ann"}  # name: recording

Series = dict[tuple[str, int], list[tuple[float, dict[str, float]]]]  # by what it is, and its pid


def theil_sen(x: Any, y: Any) -> float:
    """The median of the slopes of all pairs."""
    i, j = np.triu_indices(len(x), 1)
    return float(np.median((y[j] - y[i]) / (x[j] - x[i])))


def slope(hours: Any, values: Any, seed: int = 1) -> tuple[float, float, float]:
    """An hour, and the ends of its 95 % interval."""
    x, y = np.asarray(hours, float), np.asarray(values, float)
    if len(x) < 4:
        return math.nan, -math.inf, math.inf
    best = theil_sen(x, y)
    line = np.median(y - best * x) + best * x
    left, n = y - line, len(x)
    size = max(2, math.isqrt(n))
    draw = np.random.default_rng(seed)
    slopes = []
    for _ in range(BLOCKS):
        starts = draw.integers(0, n - size + 1, -(-n // size))
        picked = np.concatenate([left[s : s + size] for s in starts])[:n]
        slopes.append(theil_sen(x, line + picked))
    low, high = np.quantile(slopes, (0.025, 0.975))
    return best, float(low), float(high)


def by_minute(points: list[tuple[float, float]]) -> tuple[list[float], list[float]]:
    """Hours and medians."""
    minutes: dict[int, list[float]] = defaultdict(list)
    for at, value in points:
        minutes[int(at // 60)].append(value)
    return [(m + 0.5) / 60 for m in sorted(minutes)], [float(np.median(minutes[m])) for m in sorted(minutes)]


def sample(programs: dict[str, Program], edge: EdgeProgram) -> list[tuple[str, int, dict[str, float]]]:
    of = [(f"edge {role}", pid) for role, pid in edge.roles().items()]
    of += [(f"agent {name}", program.process.pid) for name, program in programs.items()]
    return [(what, pid, found) for what, pid in of if (found := harness.figures(pid)) is not None]


def watch(edge: EdgeProgram, agents: dict[str, Program], seconds: float) -> tuple[Series, list[str]]:
    series: Series = defaultdict(list)
    died: list[str] = []
    began = said = time.monotonic()
    while (now := time.monotonic()) < began + seconds and not died:
        for what, pid, found in sample(agents, edge):
            series[what, pid].append((now - began, found))
        died = [name for name, p in {**agents, "edge": edge}.items() if not p.running]
        if now > said + 60:
            said = now
            rss = ", ".join(f"{what} {rows[-1][1]['rss_mb']:.0f}" for (what, _), rows in series.items())
            say(f"{(now - began) / 60:.0f} of {seconds / 60:.0f} min; MB: {rss}")
        time.sleep(max(0.0, EVERY_S - (time.monotonic() - now)))
    return series, died


def table(series: Series, warm_up_s: float) -> list[dict[str, Any]]:
    out = []
    for (what, pid), rows in series.items():
        later = [(at, found) for at, found in rows if at >= warm_up_s]
        if len(later) < 10:
            continue
        hours = (later[-1][0] - later[0][0]) / 3600
        for figure, bound in BOUND.items():
            best, low, high = slope(*by_minute([(at, found[figure]) for at, found in later]))
            most = max(found[figure] for _, found in later)
            fails = low > bound or (hours >= LONG_ENOUGH_H and high >= bound)
            out.append(
                {
                    "process": what,
                    "pid": pid,
                    "figure": figure,
                    "hours": round(hours, 3),
                    "slope": best,
                    "low": low,
                }
                | {"high": high, "most": most, "fails": bool(fails), "sure": bool(high < bound)}
            )
    return out


def draw(series: Series, warm_up_s: float, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(3, 1, figsize=(10, 10), sharex=True)
    for axis, (what, unit) in zip(
        axes, (("rss_mb", "MB"), ("fds", "open files"), ("threads", "threads")), strict=True
    ):
        for (name, _), rows in series.items():
            axis.plot([at / 3600 for at, _ in rows], [found[what] for _, found in rows], lw=0.8, label=name)
        axis.axvline(warm_up_s / 3600, color="grey", ls=":")
        axis.set_ylabel(unit)
    axes[0].legend(fontsize=7, ncol=3)
    axes[-1].set_xlabel("h")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def poses_of_a_round(begin_rad: float, seconds: float = ROUND_S) -> str:
    """A TUM file: around the middle of the room with the camera ahead (z forward, y down), at rest for a
    second at both ends, which are one place."""
    t = np.arange(0.0, seconds + 0.005, 0.01)
    x = ((t - 1) / (seconds - 2)).clip(0, 1)
    angle = begin_rad + 2 * math.pi * x**3 * (10 - 15 * x + 6 * x**2)
    at = np.stack([1.6 * np.cos(angle), 1.1 * np.sin(angle), 1.6 + 0.08 * np.sin(3 * angle)], axis=1)
    forward = np.stack([-1.6 * np.sin(angle), 1.1 * np.cos(angle), np.zeros_like(angle)], axis=1)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    down = np.broadcast_to([0.0, 0.0, -1.0], forward.shape)
    R = np.stack([np.cross(down, forward), down, forward], axis=2)
    return format_tum(Trajectory(np.round(1e9 * (1000 + t)).astype(np.int64), from_rt(R, at)))


def session_at(folder: Path) -> Path:
    """ann and bob, once around in the plain room from opposite places, made if it is not there."""
    if not (folder / "session.yaml").exists():
        say("making a session")
        folder.parent.mkdir(parents=True, exist_ok=True)
        motions = []
        for name, begin_rad in (("ann", 0.0), ("bob", math.pi)):
            poses = folder.parent / f"{name}.tum"
            poses.write_text(poses_of_a_round(begin_rad))
            motions += ["--motion", f"{name}=tum:{poses}"]
        how = ("--scene", "plain", "--profile", "d435i:640x480@15", "--seconds", f"{ROUND_S:g}")
        made = [*harness.SHARE, "emulate", *motions, *how, "--out", str(folder)]
        subprocess.run(made, check=True, env=harness.ENV, capture_output=True)
    return folder


def run(hours: float, warm_up_s: float, most_keyframes: int | None, session: Path, out: Path) -> int:
    out.mkdir(parents=True, exist_ok=True)
    seconds = hours * 3600 + warm_up_s
    settings = "" if most_keyframes is None else f"edge:\n  max_keyframes: {most_keyframes}\n"
    edge = EdgeProgram(out / "edge", Setup(map=True), settings=settings)
    agents: dict[str, Program] = {}
    with harness.ended(edge):
        for name, recording in AGENTS.items():
            arguments = [session / recording, name, edge.address, out / name, seconds + 3600]
            command = [harness.PYTHON, str(harness.HERE / "loop_agent.py"), *map(str, arguments)]
            agents[name] = Program(out / f"{name}.log", command)
        with harness.ended(*agents.values()):
            series, died = watch(edge, agents, seconds)
            snapshot = edge.snapshot() if edge.running else {}
            codes = {name: agent.interrupt(60) for name, agent in agents.items()}
        codes["edge"] = edge.interrupt(60)
    rows = table(series, warm_up_s)
    write(
        out,
        series,
        rows,
        {"hours": hours, "died": died, "exit_codes": codes, "agents": snapshot.get("agents")},
    )
    draw(series, warm_up_s, out / "soak.png")
    print(text(rows))
    print(f"died: {', '.join(died) or 'none'}; exit codes: {codes}")
    return int(bool(died or any(codes.values()) or any(row["fails"] for row in rows)))


def write(out: Path, series: Series, rows: list[dict[str, Any]], about: dict[str, Any]) -> None:
    (out / "soak.json").write_text(json.dumps(about | {"slopes": rows}, indent=1) + "\n")
    with (out / "samples.csv").open("w") as sink:
        sink.write("process,pid,t_s,rss_mb,fds,threads,cpu_s\n")
        for (what, pid), points in series.items():
            for at, f in points:
                sink.write(
                    f"{what},{pid},{at:.1f},{f['rss_mb']:.2f},{f['fds']},{f['threads']},{f['cpu_s']}\n"
                )


def text(rows: list[dict[str, Any]]) -> str:
    head = f"{'process':14s} {'figure':8s} {'most':>7s} {'an hour':>9s} {'95 % interval':>20s}  < bound"
    lines = [head]
    form = "{process:14s} {figure:8s} {most:7.1f} {slope:9.2f} "
    for r in rows:
        verdict = "no" if r["fails"] else "yes" if r["sure"] else "not sure"
        interval = f"{r['low']:.2f} .. {r['high']:.2f}"
        lines.append(f"{form.format(**r)}{interval:>20s}  {verdict}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hours", type=float, default=8.0, help="after the warm-up")
    parser.add_argument("--warm-up-min", type=float, default=20.0)
    parser.add_argument("--most-keyframes", type=int, help="that the map holds; default: the edge's own")
    parser.add_argument("--session", type=Path)
    parser.add_argument("--out", type=Path, default=Path("share-soak"))
    args = parser.parse_args()
    out = args.out.resolve()
    session = session_at(out / "session") if args.session is None else args.session.resolve()
    sys.exit(run(args.hours, 60 * args.warm_up_min, args.most_keyframes, session, out))


if __name__ == "__main__":
    main()
