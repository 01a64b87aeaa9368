"""Corners of a calibration target in an image, by their ids.

OpenCV finds and reads the markers; which corner is which, and how an AprilGrid's are refined, is written down
in docs/do/calibration-boards.md. Partial views are well: every corner that is seen counts on its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from share.lab.calibrate.target import AprilGrid, CharucoBoard, Target
from share.types import F64, I64, U8

_CORNER_ORDER = [1, 0, 3, 2]  # OpenCV's corners of a tag in the order of ours
_HALF_WINDOW = (
    0.4  # of the gap: half the window in which a corner is refined; more of it sees the next corner
)
_MIN_TAGS = 6  # tags; four make a homography, and one of them may be wrong


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
    return (
        _aprilgrid_detector(target, fisheye) if isinstance(target, AprilGrid) else _charuco_detector(target)
    )


def _aprilgrid_detector(grid: AprilGrid, fisheye: bool) -> Callable[[U8], Detection]:
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
            return _no_detection()
        found = np.asarray(tags).reshape(-1)
        px = np.asarray(quads, np.float32).reshape(-1, 4, 2)[:, _CORNER_ORDER]
        found, px = _unique_tags(found, px, grid.rows * grid.cols)
        there = np.ones(len(found), bool) if fisheye else _are_consistent(grid.tags[found], px)
        return _refined_corners(image, grid, 4 * found[there, None] + np.arange(4), px[there])

    return find


def _unique_tags(tag_ids: np.ndarray, px: np.ndarray, tags: int) -> tuple[np.ndarray, np.ndarray]:
    """Tags (N,) and their corners (N, 4, 2) px, each once. One that is large is found at several thresholds:
    its largest outline is its border. One in two places is not believed."""
    middle = px.mean(axis=1)
    sides = np.linalg.norm(px - np.roll(px, 1, axis=1), axis=2).mean(axis=1)
    keep = []
    for tag in np.unique(tag_ids[tag_ids < tags]):
        same = np.flatnonzero(tag_ids == tag)
        largest = same[np.argmax(sides[same])]
        if (np.linalg.norm(middle[same] - middle[largest], axis=1) < sides[largest] / 2).all():
            keep.append(largest)
    return tag_ids[keep], px[keep]


def _are_consistent(tags: F64, px: np.ndarray) -> np.ndarray:
    """Which tags (N, 2) m, seen with corners (N, 4, 2) px, lie where the others say: within half a tag of a
    homography. Lenses bend by less; a tag read wrongly lies elsewhere. Too few to tell by are believed."""
    if len(tags) < _MIN_TAGS:
        return np.ones(len(tags), bool)
    half = np.median(np.linalg.norm(px - np.roll(px, 1, axis=1), axis=2)) / 2
    _, inliers = cv2.findHomography(tags, px.mean(axis=1).astype(float), cv2.RANSAC, float(half))
    return np.ones(len(tags), bool) if inliers is None else np.asarray(inliers).reshape(-1) > 0


def _refined_corners(image: U8, grid: AprilGrid, ids: I64, px: np.ndarray) -> Detection:
    """Tags (N, 4) of corners (N, 4, 2), where their edges meet.

    A quad often reaches into the black square at its corner, by more than a window. So each corner is looked
    for a second time, from where its neighbours say it is. These err, too, at the border of a board that a
    lens bends: where that leads to no saddle, the first is taken, if it is one and no other corner is meant.
    """
    shortest = np.linalg.norm(px - np.roll(px, 1, axis=1), axis=2).min(axis=1, initial=np.inf)
    halves = np.repeat(np.round(_HALF_WINDOW * grid.tag_spacing * shortest).astype(int), 4)
    names = ids.reshape(-1)
    first = refine_corners(image, px.reshape(-1, 2), halves)
    predicted = predict_from_neighbours(grid.corners[names, :2], first)
    second = refine_corners(image, predicted, halves)
    is_second_saddle = saddle_mask(image, second, halves)
    near = np.linalg.norm(first - predicted, axis=1) < 2 * halves
    is_corner = is_second_saddle | (near & saddle_mask(image, first, halves))
    return _detection(names[is_corner], np.where(is_second_saddle[:, None], second, first)[is_corner])


def _charuco_detector(board: CharucoBoard) -> Callable[[U8], Detection]:
    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    size = (board.squares_x, board.squares_y)
    reader = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard(size, board.square, board.marker, family))

    def find(image: U8) -> Detection:
        px, ids, _, _ = reader.detectBoard(image)
        if ids is None or len(ids) == 0:
            return _no_detection()
        return _detection(np.asarray(ids).reshape(-1), np.asarray(px).reshape(-1, 2))

    return find


def _detection(ids: np.ndarray, px: np.ndarray) -> Detection:
    order = np.argsort(ids)
    return Detection(np.asarray(ids, np.int64)[order], np.asarray(px, float)[order])


def _no_detection() -> Detection:
    return Detection(np.empty(0, np.int64), np.empty((0, 2)))


# ---- What residuals of corners (N, 2) px say: how much they scatter, and which were found wrongly.

MIN_SIGMA_PX = 0.01  # px: below this corners are not found, whatever the residuals say
_INLIER_SIGMAS = 5.0  # sigmas beyond which a corner counts as found wrongly
_MIN_EXCESS = 15  # corners, left out more than kept, tell where a lens is no longer of its model


def robust_sigma(residuals: F64) -> float:
    """Of one coordinate, px, by the median distance: 1.1774 sigma of two normal ones."""
    return max(float(np.median(np.linalg.norm(residuals, axis=1))) / 1.1774, MIN_SIGMA_PX)


def inlier_mask(residuals: F64, sigma_px: float) -> NDArray[np.bool_]:
    """Which (N,) are of corners that were not found wrongly. sigma_px: of one coordinate."""
    return np.asarray(np.linalg.norm(residuals, axis=1) <= _INLIER_SIGMAS * sigma_px)


def count_outliers(residuals: F64, sigma_px: float, min_px: float) -> int:
    """How many are beyond what is kept and beyond `min_px`: near the camera corners are found so well that
    those of a board far away look wrong beside them, and are none the worse."""
    is_far = np.linalg.norm(residuals, axis=1) > min_px
    return int((is_far & ~inlier_mask(residuals, sigma_px)).sum())


def rms(residuals: F64) -> float:
    """Of the distances, px; NaN of none."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean())) if len(residuals) else float("nan")


