"""A calibration target on a sheet of paper: its layout, its black rectangles, gray images of it, and a PDF to
print.

Everything on a target is an axis-aligned rectangle, so an image is exact: the black fraction of a texel is a
product of two overlaps.
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

PAPERS = {  # width and height, mm: ISO 216 and ANSI
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "tabloid": (279.4, 431.8),
}
DEFAULT_SIZES = {"aprilgrid": (6, 6), "charuco": (9, 7)}  # columns and rows
MARGIN_MM = 10.0  # white border that printers and detectors need
FOOTER_MM = 14.0  # under the target, for a ruler and a line of text
_MARKER_SHARE = 0.75  # of a square's edge
_CUSTOM_PAPER = re.compile(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)")


@dataclass(frozen=True)
class Sheet:
    """A target on paper, mm. width, height: of the paper. left, bottom: from its lower left corner to that
    of the black area."""

    target: Target
    width: float
    height: float
    left: float
    bottom: float


def make_sheet(kind: str, columns: int, rows: int, paper: str, edge_mm: float | None = None) -> Sheet:
    """Return a target of a kind of `DEFAULT_SIZES` in the middle of the paper, portrait or landscape as fits
    best.

    paper: of `PAPERS`, or WxH in mm. edge_mm: of a tag or square; by default the largest whole millimetres
    that fit, so that a ruler can check the print. Raises ValueError.
    """
    width_edges, height_edges = np.ptp(make_board(kind, columns, rows, 1.0).extent, axis=0).tolist()
    width, height = max(
        (_paper_size(paper), _paper_size(paper)[::-1]),
        key=lambda size: _max_edge_mm(width_edges, height_edges, *size),
    )
    max_edge = math.floor(10 * _max_edge_mm(width_edges, height_edges, width, height)) / 10
    if max_edge < 1:
        raise ValueError(f"{paper} is too small for {columns} x {rows}")
    edge = math.floor(max_edge) if edge_mm is None else edge_mm
    if edge > max_edge:
        board_mm = f"{columns} x {rows} of {edge:g} mm"
        raise ValueError(f"{board_mm} do not fit on {paper}: at most {max_edge:g} mm fit")
    board_width, board_height = width_edges * edge, height_edges * edge
    left, bottom = (width - board_width) / 2, FOOTER_MM + (height - FOOTER_MM - board_height) / 2
    return Sheet(make_board(kind, columns, rows, edge / 1000), width, height, left, bottom)


def make_board(kind: str, columns: int, rows: int, edge: float) -> Target:
    """Return a target; edge: of a tag or square, m. Raises ValueError."""
    if kind == "aprilgrid":
        return AprilGrid(rows, columns, edge)
    markers = columns * rows // 2
    dictionary = "DICT_5X5_100" if markers <= 100 else "DICT_5X5_1000"
    return CharucoBoard(columns, rows, edge, round(_MARKER_SHARE * edge, 9), dictionary)


def _paper_size(paper: str) -> tuple[float, float]:
    names = {name.lower(): size for name, size in PAPERS.items()}
    if paper.lower() in names:
        return names[paper.lower()]
    match = _CUSTOM_PAPER.fullmatch(paper)
    if match is None:
        raise ValueError(f"'{paper}' is not a paper size; known: {', '.join(PAPERS)}, or WIDTHxHEIGHT in mm")
    return float(match[1]), float(match[2])


def _max_edge_mm(width_edges: float, height_edges: float, width: float, height: float) -> float:
    """Return the largest edge that fits, mm."""
    return min((width - 2 * MARGIN_MM) / width_edges, (height - 2 * MARGIN_MM - FOOTER_MM) / height_edges)


_BORDER = {AprilGrid: 2, CharucoBoard: 1}  # cells around a marker's bits


def black_rectangles(target: Target) -> F64:
    """Return the black rectangles (M, 4) m, without overlaps: x0, y0, x1, y1 in the target's frame."""
    if isinstance(target, AprilGrid):
        tags = [_marker_rectangles(cells, low, target.tag_size) for cells, low in _marker_cells(target)]
        return np.concatenate([*tags, _corner_squares(target)])
    squares = target.black_squares
    inset = (target.square - target.marker) / 2
    markers = [
        _marker_rectangles(cells, lower_left + inset, target.marker)
        for cells, lower_left in _marker_cells(target)
    ]
    return np.concatenate([np.hstack([squares, squares + target.square]), *markers])


def darkness_image(rectangles: F64, xs: F64, ys: F64) -> F64:
    """Return the black fraction of each texel, (H, W) 0..1, from `black_rectangles`.

    xs (W + 1,), rising, and ys (H + 1,), falling: borders between texels, m, so that row 0 is the top.
    """
    cover_x = _overlap(rectangles[:, 0], rectangles[:, 2], xs)
    cover_y = _overlap(rectangles[:, 1], rectangles[:, 3], ys[::-1])[:, ::-1]
    out: F64 = cover_y.T @ cover_x
    return out


