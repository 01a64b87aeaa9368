"""Detect corners of a calibration target in an image, with their ids.

OpenCV detects the markers; corner ids and the refinement of an AprilGrid's corners:
docs/do/calibration-boards.md. Partial views are fine: every visible corner counts.
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

_CORNER_ORDER = [1, 0, 3, 2]  # OpenCV's corners of a tag in the order of AprilGrid's
_HALF_WINDOW = 0.4  # half the refinement window over the gap; a larger one contains the next corner
_MIN_TAGS = 6  # four make a homography, and one of them may be wrong


@dataclass(frozen=True, eq=False)
class Detection:
    """ids (N,): rows of `target.corners`, rising, unique. px (N, 2): pixel coordinates, pixel centres at
    integers."""

    ids: I64
    px: F64

    def __len__(self) -> int:
        return len(self.ids)


def detector(target: Target, fisheye: bool = False) -> Callable[[U8], Detection]:
    """Return a function that detects this target's corners in a gray image (H, W) of a fisheye lens or
    not; empty if none."""
    return (
        _aprilgrid_detector(target, fisheye) if isinstance(target, AprilGrid) else _charuco_detector(target)
    )


def _aprilgrid_detector(grid: AprilGrid, fisheye: bool) -> Callable[[U8], Detection]:
    options = cv2.aruco.DetectorParameters()
    options.markerBorderBits = 2
    options.errorCorrectionRate = 1.0  # 5 bits: any two tags of the family differ in 11
    options.perspectiveRemovePixelPerCell = 8  # these three detect a sixth more tags on EuRoC's boards
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
        is_valid = np.ones(len(found), bool) if fisheye else _are_consistent(grid.tags[found], px)
        return _refined_corners(image, grid, 4 * found[is_valid, None] + np.arange(4), px[is_valid])

    return find


def _unique_tags(tag_ids: np.ndarray, px: np.ndarray, tags: int) -> tuple[np.ndarray, np.ndarray]:
    """Return each tag (N,) once, with its corners (N, 4, 2) px.

    A large tag is detected at several thresholds; its largest outline is its border. A tag detected in two
    places is rejected.
    """
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
    """Return which tags (N, 2) m, with corners (N, 4, 2) px, lie within half a tag of a common homography.

    Lens distortion is smaller than that; a misread tag lies elsewhere. With too few tags to check, all are
    kept.
    """
    if len(tags) < _MIN_TAGS:
        return np.ones(len(tags), bool)
    half = np.median(np.linalg.norm(px - np.roll(px, 1, axis=1), axis=2)) / 2
    _, inliers = cv2.findHomography(tags, px.mean(axis=1).astype(float), cv2.RANSAC, float(half))
    return np.ones(len(tags), bool) if inliers is None else np.asarray(inliers).reshape(-1) > 0


def _refined_corners(image: U8, grid: AprilGrid, ids: I64, px: np.ndarray) -> Detection:
    """Refine the corners (N, 4, 2) px of tags with corner ids (N, 4), where their edges meet.

    A quad often reaches into the black square at its corner, by more than a window. So each corner is refined
    a second time, from its prediction by its neighbours. Predictions err too, at the border of a board under
    strong distortion: where the second is no saddle, the first is taken, if it is a saddle and near the
    prediction.
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


# Robust statistics of residuals (N, 2) px.

MIN_SIGMA_PX = 0.01  # no detection is more precise, whatever the residuals
_INLIER_SIGMAS = 5.0
_MIN_EXCESS = 15  # outliers in excess of inliers that show where the lens model does not fit


def robust_sigma(residuals: F64) -> float:
    """Return sigma of one coordinate, px, from the median distance: 1.1774 sigma for two normal
    coordinates."""
    return max(float(np.median(np.linalg.norm(residuals, axis=1))) / 1.1774, MIN_SIGMA_PX)


