"""The floor of a study as a picture to print: spots, the researcher's path, and where the marker lies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from share.lab.evaluate.charts import agg_pyplot, save_png
from share.lab.study.plan import StudyPlan

FLOOR_PICTURE = "floor.png"
_MARGIN_M = 0.5  # around what is drawn
_MARKER_M = 0.3  # length of its arrow
_PATH, _SPOT, _FLOOR_MARKER = "#0f6db3", "#333333", "#c2410c"

Point = tuple[float, float]


def walked_round(path: Sequence[Point]) -> list[Point]:
    """Return the path with its way back to the first point, where it is not closed: it is walked round and
    round."""
    return [*path] if path[0] == path[-1] else [*path, path[0]]


def walk_line(plan: StudyPlan) -> str:
    """Return the researcher's path in words."""
    places = " → ".join(f"{x:g} {y:g}" for x, y in walked_round(plan.path))
    length_m, seconds = _round(plan)
    return (
        f"the researcher walks {places} m, round and round at {plan.walk_m_s:g} m/s: {length_m:.1f} m, "
        f"{seconds:.0f} s a round"
    )


def _round(plan: StudyPlan) -> tuple[float, float]:
    """Return the length of a round, m, and how long it takes, s."""
    length_m = sum(math.dist(a, b) for a, b in pairwise(walked_round(plan.path)))
    return length_m, length_m / plan.walk_m_s


def draw_floor(path: Path, plan: StudyPlan) -> None:
    """Write a PNG. Raises as `atomic_write`."""
    pyplot = agg_pyplot()
    way = walked_round(plan.path)
    xs, ys = zip((0.0, 0.0), *way, *plan.spots, strict=True)
    width, depth = (max(ones) - min(ones) + 2 * _MARGIN_M for ones in (xs, ys))
    scale = 6.5 / max(width, depth)  # inches a metre
    size = max(3.2, scale * width) + 0.6, max(3.2, scale * depth) + 0.9
    figure, axis = pyplot.subplots(figsize=size, layout="constrained")
    _draw_path(axis, way)
    for number, (x, y) in enumerate(plan.spots, 1):
        axis.plot(x, y, "o", markersize=19, markerfacecolor="white", markeredgecolor=_SPOT, zorder=3)
        axis.text(x, y, str(number), ha="center", va="center", fontsize=9, color=_SPOT, zorder=4)
    axis.annotate("", (_MARKER_M, 0.0), (0.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": _FLOOR_MARKER})
    axis.plot(0.0, 0.0, "s", color=_FLOOR_MARKER, zorder=3)
    axis.text(0.0, -0.12, "marker, along x", color=_FLOOR_MARKER, fontsize=8, va="top", zorder=4)
    axis.set_xlim(min(xs) - _MARGIN_M, max(xs) + _MARGIN_M)
    axis.set_ylim(min(ys) - _MARGIN_M, max(ys) + _MARGIN_M)
    axis.set_aspect("equal")
    axis.grid(alpha=0.3)
    axis.set(xlabel="x, m", ylabel="y, m")
    length_m, seconds = _round(plan)
    axis.set_title(
        f"{len(plan.spots)} spots; the researcher's path (blue): {plan.walk_m_s:g} m/s,\n"
        f"{length_m:.1f} m and {seconds:.0f} s a round",
        fontsize=9,
    )
    save_png(figure, path, 130)


def _draw_path(axis: Any, way: Sequence[Point]) -> None:
    """Draw the way with an arrow in the middle of each part."""
    axis.plot(*zip(*way, strict=True), color=_PATH, linewidth=2, alpha=0.8, zorder=1)
    for (ax, ay), (bx, by) in pairwise(way):
        middle = (ax + bx) / 2, (ay + by) / 2
        after = middle[0] + (bx - ax) * 1e-3, middle[1] + (by - ay) * 1e-3
        arrow = {"arrowstyle": "-|>", "color": _PATH, "mutation_scale": 18}
        axis.annotate("", after, middle, arrowprops=arrow, zorder=2)
