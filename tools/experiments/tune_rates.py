"""Effect of scheduler settings: a grid, in virtual time with modelled mapping.

    python tools/experiments/tune_rates.py control.kp=0.2,0.8,3.2 control.kd=0,0.2 [--policy share] \\
        [--link wifi5] \\
        [--scenes warehouse firestation] [--rooms 401:404] [--agents ar ar robot] [--motions NAME=SPEC …] \\
        [--workers 2] [--json FILE] [--picture FILE]

Settings joined by + have the same value: control.rate_min_hz+control.rate_max_hz=1.5,2 are fixed rates. Each
room is a scene and a seed, in which all agents move for a minute as `--agents` usually do, or as `--motions`
say in the specs of `share emulate` (ar0=walk:speed=0.3,pauses=8), with odometry of keyframe_odometry.py. The
first row is `covins-g`. Prints a Markdown table, means over rooms with the standard error of the mean:
latency of headsets and of robots relative to `covins-g` in the same room, likewise errors in the map and
merges, then the QoE of headsets and the lowest of all agents. Two settings give a picture: heat maps of
latency and error.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from keyframe_making import make_unseen  # noqa: E402
from keyframe_set import KeyframeSet, Spacing  # noqa: E402
from measure_joins import configured  # noqa: E402
from simulate import SIMULATED, Row, play  # noqa: E402
from tool_main import exit_code, line  # noqa: E402

from share.errors import UsageError  # noqa: E402
from share.lab.emulate.recipe import SessionRecipe  # noqa: E402
from share.spawning import SPAWN_CONTEXT  # noqa: E402

FIGURES = ("AR latency", "robot latency", "AR error", "robot error", "merges")
USUAL = {"ar": "walk:", "robot": "robot:"}
LARGEST_M = (30.0, 20.0, 4.0)  # of the scenes
Room = tuple[str, int, tuple[str, ...]]  # scene, seed, motions


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("grid", nargs="*", metavar="SECTION.NAME=VALUE,VALUE…")
    parser.add_argument("--policy", choices=SIMULATED, default="share")
    parser.add_argument("--link", default="wifi5")
    parser.add_argument("--scenes", nargs="+", default=["warehouse", "firestation"])
    parser.add_argument("--rooms", default="401:404", metavar="FIRST:END")
    parser.add_argument("--agents", nargs="+", choices=tuple(USUAL), default=["ar", "ar", "robot"])
    parser.add_argument("--motions", nargs="+", metavar="NAME=SPEC")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    return exit_code("tune_rates", lambda: tune(options))


def tune(options: argparse.Namespace) -> None:
    """Run every point of the grid in every room."""
    names, values = _grid(options.grid)
    if options.picture and len(names) < 2:
        raise UsageError("--picture needs two settings or more")
    points = list(itertools.product(*values))
    first, end = map(int, options.room_log_sigma.split(":"))
    usual = (f"{kind}{k}={USUAL[kind]}" for k, kind in enumerate(options.agents))
    motions = tuple(options.motions or usual)
    rooms: list[Room] = [(scene, seed, motions) for scene in options.scenes for seed in range(first, end)]
    sets = [("edge.policy=" + json.dumps("covins-g"),)] + [
        ("edge.policy=" + json.dumps(options.policy), *_settings(names, point)) for point in points
    ]
    # so that a room stays in memory
    jobs = [(room, settings, options.link) for room in rooms for settings in sets]
    with ProcessPoolExecutor(options.workers, SPAWN_CONTEXT) as pool:
        rows = list(pool.map(_play, jobs, chunksize=len(sets)))
    runs = dict(zip(jobs, rows, strict=True))
    head = (*names, *FIGURES, "AR QoE", "least QoE")
    print("\n".join(line(cells) for cells in (head, ["---"] * len(head))))
    table = []
    for settings, point in zip(sets[1:], points, strict=True):
        ratios = [
            _ratios(runs[room, settings, options.link], runs[room, sets[0], options.link]) for room in rooms
        ]
        mean, sem = np.nanmean(ratios, axis=0), np.nanstd(ratios, axis=0) / np.sqrt(len(ratios))
        qoe = np.mean([_qoe(runs[room, settings, options.link]) for room in rooms], axis=0)
        table.append(mean.tolist())
        ratios = [f"{m:.3f} ± {s:.3f}" for m, s in zip(mean, sem, strict=True)]
        print(line([*point, *ratios, *(f"{q:.2f}" for q in qoe)]), flush=True)
    if options.json:
        kept = [
            {"settings": job[1], "scene": job[0][0], "room": job[0][1], **row} for job, row in runs.items()
        ]
        options.json.write_text(json.dumps(kept, indent=1) + "\n")
    if options.picture:
        _draw(options.picture, names, values, np.array(table))


def _grid(words: list[str]) -> tuple[list[str], list[list[str]]]:
    if bad := [word for word in words if "=" not in word]:
        raise UsageError(f"'{bad[0]}': expected SECTION.NAME=VALUE,VALUE…")
    return [w.split("=")[0] for w in words], [w.split("=", 1)[1].split(",") for w in words]


def _settings(names: list[str], point: tuple[str, ...]) -> Iterator[str]:
    for name, value in zip(names, point, strict=True):
        yield from (f"{one}={value}" for one in name.split("+"))


@cache
def _room(scene: str, seed: int, motions: tuple[str, ...]) -> KeyframeSet:
    """Return a room of the scene's default size for up to four agents, else larger."""
    side = 3.0 * len(motions) ** 0.5 + 3
    longer = max(side, side**2 / LARGEST_M[1])
    size = (min(longer, LARGEST_M[0]), min(side, LARGEST_M[1]), LARGEST_M[2]) if len(motions) > 4 else None
    return make_unseen(SessionRecipe(scene, motions, 60.0, seed=seed, size=size), Spacing())


