"""What is printed on a calibration target, as black rectangles, and gray pictures of it.

Everything on a target is a rectangle along its axes, so a picture is exact: each texel is the share of
it that is black, and that is a product of two overlaps.
"""

from __future__ import annotations

import io
import math
import re
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from share.lab.calibrate.target import AprilGrid, CharucoBoard, Target
from share.types import F64

# ---- A calibration target on a sheet of paper: as large as it may be, and where it lies.

PAPERS = {  # width and height, mm: ISO 216, and ANSI's
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "tabloid": (279.4, 431.8),
}
USUAL = {"aprilgrid": (6, 6), "charuco": (9, 7)}  # columns and rows
MARGIN_MM = 10.0  # that no printer leaves white, and that detectors want
FOOT_MM = 14.0  # under the target, for a ruler and a line of text
_MARKER = 0.75  # of a square
_CUSTOM = re.compile(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)")


@dataclass(frozen=True)
class Sheet:
    """mm. width, height: of the paper. left, low: from its lower left to that of what is black."""

    target: Target
    width: float
    height: float
    left: float
    low: float


def sheet(kind: str, columns: int, rows: int, paper: str, edge_mm: float | None = None) -> Sheet:
    """A target of a kind of `USUAL`, in the middle of the paper, which lies as suits it best.

    paper: of `PAPERS`, or WxH in mm. edge_mm: of a tag or square; by default as many whole millimetres as
    fit, so that a ruler can tell whether it was printed true. Raises ValueError.
    """
    across, up = _sides(board(kind, columns, rows, 1.0))
    width, height = max((_size(paper), _size(paper)[::-1]), key=lambda size: _greatest(across, up, *size))
    greatest = math.floor(10 * _greatest(across, up, width, height)) / 10
    if greatest < 1:
        raise ValueError(f"{paper} is too small for {columns} x {rows}")
    edge = math.floor(greatest) if edge_mm is None else edge_mm
    if edge > greatest:
        board_mm = f"{columns} x {rows} of {edge:g} mm"
        raise ValueError(f"{board_mm} do not fit on {paper}: {greatest:g} mm is the most there")
    wide, high = across * edge, up * edge
    left, low = (width - wide) / 2, FOOT_MM + (height - FOOT_MM - high) / 2
    return Sheet(board(kind, columns, rows, edge / 1000), width, height, left, low)


def board(kind: str, columns: int, rows: int, edge: float) -> Target:
    """edge: of a tag or square, m. Raises ValueError."""
    if kind == "aprilgrid":
        return AprilGrid(rows, columns, edge)
    markers = columns * rows // 2
    dictionary = "DICT_5X5_100" if markers <= 100 else "DICT_5X5_1000"
    return CharucoBoard(columns, rows, edge, round(_MARKER * edge, 9), dictionary)


def _sides(target: Target) -> tuple[float, float]:
    low, high = target.extent
    across, up = (high - low).tolist()
    return across, up


def _size(paper: str) -> tuple[float, float]:
    names = {name.lower(): size for name, size in PAPERS.items()}
    if paper.lower() in names:
        return names[paper.lower()]
    found = _CUSTOM.fullmatch(paper)
    if found is None:
        raise ValueError(f"'{paper}' is no paper; known: {', '.join(PAPERS)}, or WIDTHxHEIGHT in mm")
    return float(found[1]), float(found[2])


def _greatest(across: float, up: float, width: float, height: float) -> float:
    """Edge, mm."""
    return min((width - 2 * MARGIN_MM) / across, (height - 2 * MARGIN_MM - FOOT_MM) / up)


_BORDER = {AprilGrid: 2, CharucoBoard: 1}  # cells around a marker's bits


def ink(target: Target) -> F64:
    """Black rectangles (M, 4) m: x0, y0, x1, y1 in the target's frame. None overlap."""
    if isinstance(target, AprilGrid):
        return np.concatenate([_tags(target), _joints(target)])
    black = target.black
    inset = (target.square - target.marker) / 2
    markers = [_printed(cells, low + inset, target.marker) for cells, low in _markers(target)]
    return np.concatenate([np.hstack([black, black + target.square]), *markers])


def darkness(rectangles: F64, xs: F64, ys: F64) -> F64:
    """Share of each texel that is black, (H, W) 0..1. rectangles: `ink`. xs (W + 1,), rising, and ys
    (H + 1,), falling: borders between texels, m, so that row 0 is the top."""
    across = _overlap(rectangles[:, 0], rectangles[:, 2], xs)
    down = _overlap(rectangles[:, 1], rectangles[:, 3], ys[::-1])[:, ::-1]
    out: F64 = down.T @ across
    return out


def _overlap(low: F64, high: F64, borders: F64) -> F64:
    """Share of each interval between `borders` (N + 1,) that low..high (M,) covers, (M, N)."""
    reach = np.minimum(high[:, None], borders[1:]) - np.maximum(low[:, None], borders[:-1])
    share: F64 = np.maximum(reach, 0) / np.diff(borders)
    return share


def _tags(grid: AprilGrid) -> F64:
    return np.concatenate([_printed(cells, low, grid.tag_size) for cells, low in _markers(grid)])


def _joints(grid: AprilGrid) -> F64:
    """The black squares at the tags' corners."""
    row, column = np.divmod(np.arange((grid.rows + 1) * (grid.cols + 1)), grid.cols + 1)
    low = np.stack([column, row], axis=1) * (grid.tag_size + grid.gap) - grid.gap
    return np.hstack([low, low + grid.gap])


def _markers(target: Target) -> list[tuple[np.ndarray, F64]]:
    """Of each marker the cells (n, n), True for black, row 0 on top, and its lower left corner (2,) m,
    or that of its square."""
    april = isinstance(target, AprilGrid)
    name = "DICT_APRILTAG_36h11" if isinstance(target, AprilGrid) else target.dictionary
    found = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    border = _BORDER[type(target)]
    n = found.markerSize + 2 * border
    places = target.tags if isinstance(target, AprilGrid) else target.marked
    out = []
    for number, low in enumerate(places):
        cells = cv2.aruco.generateImageMarker(found, number, n, borderBits=border) < 128
        out.append((np.rot90(cells, 2) if april else cells, low))  # Kalibr's tags stand on their heads
    return out


def _printed(cells: np.ndarray, low: F64, size: float) -> F64:
    """Black rectangles (K, 4) m of a marker of `size` m: one for each run of black cells in a row."""
    n, out = len(cells), []
    for row, line in enumerate(cells):
        steps = np.flatnonzero(np.diff(np.pad(line.astype(int), 1)))
        out += [(a, n - 1 - row, b, n - row) for a, b in steps.reshape(-1, 2)]
    return np.tile(low, 2) + np.array(out) * (size / n)


# ---- A calibration target as a PDF to print, true to scale.

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
