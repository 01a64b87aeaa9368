"""A calibration target as a PDF to print, true to scale."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from share.calibration.sheet import FOOT_MM, MARGIN_MM, Sheet
from share.geometry.target import AprilGrid
from share.types import F64
from share.vision.target_picture import ink

_INCH = 25.4
_RULER_MM, _SHORT_MM = 100.0, 50.0
_WORDS_MM = 90.0  # beside it, with margins


def pdf(sheet: Sheet) -> bytes:
    """One page, all in vectors."""
    from matplotlib.backends.backend_pdf import FigureCanvasPdf
    from matplotlib.figure import Figure

    figure = Figure(figsize=(sheet.width / _INCH, sheet.height / _INCH))
    page = figure.add_axes((0, 0, 1, 1), xlim=(0, sheet.width), ylim=(0, sheet.height))
    page.set_axis_off()
    origin = (sheet.left, sheet.low) - 1000 * sheet.target.extent[0]
    page.add_patch(_black(1000 * ink(sheet.target) + np.tile(origin, 2)))
    _foot(page, sheet)
    out = io.BytesIO()
    FigureCanvasPdf(figure).print_pdf(out, metadata={"CreationDate": None, "Title": words(sheet)})
    return out.getvalue()


def words(sheet: Sheet) -> str:
    """What it is, for people."""
    target = sheet.target
    if isinstance(target, AprilGrid):
        edge, gap = 1000 * target.tag_size, 1000 * target.gap
        return f"aprilgrid, {target.cols} x {target.rows} tags of {edge:g} mm, {gap:g} mm apart"
    squares, edge = f"{target.squares_x} x {target.squares_y}", 1000 * target.square
    return f"charuco, {squares} squares of {edge:g} mm, {target.dictionary}"


def _black(rectangles: F64) -> Any:
    """Of (M, 4) mm: one path, so that neighbours show no seam."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    x0, y0, x1, y1 = rectangles.T
    points = np.stack([x0, y0, x1, y0, x1, y1, x0, y1, x0, y0], axis=1).reshape(-1, 2)
    codes = np.tile([Path.MOVETO, *3 * [Path.LINETO], Path.CLOSEPOLY], len(rectangles))
    return PathPatch(Path(points, codes), facecolor="black", linewidth=0)


def _foot(page: Any, sheet: Sheet) -> None:
    """A ruler, and what it is for."""
    long = _RULER_MM if sheet.width >= _RULER_MM + _WORDS_MM else _SHORT_MM
    x, y = MARGIN_MM, FOOT_MM - 3
    page.plot([x, x + long], [y, y], color="black", linewidth=0.6, solid_capstyle="butt")
    for mark in np.arange(0, long + 1, 10):
        page.plot([x + mark] * 2, [y, y + 2], color="black", linewidth=0.3)
    told = f"{words(sheet)}\nprint at 100 %; this ruler is {long:g} mm long"
    page.text(x + long + 4, y, told, fontsize=7, va="center")
