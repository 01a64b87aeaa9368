"""Check a camera calibration: does it pass, and if not, what to do. Also coverage and choice of views, and
epipolar distances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.geometry.camera import Camera, rays
from share.geometry.se3 import hat
from share.lab.calibrate import corners
from share.lab.calibrate.camera_bundle import CameraBundleSolution
from share.lab.calibrate.camera_initialisation import has_enough_corners, homography, intrinsics
from share.lab.calibrate.corner_observations import BoardView
from share.lab.calibrate.report import corner_failures
from share.lab.calibrate.target import Target
from share.types import F64, I64

MIN_VIEW_COUNT = 12
MIN_COVERAGE = 0.6  # of the image's cells
MAX_RMS_PX = 0.5  # of inlier corners
MAX_EPIPOLAR_PX = 0.3  # median distance from epipolar lines
MAX_FOCAL_SIGMA = 2e-3  # over the focal length
_OUTLIER_MADS = 5.0
_MAD = 1.4826  # sigma of a normal distribution over its median absolute deviation


@dataclass(frozen=True, eq=False)
class CameraVerdict:
    """reasons: of a failure, empty if it passes. rms_px of each camera's inlier corners, rms_all_px of all;
    number of outlier corners.

    view_rms (V, cameras) px, NaN where a camera saw no corner, and which of these are outliers. epipolar_px:
    median distance of common corners from their epipolar lines, None with one camera.
    """

    reasons: tuple[str, ...]
    rms_px: tuple[float, ...]
    rms_all_px: tuple[float, ...]
    outlier_corners: tuple[int, ...]
    view_rms: F64
    is_outlier_view: NDArray[np.bool_]
    epipolar_px: float | None

    @property
    def outlier_views(self) -> tuple[int, ...]:
        """Rows of views that are outliers in any camera."""
        return tuple(np.flatnonzero(self.is_outlier_view.any(axis=1)).tolist())

    @property
    def passed(self) -> bool:
        return not self.reasons


def judge_cameras(
    solution: CameraBundleSolution, coverages: Sequence[Coverage], stereo_views: Sequence[BoardView] = ()
) -> CameraVerdict:
    """Check a solution and the coverage of each camera's views.

    stereo_views: all views in which two cameras saw the board, used in the solution or not.
    """
    cams = range(len(solution.state.cameras))
    residuals = [camera_residuals(solution, cam) for cam in cams]
    inliers = [corners.inlier_mask(r, solution.sigma_px) for r in residuals]
    reasons = [reason for cam in cams for reason in _failures(solution, cam, residuals[cam])]
    reasons += [
        f"cam{cam}: corners in {cover.share:.0%} of the image, {MIN_COVERAGE:.0%} needed; "
        + "; ".join(cover.gaps)
        for cam, cover in enumerate(coverages)
        if cover.share < MIN_COVERAGE
    ]
    epipolar_px, state = None, solution.state
    if len(cams) == 2:
        epipolar_px = median_epipolar_px(state.cameras[0], state.cameras[1], state.T_cam1_cam0, stereo_views)
        if not epipolar_px <= MAX_EPIPOLAR_PX:
            reasons.append(
                f"stereo pair: median distance of corners from their epipolar lines is {epipolar_px:.2f} px, "
                f"at most {MAX_EPIPOLAR_PX:g} allowed: do both cameras expose at once, is one loose?"
            )
    view_rms = np.array([[corners.rms(view[cam]) for cam in cams] for view in solution.residuals])
    return CameraVerdict(
        reasons=tuple(reasons),
        rms_px=tuple(corners.rms(r[k]) for r, k in zip(residuals, inliers, strict=True)),
        rms_all_px=tuple(corners.rms(r) for r in residuals),
        outlier_corners=tuple(int((~k).sum()) for k in inliers),
        view_rms=view_rms,
        is_outlier_view=_outlier_views(view_rms),
        epipolar_px=epipolar_px,
    )


def _failures(solution: CameraBundleSolution, cam: int, residuals: F64) -> list[str]:
    out, views = [], sum(len(view[cam]) > 0 for view in solution.residuals)
    if views < MIN_VIEW_COUNT:
        out.append(f"cam{cam}: {views} views, {MIN_VIEW_COUNT} needed")
    hint = "are the images blurred, the board bent, or --target wrong?"
    out += corner_failures(cam, residuals, solution.sigma_px, MAX_RMS_PX, hint)
    sigmas = solution.sigmas[solution.state.intrinsic_slices[cam]]
    focal_sigma = float((sigmas[:2] / intrinsics(solution.state.cameras[cam])[:2]).max())
    if not focal_sigma <= MAX_FOCAL_SIGMA:
        out.append(
            f"cam{cam}: focal length known to {focal_sigma:.2%}, {MAX_FOCAL_SIGMA:.2%} needed: tilt the "
            "board more"
        )
    return out


def camera_residuals(solution: CameraBundleSolution, cam: int) -> F64:
    """Return a camera's residuals (N, 2) px over all views."""
    return np.concatenate([view[cam] for view in solution.residuals])