def _play(job: tuple[Room, tuple[str, ...], str]) -> Row:
    room, settings, link = job
    made = _room(*room)
    row = play(made, configured(list(settings)), link, room[1], modelled=True)
    for name, agent in row["agents"].items():
        agent["kind"] = str(made.agents[name].hello.kind)
    return row


def _of(row: Row, kind: str, figure: str) -> float:
    agents = row["agents"].values()
    return float(np.nanmean([agent[figure] for agent in agents if agent["kind"] == kind] or [np.nan]))


def _ratios(row: Row, base: Row) -> list[float]:
    """Return the ratios of `FIGURES`."""
    pairs = [(kind, figure) for figure in ("latency_ms", "error_cm") for kind in ("ar", "robot")]
    return [*(_of(row, *pair) / _of(base, *pair) for pair in pairs), row["done"] / max(1, base["done"])]


def _qoe(row: Row) -> tuple[float, float]:
    """Return the mean QoE of headsets, and the lowest of all agents."""
    return _of(row, "ar", "qoe"), float(np.nanmin([agent["qoe"] for agent in row["agents"].values()]))


def _draw(path: Path, names: list[str], values: list[list[str]], table: np.ndarray[Any, Any]) -> None:
    """Draw heat maps over the first two settings; means over the others."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    shape = [len(v) for v in values]
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for axis, column in zip(axes, (0, 2), strict=True):
        cells = table[:, column].reshape(shape).mean(axis=tuple(range(2, len(shape))))
        image = axis.imshow(cells, cmap="Blues", aspect="auto", origin="lower")
        axis.set_xticks(range(shape[1]), values[1])
        axis.set_yticks(range(shape[0]), values[0])
        axis.set(xlabel=names[1], ylabel=names[0], title=f"{FIGURES[column]} / covins-g")
        for (i, j), cell in np.ndenumerate(cells):
            axis.text(
                j,
                i,
                f"{cell:.2f}",
                ha="center",
                va="center",
                color="white" if image.norm(cell) > 0.5 else "black",
            )
        figure.colorbar(image, ax=axis)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    sys.exit(main())