def model_radius(px: F64, centre: F64, inliers: NDArray[np.bool_]) -> float | None:
    """px from the `centre` (2,) beyond which corners (N, 2) px were mostly not kept (N,): there the lens is
    not of its model. The place at which those that were not outnumber the others most; None where by few."""
    distances = np.linalg.norm(px - centre, axis=1)
    by_distance = np.argsort(-distances, kind="stable")
    excess = np.cumsum(np.where(inliers[by_distance], -1, 1))  # left out than kept, beyond each
    edge = int(excess.argmax()) if len(excess) else 0
    return float(distances[by_distance[edge]]) if len(excess) and excess[edge] >= _MIN_EXCESS else None


# ---- Corners where four fields meet, two dark and two bright: saddles of brightness.

_MIN_HALF_WINDOW_PX = 2  # half a window below this refines nothing
_STOP_CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
_CIRCLE_SAMPLES = 16  # places on a circle, an even number


def refine_corners(image: U8, px: np.ndarray, half_windows: I64) -> F64:
    """Corners (N, 2) moved to the saddle in a window of 2 half + 1; NaN where it leaves its window or the
    image, or is too small."""
    limits = np.array(image.shape[::-1]) - 1 - half_windows[:, None]
    fits = ((px >= half_windows[:, None]) & (px <= limits)).all(axis=1) & (
        half_windows >= _MIN_HALF_WINDOW_PX
    )
    out = np.full((len(px), 2), np.nan)
    for half in np.unique(half_windows[fits]).tolist():
        rows = fits & (half_windows == half)
        start = np.ascontiguousarray(px[rows], np.float32)
        moved = cv2.cornerSubPix(image, start.copy(), (half, half), (-1, -1), _STOP_CRITERIA).reshape(-1, 2)
        step = np.linalg.norm(moved - start, axis=1)
        is_moved = (step > 0) & (step < half)  # OpenCV gives the start itself where it would go too far
        out[rows] = np.where(is_moved[:, None], moved, np.nan)
    return out


