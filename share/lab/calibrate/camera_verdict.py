"""Whether a calibration may be believed, and why not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.geometry.camera import Camera, rays
from share.geometry.se3 import hat
from share.lab.calibrate import corners
from share.lab.calibrate.camera_bundle import MIN_VIEWS, BoardView, CameraBundleSolution
from share.lab.calibrate.camera_initialisation import has_enough_corners, homography, intrinsics
from share.lab.calibrate.target import Target
from share.types import F64, I64

_MAX_OUTLIER_SHARE = 0.05
_OUTLIER_MADS = 5.0  # times the spread of the views' RMS
_MAD = 1.4826


@dataclass(frozen=True)
class CameraLimits:
    """What passes. rms_px: of the corners that are kept; focal: sigma over focal length; covered: of the
    image's cells; views: at least; pair_px: from epipolar lines."""

    rms_px: float = 0.5
    epipolar_px: float = 0.3
    focal_sigma_ratio: float = 2e-3
    coverage: float = 0.6
    views: int = 12


@dataclass(frozen=True, eq=False)
class CameraVerdict:
    """reasons: what fails, none where it passes; rms_px: of each camera, of the corners kept; rms_all_px: of
    all; wrong: how many were not kept; view_rms (V, cameras) px, NaN where a camera saw nothing, and which
    of these are outlying; pair_px: that half of what both cameras saw lies from its epipolar lines, None of
    one."""

    reasons: tuple[str, ...]
    rms_px: tuple[float, ...]
    rms_all_px: tuple[float, ...]
    outlier_corners: tuple[int, ...]
    view_rms: F64
    is_outlier_view: NDArray[np.bool_]
    epipolar_px: float | None

    @property
    def outlier_views(self) -> tuple[int, ...]:
        """Rows of views that outlie in any camera."""
        return tuple(np.flatnonzero(self.is_outlier_view.any(axis=1)).tolist())

    @property
    def passed(self) -> bool:
        return not self.reasons


def judge_cameras(
    solution: CameraBundleSolution,
    coverages: Sequence[Coverage],
    stereo_views: Sequence[BoardView] = (),
    limits: CameraLimits = CameraLimits(),
) -> CameraVerdict:
    """Of a solution and what each camera's views cover. pairs: all views in which two cameras saw the board,
    also those that had no part in the solution."""
    cams = range(len(solution.state.cameras))
    view_rms = np.array([[corners.rms(view[cam]) for cam in cams] for view in solution.residuals])
    residuals_of = [camera_residuals(solution, cam) for cam in cams]
    inliers = [corners.inlier_mask(r, solution.sigma_px) for r in residuals_of]
    rms = tuple(corners.rms(r[k]) for r, k in zip(residuals_of, inliers, strict=True))
    rms_all = tuple(corners.rms(r) for r in residuals_of)
    outliers = tuple(int((~k).sum()) for k in inliers)
    unfit = [corners.count_outliers(r, solution.sigma_px, limits.rms_px) for r in residuals_of]
    reasons = [reason for cam in cams for reason in _failures(solution, cam, rms[cam], unfit[cam], limits)]
    for cam, cover in enumerate(coverages):
        if cover.share < limits.coverage:
            reasons.append(
                f"cam{cam}: corners in {cover.share:.0%} of the image, {limits.coverage:.0%} needed; "
                + "; ".join(cover.gaps)
            )
    state = solution.state
    has_two = len(cams) == 2
    epipolar_px = (
        median_epipolar_px(state.cameras[0], state.cameras[1], state.T_cam1_cam0, stereo_views)
        if has_two
        else None
    )
    if epipolar_px is not None and not epipolar_px <= limits.epipolar_px:
        reasons.append(
            f"the pair: half of the "
            f"corners are {epipolar_px:.2f} "
            f"px or more off their epipolar lines, at most "
            f"{limits.epipolar_px:g}: do both cameras expose at once, is one loose?"
        )
    return CameraVerdict(
        tuple(reasons), rms, rms_all, outliers, view_rms, _outlier_views(view_rms), epipolar_px
    )


def _failures(
    solution: CameraBundleSolution, cam: int, rms: float, unfit: int, limits: CameraLimits
) -> list[str]:
    views = sum(len(view[cam]) > 0 for view in solution.residuals)
    corners = sum(len(view[cam]) for view in solution.residuals)
    begin = solution.state.intrinsic_slices[cam].start
    part = slice(begin, begin + 2)
    focal_sigma_ratio = float((solution.sigmas[part] / intrinsics(solution.state.cameras[cam])[:2]).max())
    out = []
    if views < max(limits.views, MIN_VIEWS):
        out.append(f"cam{cam}: {views} views, {limits.views} needed")
    if not rms <= limits.rms_px:
        out.append(
            f"cam{cam}: {rms:.2f} px RMS, at most {limits.rms_px:g}: blur, a bent board or a wrong --target"
        )
    if unfit > _MAX_OUTLIER_SHARE * corners:
        out.append(
            f"cam{cam}: {unfit} of {corners} corners do not fit within {limits.rms_px:g} px, at most "
            f"{_MAX_OUTLIER_SHARE:.0%}"
        )
    if not focal_sigma_ratio <= limits.focal_sigma_ratio:
        out.append(
            f"cam{cam}: focal length known to {focal_sigma_ratio:.2%}, "
            f"{limits.focal_sigma_ratio:.2%} "
            f"needed: tilt the board more"
        )
    return out