def _outlier_views(view_rms: F64) -> NDArray[np.bool_]:
    """Return which RMS (V, cameras) are beyond median + 5 MAD of their camera."""
    middle = np.nanmedian(view_rms, axis=0)
    spread = _MAD * np.nanmedian(np.abs(view_rms - middle), axis=0)
    return np.asarray(view_rms > middle + _OUTLIER_MADS * spread)


# Coverage and choice of views. Intrinsics need corners in the whole image, boards tilted to each side (else
# focal length and distance are not separable), and near and far boards.

CELL_GRID = (6, 8)  # rows and columns of cells in which corners are counted
_REGION_NAMES = (
    ("upper left corner", "upper edge", "upper right corner"),
    ("left edge", "middle", "right edge"),
    ("lower left corner", "lower edge", "lower right corner"),
)
_MIN_TILT_DEG = 15.0
_TILT_WEIGHT = 3.0  # of tilt and size, relative to one cell
_TIME_WEIGHT = 10.0  # of the part of the recording: neighbours are nearly copies with equal errors


@dataclass(frozen=True, eq=False)
class Coverage:
    """Coverage by one camera's V views. cells: corners in each cell of `CELL_GRID`. tilts (V, 2): of the
    board about the image's y and x, rad. distances (V,): m."""

    cells: I64
    tilts: F64
    distances: F64

    @property
    def share(self) -> float:
        """Fraction of the cells with a corner."""
        return float((self.cells > 0).mean())

    @property
    def gaps(self) -> tuple[str, ...]:
        """Views that are missing, as instructions for a person."""
        regions = self.cells.reshape(3, 2, 8)
        columns = (slice(0, 2), slice(2, 6), slice(6, 8))
        empty = [
            _REGION_NAMES[row][k]
            for row in range(3)
            for k in range(3)
            if not regions[row][:, columns[k]].any()
        ]
        out = [f"no view reaches the image's {name}" for name in empty]
        limit = np.radians(_MIN_TILT_DEG)
        for axis, (low, high) in enumerate((("left", "right"), ("top", "bottom"))):
            for name, is_tilted in ((low, self.tilts[:, axis] < -limit), (high, self.tilts[:, axis] > limit)):
                if not is_tilted.any():
                    out.append(f"no view with the board's {name} side {_MIN_TILT_DEG:.0f} degrees nearer")
        if self.distances.max() < 1.3 * self.distances.min():
            out.append("all views are from one distance: move nearer and farther")
        return tuple(out)


def coverage(pixels: Sequence[F64], T_cam_target: F64, target: Target, size: tuple[int, int]) -> Coverage:
    """Return the coverage by corners (N, 2) px of each view and its pose (V, 4, 4); empty views do not
    count."""
    T_cam_target = T_cam_target[[len(px) > 0 for px in pixels]]
    middle = np.append(target.extent.mean(axis=0), 0)
    centres = T_cam_target[:, :3, :3] @ middle + T_cam_target[:, :3, 3]
    normal = -T_cam_target[:, :3, 2]  # away from the viewer
    tilts = np.arctan2(normal[:, :2], normal[:, 2:])
    cells = np.bincount(cell_numbers(np.concatenate(pixels), size), minlength=CELL_GRID[0] * CELL_GRID[1])
    return Coverage(cells.reshape(CELL_GRID), tilts, np.linalg.norm(centres, axis=1))


def cell_numbers(px: F64, size: tuple[int, int]) -> I64:
    """Return the number of the cell (N,) of each pixel (N, 2), along rows."""
    column, row = np.clip(px / size * CELL_GRID[::-1], 0, np.array(CELL_GRID[::-1]) - 1).astype(np.int64).T
    return np.asarray(row * CELL_GRID[1] + column, np.int64)