def saddle_mask(image: U8, px: F64, radii: I64) -> np.ndarray:
    """Which (N,) of corners (N, 2) look the same when turned by half a turn, by brightness on circles of
    `radii` (N,) px: a saddle does, in any perspective; the corner of one dark field does not. No NaN does."""
    out, known = np.zeros(len(px), bool), np.isfinite(px).all(axis=1)
    if not known.any():
        return out
    angle = 2 * np.pi / _CIRCLE_SAMPLES * np.arange(_CIRCLE_SAMPLES)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    x, y = (px[known, None] + radii[known, None, None] * circle).astype(np.float32).transpose(2, 0, 1)
    brightness = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float)
    opposite = np.roll(brightness, _CIRCLE_SAMPLES // 2, axis=1)
    even_part = (brightness + opposite) / 2
    even = ((even_part - even_part.mean(axis=1, keepdims=True)) ** 2).sum(axis=1)
    odd = ((brightness - opposite) ** 2).sum(axis=1) / 4
    out[known] = odd < even
    return out


# ---- Where corners of a flat board lie by what was found around them: a homography each, of its nearest
# others.
#
# Some of the others may have been found wrongly, so each homography is the least median of squares over
# homographies of four (Rousseeuw 1984), then least squares over those that it explains. All corners at once:
# a board has more than a hundred of them, in every picture.

MAX_NEIGHBOURS, MIN_NEIGHBOURS = 12, 6  # neighbours
_SAMPLES = 64  # where two fifths were found wrongly, one of them is without these, 99 of 100 times
_INLIER_MEDIANS = 2.5 * 1.4826  # of the median distance, as Rousseeuw and Leroy have it
_GAUSS_NEWTON_STEPS = 2
_REGULARISATION = 1e-10
_MIN_INLIER_PX = 0.05  # what no corner is better known than


def predict_from_neighbours(board: F64, px: F64) -> F64:
    """Where each corner (N, 2) m is, by others of px (N, 2), NaN not found; NaN if these are too few."""
    neighbours = _nearest_found(board, np.asarray(np.isfinite(px).all(axis=1)))
    if neighbours.shape[1] < MIN_NEIGHBOURS:
        return np.full(px.shape, np.nan)
    board_xy = board[neighbours] - board[:, None]  # each corner is the origin of its own
    board_xy /= np.abs(board_xy).max(axis=(1, 2), keepdims=True)
    middle = px[neighbours].mean(axis=1)
    image_xy = px[neighbours] - middle[:, None]
    with np.errstate(all="ignore"):  # three of four on one line; tags that lie anywhere
        H = _refit_homography(_least_median_homography(board_xy, image_xy), board_xy, image_xy)
        out: F64 = H[:, :2, 2] / H[:, 2:, 2] + middle
    return out


def _nearest_found(board: F64, is_found: np.ndarray) -> I64:
    """Of each corner the nearest others that were found, (N, up to MOST)."""
    squares = ((board[:, None] - board) ** 2).sum(axis=2)
    squares[:, ~is_found] = np.inf
    np.fill_diagonal(squares, np.inf)
    count = min(MAX_NEIGHBOURS, int(is_found.sum()) - 1)
    return np.argsort(squares, axis=1, kind="stable")[:, : max(count, 0)]


@cache
def _quadruples(count: int) -> I64:
    """Which four of `count`, (_FOURS, 4), always the same."""
    return np.random.default_rng(0).random((_SAMPLES, count)).argsort(axis=1)[:, :4]


def _least_median_homography(board_xy: F64, image_xy: F64) -> F64:
    """(N, 3, 3) from (N, M, 2) to (N, M, 2): of all fours the one that half of the others agree with best."""
    fours = _quadruples(board_xy.shape[1])
    H = _basis(image_xy[:, fours]) @ _adjugate(_basis(board_xy[:, fours]))
    H = H / np.abs(H).max(axis=(2, 3), keepdims=True)
    distances = np.linalg.norm(_apply_homography(H, board_xy[:, None]) - image_xy[:, None], axis=3)
    median = np.median(np.where(np.isfinite(distances), distances, np.inf), axis=2)
    out: F64 = np.take_along_axis(H, median.argmin(axis=1)[:, None, None, None], axis=1)[:, 0]
    return out


def _basis(points: F64) -> F64:
    """(..., 3, 3) that takes the unit vectors and their sum to four points (..., 4, 2), to scale (Semple and
    Kneebone, *Algebraic projective geometry*)."""
    columns = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1).swapaxes(-1, -2)
    three, last = columns[..., :3], columns[..., 3:]
    out: F64 = three * (_adjugate(three) @ last).swapaxes(-1, -2)
    return out