def inlier_mask(residuals: F64, sigma_px: float) -> NDArray[np.bool_]:
    """Return which corners (N,) are inliers. sigma_px: of one coordinate."""
    return np.asarray(np.linalg.norm(residuals, axis=1) <= _INLIER_SIGMAS * sigma_px)


def count_outliers(residuals: F64, sigma_px: float, min_px: float) -> int:
    """Return the number of outliers beyond `min_px`: near corners are so precise that far ones look like
    outliers beside them, but are good enough."""
    is_far = np.linalg.norm(residuals, axis=1) > min_px
    return int((is_far & ~inlier_mask(residuals, sigma_px)).sum())


def rms(residuals: F64) -> float:
    """Return the rms distance, px; NaN of none."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean())) if len(residuals) else float("nan")


def model_radius(px: F64, centre: F64, inliers: NDArray[np.bool_]) -> float | None:
    """Return the radius, px from the `centre` (2,), beyond which most corners (N, 2) px are outliers (N,):
    there the lens model does not fit.

    It is where outliers outnumber inliers most; None if by few.
    """
    distances = np.linalg.norm(px - centre, axis=1)
    by_distance = np.argsort(-distances, kind="stable")
    excess = np.cumsum(np.where(inliers[by_distance], -1, 1))  # outliers minus inliers from each outwards
    edge = int(excess.argmax()) if len(excess) else 0
    return float(distances[by_distance[edge]]) if len(excess) and excess[edge] >= _MIN_EXCESS else None


# Corners where two dark and two bright fields meet: saddles of brightness.

_MIN_HALF_WINDOW_PX = 2  # a smaller window refines nothing
_STOP_CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
_CIRCLE_SAMPLES = 16  # even


def refine_corners(image: U8, px: np.ndarray, half_windows: I64) -> F64:
    """Move corners (N, 2) to the saddle in a window of 2 half + 1; NaN where one leaves its window or the
    image, or the window is too small."""
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
        is_moved = (step > 0) & (step < half)  # OpenCV returns the start where it would go too far
        out[rows] = np.where(is_moved[:, None], moved, np.nan)
    return out


def saddle_mask(image: U8, px: F64, radii: I64) -> np.ndarray:
    """Return which corners (N, 2) are saddles: their brightness on circles of `radii` (N,) px is the same
    after half a turn.

    A saddle's is, in any perspective; that of a single dark corner is not. False for NaN.
    """
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
    odd_part = ((brightness - opposite) ** 2).sum(axis=1) / 4
    out[known] = odd_part < even
    return out


# Prediction of a corner on a flat board by a homography of its nearest found neighbours.
#
# Some neighbours may be wrong, so each homography is the least median of squares over homographies of four
# (Rousseeuw 1984), then least squares over its inliers. Vectorised over all corners: a board has more than a
# hundred, in every image.

MAX_NEIGHBOURS = 12
MIN_NEIGHBOURS = 6
_SAMPLES = 64  # with 40 % outliers, at least one quadruple has none with probability 99 %
_INLIER_MEDIANS = 2.5 * 1.4826  # inlier threshold over the median distance (Rousseeuw and Leroy)
_GAUSS_NEWTON_STEPS = 2
_REGULARISATION = 1e-10
_MIN_INLIER_PX = 0.05  # no corner is more precise


def predict_from_neighbours(board: F64, px: F64) -> F64:
    """Predict each corner (N, 2) m in the image from other corners px (N, 2), NaN if not found; NaN where
    those are too few."""
    neighbours = _nearest_found(board, np.asarray(np.isfinite(px).all(axis=1)))
    if neighbours.shape[1] < MIN_NEIGHBOURS:
        return np.full(px.shape, np.nan)
    board_xy = board[neighbours] - board[:, None]  # relative to the predicted corner
    board_xy /= np.abs(board_xy).max(axis=(1, 2), keepdims=True)
    middle = px[neighbours].mean(axis=1)
    image_xy = px[neighbours] - middle[:, None]
    with np.errstate(all="ignore"):  # three of four on one line; misplaced tags
        H = _refit_homography(_least_median_homography(board_xy, image_xy), board_xy, image_xy)
        out: F64 = H[:, :2, 2] / H[:, 2:, 2] + middle
    return out


def _nearest_found(board: F64, is_found: np.ndarray) -> I64:
    """Return the nearest found other corners of each corner, (N, up to MAX_NEIGHBOURS)."""
    squares = ((board[:, None] - board) ** 2).sum(axis=2)
    squares[:, ~is_found] = np.inf
    np.fill_diagonal(squares, np.inf)
    count = min(MAX_NEIGHBOURS, int(is_found.sum()) - 1)
    return np.argsort(squares, axis=1, kind="stable")[:, : max(count, 0)]


@cache
def _quadruples(count: int) -> I64:
    """Return fixed random quadruples of `count`, (_SAMPLES, 4)."""
    return np.random.default_rng(0).random((_SAMPLES, count)).argsort(axis=1)[:, :4]


def _least_median_homography(board_xy: F64, image_xy: F64) -> F64:
    """Return H (N, 3, 3) from (N, M, 2) to (N, M, 2): of all quadruples' the one with the least median
    distance."""
    fours = _quadruples(board_xy.shape[1])
    H = _basis(image_xy[:, fours]) @ _adjugate(_basis(board_xy[:, fours]))
    H = H / np.abs(H).max(axis=(2, 3), keepdims=True)
    distances = np.linalg.norm(_apply_homography(H, board_xy[:, None]) - image_xy[:, None], axis=3)
    median = np.median(np.where(np.isfinite(distances), distances, np.inf), axis=2)
    out: F64 = np.take_along_axis(H, median.argmin(axis=1)[:, None, None, None], axis=1)[:, 0]
    return out


def _basis(points: F64) -> F64:
    """Return (..., 3, 3) that takes the unit vectors and their sum to four points (..., 4, 2), up to scale
    (Semple and Kneebone, *Algebraic projective geometry*)."""
    columns = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1).swapaxes(-1, -2)
    three, last = columns[..., :3], columns[..., 3:]
    out: F64 = three * (_adjugate(three) @ last).swapaxes(-1, -2)
    return out


def _adjugate(A: F64) -> F64:
    """Return (..., 3, 3): the inverse times the determinant."""
    a, b, c = A[..., 0], A[..., 1], A[..., 2]
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-2)


def _apply_homography(H: F64, points: F64) -> F64:
    """Return (..., M, 2) of points (..., M, 2)."""
    homogeneous = points @ H[..., :2].swapaxes(-1, -2) + H[..., None, :, 2]
    out: F64 = homogeneous[..., :2] / homogeneous[..., 2:]
    return out


def _refit_homography(H: F64, board_xy: F64, image_xy: F64) -> F64:
    """Refine H (N, 3, 3) by Gauss-Newton on the pixels of its inliers."""
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
    """Return solvable (N, 8, 8), also for degenerate boards where no corner fits."""
    size = np.trace(A, axis1=1, axis2=2)[:, None, None]
    out: F64 = np.where(np.isfinite(size) & (size > 0), A + _REGULARISATION * size * np.eye(8), np.eye(8))
    return out


def _linearise(H: F64, board_xy: F64, image_xy: F64) -> tuple[F64, F64]:
    """Return derivatives (N, M, 2, 8) of the prediction by H (last element 1), and residuals (N, M, 2)."""
    points = np.concatenate([board_xy, np.ones((*board_xy.shape[:2], 1))], axis=2)
    homogeneous = points @ H.swapaxes(1, 2)
    px, scaled = homogeneous[..., :2] / homogeneous[..., 2:], points / homogeneous[..., 2:]
    J = np.zeros((*board_xy.shape, 8))
    J[:, :, 0, :3] = J[:, :, 1, 3:6] = scaled
    J[:, :, :, 6:] = -px[..., None] * scaled[:, :, None, :2]
    return J, image_xy - px