def choose_views(
    views: Sequence[BoardView], target: Target, size: tuple[int, int], max_views: int
) -> list[int]:
    """Return rows of at most `max_views` views, rising. Greedy: each time the view that adds most of what
    is still rare among image cells, board tilts, board sizes and parts of the recording (`views` are in
    its order)."""
    view_classes = [_view_classes(view, target, size) for view in views]
    for k, classes in enumerate(view_classes):
        if classes:
            classes["time", k * max_views // len(views)] = _TIME_WEIGHT
    counts: dict[object, int] = {}
    chosen_rows: list[int] = []
    left = [k for k, classes in enumerate(view_classes) if classes]
    while left and len(chosen_rows) < max_views:
        gains = [
            sum(weight / (1 + counts.get(key, 0)) ** 2 for key, weight in view_classes[k].items())
            for k in left
        ]
        best = left.pop(int(np.argmax(gains)))
        chosen_rows.append(best)
        for key in view_classes[best]:
            counts[key] = counts.get(key, 0) + 1
    return sorted(chosen_rows)


def _view_classes(view: BoardView, target: Target, size: tuple[int, int]) -> dict[object, float]:
    """Return what a view contributes, with weights: its cells, and classes of tilt and size by its
    homography."""
    out: dict[object, float] = {}
    for cam, detection in enumerate(view.detections):
        board = target.corners[detection.ids, :2]
        if not has_enough_corners(board):
            continue
        for cell in np.unique(cell_numbers(detection.px, size)).tolist():
            out[cam, "cell", cell] = 1.0
        H = homography(board, (detection.px - np.array(size) / 2) / max(size))
        H = H / H[2, 2]
        tilt = np.clip(np.round(H[2, :2] / 0.25), -2, 2).astype(int)
        out[cam, "tilt", *tilt.tolist()] = _TILT_WEIGHT
        out[cam, "size", round(np.log2(abs(np.linalg.det(H[:2, :2]))))] = _TILT_WEIGHT
    return out


# Epipolar distances. A corner of cam0 defines a line on which cam1 must see it (Hartley and Zisserman,
# Multiple View Geometry, 9.2). The distance from that line does not depend on the board's shape or pose, so
# images that were not used in the calibration check it too. It is also the row error that stereo matching
# suffers from.


def epipolar_distances(cam0: Camera, cam1: Camera, T_cam1_cam0: F64, views: Sequence[BoardView]) -> F64:
    """Return signed distances (N,), undistorted px of cam1, of corners that both cameras saw from their
    epipolar lines.

    For fisheye lenses: px of the image, for corners with normalised coordinates only.
    """
    pairs = [_common_corners(view) for view in views]
    px0, px1 = (np.concatenate([pair[cam] for pair in pairs] or [np.empty((0, 2))]) for cam in (0, 1))
    lines = rays(cam0.normalise(px0)) @ (hat(T_cam1_cam0[:3, 3]) @ T_cam1_cam0[:3, :3]).T
    uv1 = cam1.normalise(px1)
    algebraic = (rays(uv1) * lines).sum(axis=1)
    distances: F64 = cam1.focal * algebraic / np.linalg.norm(lines[:, :2], axis=1)
    if not cam1.is_fisheye:
        return distances
    nearest = uv1 - (algebraic / (lines[:, :2] ** 2).sum(axis=1))[:, None] * lines[:, :2]
    distances_px = (
        cam1.focal
        * np.linalg.norm(cam1.to_image_plane(uv1) - cam1.to_image_plane(nearest), axis=1)
        * np.sign(algebraic)
    )
    return np.asarray(distances_px[np.isfinite(distances_px)])


def median_epipolar_px(cam0: Camera, cam1: Camera, T_cam1_cam0: F64, views: Sequence[BoardView]) -> float:
    """Return the median distance, px, which a few wrong corners do not change. NaN without common corners."""
    distances = np.abs(epipolar_distances(cam0, cam1, T_cam1_cam0, views))
    return float(np.median(distances)) if len(distances) else float("nan")


def _common_corners(view: BoardView) -> tuple[F64, F64]:
    """Return the pixels (N, 2) of cam0 and of cam1 of the corners that both saw."""
    one, other = view.detections
    _, rows0, rows1 = np.intersect1d(one.ids, other.ids, assume_unique=True, return_indices=True)
    return one.px[rows0], other.px[rows1]