def camera_residuals(solution: CameraBundleSolution, cam: int) -> F64:
    """(N, 2) px of a camera, over all views."""
    return np.concatenate([view[cam] for view in solution.residuals])


def _outlier_views(view_rms: F64) -> NDArray[np.bool_]:
    """Whose RMS (V, cameras) is beyond median + 5 MAD of a camera's."""
    middle = np.nanmedian(view_rms, axis=0)
    spread = _MAD * np.nanmedian(np.abs(view_rms - middle), axis=0)
    return np.asarray(view_rms > middle + _OUTLIER_MADS * spread)


# ---- What the views of a target cover, what is missing, and which of many views to take.
#
# Intrinsics are told by corners in all of the image, by boards that lean to each side (else focal length and
# distance are one), and by near and far ones.

CELL_GRID = (6, 8)  # rows and columns of cells in which corners are counted
_REGION_NAMES = (
    ("upper left corner", "upper edge", "upper right corner"),
    ("left edge", "middle", "right edge"),
    ("lower left corner", "lower edge", "lower right corner"),
)
_MIN_TILT_DEG = 15.0
_TILT_WEIGHT = 3.0  # of how a board lies, in cells
_TIME_WEIGHT = 10.0  # of its stretch of the recording: neighbours are nearly copies, and err alike


@dataclass(frozen=True, eq=False)
class Coverage:
    """Of one camera and the V views that it sees. cells: corners in each cell of `CELL_GRID`; leans (V, 2):
    the board's lean about the image's y and x, rad; distances (V,): m."""

    cells: I64
    tilts: F64
    distances: F64

    @property
    def share(self) -> float:
        """Of the cells that hold a corner."""
        return float((self.cells > 0).mean())

    @property
    def gaps(self) -> tuple[str, ...]:
        """In words, what a person should show the camera."""
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
            out.append("all views are from one distance: go nearer and farther")
        return tuple(out)


def coverage(pixels: Sequence[F64], T_cam_target: F64, target: Target, size: tuple[int, int]) -> Coverage:
    """Of the corners (N, 2) px of each view, and its pose (V, 4, 4); what it does not see does not count."""
    T_cam_target = T_cam_target[[len(px) > 0 for px in pixels]]
    middle = np.append(target.extent.mean(axis=0), 0)
    centres = T_cam_target[:, :3, :3] @ middle + T_cam_target[:, :3, 3]
    normal = -T_cam_target[:, :3, 2]  # away from who looks
    tilts = np.arctan2(normal[:, :2], normal[:, 2:])
    cells = np.bincount(cell_numbers(np.concatenate(pixels), size), minlength=CELL_GRID[0] * CELL_GRID[1])
    return Coverage(cells.reshape(CELL_GRID), tilts, np.linalg.norm(centres, axis=1))


def cell_numbers(px: F64, size: tuple[int, int]) -> I64:
    """Number of the cell (N,) of each pixel (N, 2), along rows."""
    column, row = np.clip(px / size * CELL_GRID[::-1], 0, np.array(CELL_GRID[::-1]) - 1).astype(np.int64).T
    return np.asarray(row * CELL_GRID[1] + column, np.int64)


def choose_views(
    views: Sequence[BoardView], target: Target, size: tuple[int, int], max_views: int
) -> list[int]:
    """Which views, rising, at most `max_views`: one after another the one that adds most of what is still
    rare, cells of the image, ways a board lies in it, stretches of the recording (views are in its order)."""
    view_classes = [_view_classes(view, target, size) for view in views]
    for k, classes in enumerate(view_classes):
        if classes:
            classes["stretch", k * max_views // len(views)] = _TIME_WEIGHT
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
    """What a view has to say, with weights: cells, and classes of lean and size by its homography."""
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
        out[cam, "lean", *tilt.tolist()] = _TILT_WEIGHT
        out[cam, "size", round(np.log2(abs(np.linalg.det(H[:2, :2]))))] = _TILT_WEIGHT
    return out


# ---- How well two cameras agree on where a corner can be, whatever the board is like.
#
# A corner of cam0 leaves a line on which cam1 must see it (Hartley and Zisserman, Multiple View Geometry,
# 9.2). By how much it misses that line says nothing of the board's shape or pose, so pictures that had no
# part in the calibration are a check of it, too. It is what stereo matching suffers from: rows that are off.


def epipolar_distances(cam0: Camera, cam1: Camera, T_cam1_cam0: F64, views: Sequence[BoardView]) -> F64:
    """(N,) px of cam1 without its distortion, signed: each corner that both saw, from the line on which
    cam0's puts it. Of fisheye lenses px of the image, of those corners that have normalised coordinates."""
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
    """px that half of the corners stay within: a few that were found wrongly change nothing. NaN of none."""
    distances = np.abs(epipolar_distances(cam0, cam1, T_cam1_cam0, views))
    return float(np.median(distances)) if len(distances) else float("nan")


def _common_corners(view: BoardView) -> tuple[F64, F64]:
    """Where cam0 and cam1 saw the same corners, (N, 2) px each."""
    one, other = view.detections
    _, rows0, rows1 = np.intersect1d(one.ids, other.ids, assume_unique=True, return_indices=True)
    return one.px[rows0], other.px[rows1]