def _adjugate(A: F64) -> F64:
    """(..., 3, 3): the inverse times the determinant."""
    a, b, c = A[..., 0], A[..., 1], A[..., 2]
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-2)


def _apply_homography(H: F64, points: F64) -> F64:
    """(..., M, 2) of points (..., M, 2)."""
    homogeneous = points @ H[..., :2].swapaxes(-1, -2) + H[..., None, :, 2]
    out: F64 = homogeneous[..., :2] / homogeneous[..., 2:]
    return out


def _refit_homography(H: F64, board_xy: F64, image_xy: F64) -> F64:
    """Gauss-Newton on the pixels of those that H (N, 3, 3) explains."""
    distances = np.linalg.norm(_apply_homography(H, board_xy) - image_xy, axis=2)
    limit = (
        _INLIER_MEDIANS
        * (1 + 5 / max(board_xy.shape[1] - 4, 1))
        * np.median(distances, axis=1, keepdims=True)
    )
    inliers = (distances <= np.maximum(limit, _MIN_INLIER_PX)).astype(np.float64)
    H = H / H[:, 2:, 2:]
    for _ in range(_GAUSS_NEWTON_STEPS):
        J, r = _linearise(H, board_xy, image_xy)
        weighted = (J * inliers[..., None, None]).reshape(len(H), -1, 8)
        A = weighted.swapaxes(1, 2) @ J.reshape(len(H), -1, 8)
        b = (weighted * r.reshape(len(H), -1, 1)).sum(axis=1)
        step = np.linalg.solve(_regularised(A), b[..., None])[..., 0]
        H = H + np.concatenate([step, np.zeros((len(H), 1))], axis=1).reshape(-1, 3, 3)
    return H


def _regularised(A: F64) -> F64:
    """(N, 8, 8) with which something can be solved, also where a board is none and nothing fits."""
    size = np.trace(A, axis1=1, axis2=2)[:, None, None]
    out: F64 = np.where(np.isfinite(size) & (size > 0), A + _REGULARISATION * size * np.eye(8), np.eye(8))
    return out


def _linearise(H: F64, board_xy: F64, image_xy: F64) -> tuple[F64, F64]:
    """Derivatives (N, M, 2, 8) of what H, whose last number is 1, predicts, and what is left (N, M, 2)."""
    points = np.concatenate([board_xy, np.ones((*board_xy.shape[:2], 1))], axis=2)
    homogeneous = points @ H.swapaxes(1, 2)
    px, scaled = homogeneous[..., :2] / homogeneous[..., 2:], points / homogeneous[..., 2:]
    J = np.zeros((*board_xy.shape, 8))
    J[:, :, 0, :3] = J[:, :, 1, 3:6] = scaled
    J[:, :, :, 6:] = -px[..., None] * scaled[:, :, None, :2]
    return J, image_xy - px
