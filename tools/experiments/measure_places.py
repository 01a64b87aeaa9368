"""Recall and precision of place recognition, on real recordings and in emulated rooms. Prints JSON.

    python tools/experiments/measure_places.py --data FOLDER [--emulated] [--far 2000] [--picture FILE.png]

FOLDER holds the stereo keyframes and the RGB-D kitchen of docs/understand/mapping.md. True pairs are nearer
than 1 m
and 30 degrees; an accepted pose is wrong by more than 0.25 m or 5 degrees. Of the false pairs, --far are
tried and stand for all. --emulated: warehouse, firestation and corridor-twins as well (made once, which takes
minutes).
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from keyframe_set import Spacing  # noqa: E402
from PIL import Image  # noqa: E402  # comes with matplotlib
from places_views import (  # noqa: E402  # noqa: E402
    FIRESTATION,
    TWINS,
    WAREHOUSE,
    Point,
    Tried,
    Views,
    emulated,
    point,
    real,
    recall_at,
    tried,
)
from tool_main import exit_code  # noqa: E402

from share.mapping.recognition.verification import MAX_SIGMA_DEG, MIN_INLIERS  # noqa: E402
from share.types import F64  # noqa: E402

INLIERS = (8, 10, 12, 14, 16, 18, 20, 24, 28, 32, 40, 50, 65, 80, 100, 130, 160, 200)
SIGMAS = (0.05, 0.075, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.8, 1.0, 1.5, 2.0, 3.0)
_COLOURS = ("#00798c", "#d1495b", "#b8860b", "#5f4b8b", "#3b7a3b")
_PALETTE = 64


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--emulated", action="store_true")
    parser.add_argument("--far", type=int, default=2000)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    return exit_code("measure_places", lambda: measure(options))


def measure(options: argparse.Namespace) -> None:
    rooms = real(options.data)
    if options.emulated:
        rooms += [emulated(WAREHOUSE, Spacing(), 6), emulated(FIRESTATION, Spacing(), 6)]
        rooms += [emulated(TWINS, Spacing(0.3, 0.35), 2)]
    recalls, curves, here = {}, {}, {}
    for views in rooms:
        recalls[views.name], served = recall_at(views, [v for v in rooms if v is not views])
        pairs = tried(views, options.far)
        curves[views.name] = over_both(pairs)
        here[views.name] = point(pairs, MIN_INLIERS, MAX_SIGMA_DEG)
        row = report(views, recalls[views.name], served, pairs, here[views.name])
        print(json.dumps(row), flush=True)
    if options.picture:
        draw(options.picture, recalls, curves, here)


def over_both(pairs: Tried) -> tuple[list[Point], list[Point]]:
    """Return curves over inliers at the allowed sigma, and over sigma at the allowed inliers."""
    inliers = [point(pairs, n, MAX_SIGMA_DEG) for n in INLIERS]
    return inliers, [point(pairs, MIN_INLIERS, sigma) for sigma in SIGMAS]


def report(views: Views, recall: Any, served: float, pairs: Tried, here: Point) -> dict[str, Any]:
    return {
        "room": views.name,
        "views": len(views.sights),
        "true_pairs": int(pairs.true.sum()),
        "tried": len(pairs.true),
        "recall_at": {k: round(float(recall[k - 1]), 3) for k in (1, 4, 8, 12, 20, 50)},
        "views_served_by_8": round(served, 3),
        "accepted": here.accepted,
        "wrong": here.wrong,
        "by_the_twins_transform": here.twins,
        "recall": round(here.recall, 3),
        "recall_without_wrong": round(without_wrong(pairs), 3),
    }


def without_wrong(pairs: Tried) -> float:
    """Return the best recall by limits on inliers and sigma that accept nothing wrong."""
    points = [point(pairs, n, sigma) for n in INLIERS for sigma in SIGMAS]
    return float(np.max([p.recall for p in points if p.wrong == 0], initial=0.0))


def draw(
    path: Path,
    recalls: dict[str, F64],
    curves: dict[str, tuple[list[Point], list[Point]]],
    here: dict[str, Point],
) -> None:
    """Write a PNG. recalls: by name, of the first k results. curves: over inliers and over sigma. here: at
    SHARE's limits."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    style = {"font.size": 11, "axes.spines.top": False, "axes.spines.right": False}
    with pyplot.rc_context(style):
        figure, panels = pyplot.subplots(1, 3, figsize=(14, 4.6), layout="constrained")
        for (name, recall), colour in zip(recalls.items(), _COLOURS, strict=False):
            panels[0].plot(range(1, len(recall) + 1), 100 * recall, color=colour, label=name)
        for panel, over in ((panels[1], 0), (panels[2], 1)):
            for (name, both), colour in zip(curves.items(), _COLOURS, strict=False):
                _precision(panel, both[over], here[name], colour, name)
        _words(panels)
        figure.legend(
            handles=panels[0].lines[: len(recalls)],
            loc="outside lower center",
            ncols=len(recalls),
            frameon=False,
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=90)
        pyplot.close(figure)
    Image.open(path).convert("RGB").quantize(_PALETTE).save(path, optimize=True)


def _precision(panel: Any, points: list[Point], here: Point, colour: str, name: str) -> None:
    panel.plot(
        [100 * p.recall for p in points], [100 * p.precision for p in points], color=colour, label=name
    )
    panel.plot(100 * here.recall, 100 * here.precision, "o", color=colour)


def _words(panels: Any) -> None:
    panels[0].set(title="query", xlabel="first k answers", ylabel="recall of true pairs [%]", xlim=(1, None))
    panels[0].axvline(8, color="black", linewidth=0.6, linestyle=":")
    for panel, over in ((panels[1], "least inliers"), (panels[2], "largest sigma")):
        panel.set(
            title=f"verification, over {over}", xlabel="recall of true pairs [%]", ylabel="precision [%]"
        )
        panel.set_ylim(0, 102)
    for panel in panels:
        panel.grid(alpha=0.3)


if __name__ == "__main__":
    sys.exit(main())
