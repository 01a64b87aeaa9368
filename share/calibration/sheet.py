"""A calibration target on a sheet of paper: as large as it may be, and where it lies."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from share.geometry.target import AprilGrid, CharucoBoard, Target

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
