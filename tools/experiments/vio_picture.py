"""One picture a sequence: errors over time within the filter's three sigma."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image  # comes with matplotlib

from share.types import F64, I64

_COLOURS = ("#00798c", "#d1495b", "#b8860b")
_PALETTE = 64  # colours of the file
_GAP_S = 0.2  # longer gaps without a pose interrupt the line
_BEGINNING_S, _ROOM = 10.0, 1.08  # the scale is that of later errors, with a margin


class Curves(NamedTuple):
    """One run: t_s (N,) since its first frame; errors and sigmas (N, 6) rad, then m; segment (N,)."""

    label: str
    t_s: F64
    errors: F64
    sigmas: F64
    segment: I64


class Part(NamedTuple):
    """columns: of the errors; scale: from their unit to the shown one."""

    name: str
    columns: slice
    scale: float
    unit: str
    axes: tuple[str, str, str]


PARTS = (
    Part("position", slice(3, 6), 100.0, "cm", ("x", "y", "z, up")),
    Part("orientation", slice(0, 3), float(np.degrees(1)), "°", ("about x", "about y", "heading")),
)


def draw(path: Path, title: str, runs: list[Curves]) -> None:
    """Write a PNG, all runs in every panel: position at the left, orientation at the right, an axis a row."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    style = {"font.size": 11, "axes.spines.top": False, "axes.spines.right": False}
    with pyplot.rc_context(style):
        figure, panels = pyplot.subplots(3, 2, figsize=(13, 7.8), sharex=True, layout="constrained")
        for column, part in enumerate(PARTS):
            _column(panels[:, column], runs, part)
        handles = [line for line in panels[0, 0].lines if not line.get_label().startswith("_")]
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
        figure.suptitle(title, fontsize=13)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=90)
        pyplot.close(figure)
    Image.open(path).convert("RGB").quantize(_PALETTE).save(path, optimize=True)  # a quarter of the bytes


def _column(panels: Any, runs: list[Curves], part: Part) -> None:
    """Draw three axes on one scale: that of errors after the beginning; larger ones are noted in the
    title."""
    limit, largest = (part.scale * largest_of(runs, part.columns, since) for since in (_BEGINNING_S, 0.0))
    outside = f"\n(in the first {_BEGINNING_S:g} s up to {largest:.2g} {part.unit})"
    beyond = outside if largest > _ROOM * limit else ""
    panels[0].set_title(f"{part.name}, estimate less truth; shaded: ± 3σ of the filter{beyond}", fontsize=11)
    for axis, panel in enumerate(panels):
        for run, colour in zip(runs, _COLOURS * len(runs), strict=False):
            _curve(panel, run, part.columns.start + axis, part.scale, colour)
        panel.set_ylabel(f"{part.axes[axis]} [{part.unit}]")
        panel.set_ylim(-_ROOM * limit, _ROOM * limit)
        panel.axhline(0, color="black", linewidth=0.6)
        panel.grid(alpha=0.3)
        panel.margins(x=0.01)
    panels[-1].set_xlabel("time [s]")


def _curve(panel: Any, run: Curves, column: int, scale: float, colour: str) -> None:
    t, error, sigma = (broken(run, values) for values in (run.t_s, run.errors, run.sigmas))
    band = 3 * scale * sigma[:, column]
    panel.fill_between(t, -band, band, color=colour, alpha=0.10, linewidth=0)
    panel.plot(t, np.stack([-band, band], axis=1), color=colour, alpha=0.5, linewidth=0.8, linestyle="--")
    panel.plot(t, scale * error[:, column], color=colour, linewidth=1.4, label=run.label)


def largest_of(runs: list[Curves], columns: slice, since_s: float) -> float:
    """Return the largest error or three sigma from `since_s` on."""
    each = [np.maximum(np.abs(run.errors), 3 * run.sigmas)[run.t_s >= since_s, columns] for run in runs]
    return max((float(values.max()) for values in each if values.size), default=1.0)


def broken(run: Curves, values: F64) -> F64:
    """Return values (N, …) with NaN between where the run has a gap or a new segment."""
    gaps = np.flatnonzero((np.diff(run.t_s) > _GAP_S) | (np.diff(run.segment) != 0)) + 1
    out: F64 = np.insert(values, gaps, np.nan, axis=0)
    return out
