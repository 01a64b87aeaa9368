"""Corners of a calibration target in an image, by their ids.

OpenCV finds and reads the markers; which corner is which, and how an AprilGrid's are refined, is written down
in docs/calibration-boards.md. Partial views are well: every corner that is seen counts on its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from share.calibration.neighbours import by_neighbours
from share.calibration.saddle import is_saddle, refined
from share.geometry.target import AprilGrid, CharucoBoard, Target
from share.types import F64, I64, U8

_OURS = [1, 0, 3, 2]  # OpenCV's corners of a tag in the order of ours
_WINDOW = 0.4  # of the gap: half the window in which a corner is refined; more of it sees the next corner
_TO_TELL = 6  # tags; four make a homography, and one of them may be wrong


@dataclass(frozen=True, eq=False)
class Detection:
    """ids (N,): rows of `target.corners`, rising, each once; px (N, 2): where they are, of centres at
    integers."""

    ids: I64
    px: F64

    def __len__(self) -> int:
        return len(self.ids)


def detector(target: Target, fisheye: bool = False) -> Callable[[U8], Detection]:
    """What finds this target's corners in a gray image (H, W), of a fisheye lens or not; none found is an
    empty Detection."""
    return _april(target, fisheye) if isinstance(target, AprilGrid) else _charuco(target)


def _april(grid: AprilGrid, fisheye: bool) -> Callable[[U8], Detection]:
    options = cv2.aruco.DetectorParameters()
    options.markerBorderBits = 2
    options.errorCorrectionRate = 1.0  # 5 bits: any two tags of the family differ in 11
    options.perspectiveRemovePixelPerCell = 8  # these three find a sixth more of the tags on EuRoC's boards
    options.perspectiveRemoveIgnoredMarginPerCell = 0.3
    options.minMarkerDistanceRate = 0.01
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    reader = cv2.aruco.ArucoDetector(family, options)

    def find(image: U8) -> Detection:
        quads, tags, _ = reader.detectMarkers(image)
        if tags is None or len(tags) == 0:
            return _nothing()
        found = np.asarray(tags).reshape(-1)
        px = np.asarray(quads, np.float32).reshape(-1, 4, 2)[:, _OURS]
        found, px = _once(found, px, grid.rows * grid.cols)
        there = np.ones(len(found), bool) if fisheye else _in_place(grid.tags[found], px)
        return _corners(image, grid, 4 * found[there, None] + np.arange(4), px[there])

    return find


def _once(found: np.ndarray, px: np.ndarray, tags: int) -> tuple[np.ndarray, np.ndarray]:
    """Tags (N,) and their corners (N, 4, 2) px, each once. One that is large is found at several thresholds:
    its largest outline is its border. One in two places is not believed."""
    middle = px.mean(axis=1)
    sides = np.linalg.norm(px - np.roll(px, 1, axis=1), axis=2).mean(axis=1)
    keep = []
    for tag in np.unique(found[found < tags]):
        same = np.flatnonzero(found == tag)
        largest = same[np.argmax(sides[same])]
        if (np.linalg.norm(middle[same] - middle[largest], axis=1) < sides[largest] / 2).all():
            keep.append(largest)
    return found[keep], px[keep]


def _in_place(tags: F64, px: np.ndarray) -> np.ndarray:
    """Which tags (N, 2) m, seen with corners (N, 4, 2) px, lie where the others say: within half a tag of a
    homography. Lenses bend by less; a tag read wrongly lies elsewhere. Too few to tell by are believed."""
    if len(tags) < _TO_TELL:
        return np.ones(len(tags), bool)
    half = np.median(np.linalg.norm(px - np.roll(px, 1, axis=1), axis=2)) / 2
    _, fits = cv2.findHomography(tags, px.mean(axis=1).astype(float), cv2.RANSAC, float(half))
    return np.ones(len(tags), bool) if fits is None else np.asarray(fits).reshape(-1) > 0


def _corners(image: U8, grid: AprilGrid, ids: I64, px: np.ndarray) -> Detection:
    """Tags (N, 4) of corners (N, 4, 2), where their edges meet.

    A quad often reaches into the black square at its corner, by more than a window. So each corner is looked
    for a second time, from where its neighbours say it is. These err, too, at the border of a board that a
    lens bends: where that leads to no saddle, the first is taken, if it is one and no other corner is meant.
    """
    shortest = np.linalg.norm(px - np.roll(px, 1, axis=1), axis=2).min(axis=1, initial=np.inf)
    halves = np.repeat(np.round(_WINDOW * grid.tag_spacing * shortest).astype(int), 4)
    names = ids.reshape(-1)
    first = refined(image, px.reshape(-1, 2), halves)
    there = by_neighbours(grid.corners[names, :2], first)
    second = refined(image, there, halves)
    sound = is_saddle(image, second, halves)
    near = np.linalg.norm(first - there, axis=1) < 2 * halves
    seen = sound | (near & is_saddle(image, first, halves))
    return _detection(names[seen], np.where(sound[:, None], second, first)[seen])


def _charuco(board: CharucoBoard) -> Callable[[U8], Detection]:
    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    size = (board.squares_x, board.squares_y)
    reader = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard(size, board.square, board.marker, family))

    def find(image: U8) -> Detection:
        px, ids, _, _ = reader.detectBoard(image)
        if ids is None or len(ids) == 0:
            return _nothing()
        return _detection(np.asarray(ids).reshape(-1), np.asarray(px).reshape(-1, 2))

    return find


def _detection(ids: np.ndarray, px: np.ndarray) -> Detection:
    order = np.argsort(ids)
    return Detection(np.asarray(ids, np.int64)[order], np.asarray(px, float)[order])


def _nothing() -> Detection:
    return Detection(np.empty(0, np.int64), np.empty((0, 2)))