def _overlap(low: F64, high: F64, borders: F64) -> F64:
    """Return the fraction of each interval between `borders` (N + 1,) that low..high (M,) covers, (M, N)."""
    reach = np.minimum(high[:, None], borders[1:]) - np.maximum(low[:, None], borders[:-1])
    share: F64 = np.maximum(reach, 0) / np.diff(borders)
    return share


def _corner_squares(grid: AprilGrid) -> F64:
    """Return the black squares at the tags' corners."""
    row, column = np.divmod(np.arange((grid.rows + 1) * (grid.cols + 1)), grid.cols + 1)
    low = np.stack([column, row], axis=1) * (grid.tag_size + grid.gap) - grid.gap
    return np.hstack([low, low + grid.gap])


def _marker_cells(target: Target) -> list[tuple[np.ndarray, F64]]:
    """Return of each marker the cells (n, n), True for black, row 0 on top, and its (or its square's)
    lower left corner (2,) m."""
    april = isinstance(target, AprilGrid)
    name = "DICT_APRILTAG_36h11" if isinstance(target, AprilGrid) else target.dictionary
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    border = _BORDER[type(target)]
    n = dictionary.markerSize + 2 * border
    places = target.tags if isinstance(target, AprilGrid) else target.marker_squares
    out = []
    for number, lower_left in enumerate(places):
        cells = cv2.aruco.generateImageMarker(dictionary, number, n, borderBits=border) < 128
        out.append((np.rot90(cells, 2) if april else cells, lower_left))  # Kalibr's tags are upside down
    return out


def _marker_rectangles(cells: np.ndarray, lower_left: F64, size: float) -> F64:
    """Return black rectangles (K, 4) m of a marker of `size` m: one for each run of black cells in a row."""
    n, out = len(cells), []
    for row, line in enumerate(cells):
        steps = np.flatnonzero(np.diff(np.pad(line.astype(int), 1)))
        out += [(a, n - 1 - row, b, n - row) for a, b in steps.reshape(-1, 2)]
    return np.tile(lower_left, 2) + np.array(out) * (size / n)


_INCH = 25.4  # mm
_RULER_MM = 100.0
_SHORT_RULER_MM = 50.0  # where the paper is too narrow for the other
_FOOTER_TEXT_MM = 90.0  # beside the ruler, with margins


def sheet_pdf(sheet: Sheet) -> bytes:
    """Return a one-page PDF, all in vectors."""
    from matplotlib.backends.backend_pdf import FigureCanvasPdf
    from matplotlib.figure import Figure

    figure = Figure(figsize=(sheet.width / _INCH, sheet.height / _INCH))
    page = figure.add_axes((0, 0, 1, 1), xlim=(0, sheet.width), ylim=(0, sheet.height))
    page.set_axis_off()
    origin = (sheet.left, sheet.bottom) - 1000 * sheet.target.extent[0]
    page.add_patch(_rectangles_patch(1000 * black_rectangles(sheet.target) + np.tile(origin, 2)))
    _draw_footer(page, sheet)
    out = io.BytesIO()
    FigureCanvasPdf(figure).print_pdf(out, metadata={"CreationDate": None, "Title": describe_sheet(sheet)})
    return out.getvalue()


def describe_sheet(sheet: Sheet) -> str:
    """Describe the target for readers."""
    target = sheet.target
    if isinstance(target, AprilGrid):
        edge, gap = 1000 * target.tag_size, 1000 * target.gap
        return f"aprilgrid, {target.cols} x {target.rows} tags of {edge:g} mm, {gap:g} mm apart"
    squares, edge = f"{target.squares_x} x {target.squares_y}", 1000 * target.square
    return f"charuco, {squares} squares of {edge:g} mm, {target.dictionary}"


def _rectangles_patch(rectangles: F64) -> Any:
    """Return rectangles (M, 4) mm as one path, so that neighbours show no seam."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    x0, y0, x1, y1 = rectangles.T
    points = np.stack([x0, y0, x1, y0, x1, y1, x0, y1, x0, y0], axis=1).reshape(-1, 2)
    codes = np.tile([Path.MOVETO, *3 * [Path.LINETO], Path.CLOSEPOLY], len(rectangles))
    return PathPatch(Path(points, codes), facecolor="black", linewidth=0)


def _draw_footer(page: Any, sheet: Sheet) -> None:
    """Draw a ruler and a line of text."""
    long = _RULER_MM if sheet.width >= _RULER_MM + _FOOTER_TEXT_MM else _SHORT_RULER_MM
    x, y = MARGIN_MM, FOOTER_MM - 3
    page.plot([x, x + long], [y, y], color="black", linewidth=0.6, solid_capstyle="butt")
    for mark in np.arange(0, long + 1, 10):
        page.plot([x + mark] * 2, [y, y + 2], color="black", linewidth=0.3)
    text = f"{describe_sheet(sheet)}\nprint at 100 %; this ruler is {long:g} mm long"
    page.text(x + long + 4, y, text, fontsize=7, va="center")
