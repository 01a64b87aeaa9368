"""Whether a calibration may be believed, and why not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.geometry.camera import Camera, rays
from share.geometry.se3 import hat
from share.lab.calibrate import corners
from share.lab.calibrate.camera_bundle import LEAST_VIEWS, Solution, View
from share.lab.calibrate.camera_start import enough, homography, intrinsics
from share.lab.calibrate.target import Target
from share.types import F64, I64

_WRONG_SHARE = 0.05
_OUTLYING = 5.0  # times the spread of the views' RMS
_MAD = 1.4826


@dataclass(frozen=True)
class Limits:
    """What passes. rms_px: of the corners that are kept; focal: sigma over focal length; covered: of the
    image's cells; views: at least; pair_px: from epipolar lines."""

    rms_px: float = 0.5
    pair_px: float = 0.3
    focal: float = 2e-3
    covered: float = 0.6
    views: int = 12


@dataclass(frozen=True, eq=False)
class Verdict:
    """reasons: what fails, none where it passes; rms_px: of each camera, of the corners kept; rms_all_px: of
    all; wrong: how many were not kept; view_rms (V, cameras) px, NaN where a camera saw nothing, and which
    of these are outlying; pair_px: that half of what both cameras saw lies from its epipolar lines, None of
    one."""

    reasons: tuple[str, ...]
    rms_px: tuple[float, ...]
    rms_all_px: tuple[float, ...]
    wrong: tuple[int, ...]
    view_rms: F64
    outlying: NDArray[np.bool_]
    pair_px: float | None

    @property
    def outliers(self) -> tuple[int, ...]:
        """Rows of views that outlie in any camera."""
        return tuple(np.flatnonzero(self.outlying.any(axis=1)).tolist())

    @property
    def passed(self) -> bool:
        return not self.reasons


def judge(
    solution: Solution,
    covers: Sequence[Coverage],
    pairs: Sequence[View] = (),
    limits: Limits = Limits(),
) -> Verdict:
    """Of a solution and what each camera's views cover. pairs: all views in which two cameras saw the board,
    also those that had no part in the solution."""
    eyes = range(len(solution.state.cameras))
    view_rms = np.array([[corners.rms(view[eye]) for eye in eyes] for view in solution.residuals])
    told = [residuals(solution, eye) for eye in eyes]
    inside = [corners.kept(r, solution.sigma_px) for r in told]
    rms = tuple(corners.rms(r[k]) for r, k in zip(told, inside, strict=True))
    rms_all = tuple(corners.rms(r) for r in told)
    wrong = tuple(int((~k).sum()) for k in inside)
    lost = [corners.lost(r, solution.sigma_px, limits.rms_px) for r in told]
    reasons = [reason for eye in eyes for reason in _reasons(solution, eye, rms[eye], lost[eye], limits)]
    for eye, cover in enumerate(covers):
        if cover.share < limits.covered:
            reasons.append(
                f"cam{eye}: corners in {cover.share:.0%} of the image, {limits.covered:.0%} needed; "
                + "; ".join(cover.missing)
            )
    state = solution.state
    two = len(eyes) == 2
    pair = typical_miss(state.cameras[0], state.cameras[1], state.T_cam1_cam0, pairs) if two else None
    if pair is not None and not pair <= limits.pair_px:
        reasons.append(
            f"the pair: half of the corners are {pair:.2f} px or more off their epipolar lines, at most "
            f"{limits.pair_px:g}: do both cameras expose at once, is one loose?"
        )
    return Verdict(tuple(reasons), rms, rms_all, wrong, view_rms, _outlying(view_rms), pair)


def _reasons(solution: Solution, eye: int, rms: float, lost: int, limits: Limits) -> list[str]:
    views = sum(len(view[eye]) > 0 for view in solution.residuals)
    corners = sum(len(view[eye]) for view in solution.residuals)
    begin = solution.state.parts[eye].start
    part = slice(begin, begin + 2)
    loose = float((solution.sigmas[part] / intrinsics(solution.state.cameras[eye])[:2]).max())
    out = []
    if views < max(limits.views, LEAST_VIEWS):
        out.append(f"cam{eye}: {views} views, {limits.views} needed")
    if not rms <= limits.rms_px:
        out.append(
            f"cam{eye}: {rms:.2f} px RMS, at most {limits.rms_px:g}: blur, a bent board or a wrong --target"
        )
    if lost > _WRONG_SHARE * corners:
        out.append(
            f"cam{eye}: {lost} of {corners} corners do not fit within {limits.rms_px:g} px, at most "
            f"{_WRONG_SHARE:.0%}"
        )
    if not loose <= limits.focal:
        out.append(
            f"cam{eye}: focal length known to {loose:.2%}, {limits.focal:.2%} needed: tilt the board more"
        )
    return out


def residuals(solution: Solution, eye: int) -> F64:
    """(N, 2) px of a camera, over all views."""
    return np.concatenate([view[eye] for view in solution.residuals])


def _outlying(view_rms: F64) -> NDArray[np.bool_]:
    """Whose RMS (V, cameras) is beyond median + 5 MAD of a camera's."""
    middle = np.nanmedian(view_rms, axis=0)
    spread = _MAD * np.nanmedian(np.abs(view_rms - middle), axis=0)
    return np.asarray(view_rms > middle + _OUTLYING * spread)


# ---- What the views of a target cover, what is missing, and which of many views to take.
#
# Intrinsics are told by corners in all of the image, by boards that lean to each side (else focal length and
# distance are one), and by near and far ones.

GRID = (6, 8)  # rows and columns of cells in which corners are counted
_NAMES = (
    ("upper left corner", "upper edge", "upper right corner"),
    ("left edge", "middle", "right edge"),
    ("lower left corner", "lower edge", "lower right corner"),
)
_LEANT_DEG = 15.0
_SHAPE_WEIGHT = 3.0  # of how a board lies, in cells
_STRETCH_WEIGHT = 10.0  # of its stretch of the recording: neighbours are nearly copies, and err alike


@dataclass(frozen=True, eq=False)
class Coverage:
    """Of one camera and the V views that it sees. cells: corners in each cell of `GRID`; leans (V, 2): the
    board's lean about the image's y and x, rad; distances (V,): m."""

    cells: I64
    leans: F64
    distances: F64

    @property
    def share(self) -> float:
        """Of the cells that hold a corner."""
        return float((self.cells > 0).mean())

    @property
    def missing(self) -> tuple[str, ...]:
        """In words, what a person should show the camera."""
        regions = self.cells.reshape(3, 2, 8)
        columns = (slice(0, 2), slice(2, 6), slice(6, 8))
        empty = [
            _NAMES[row][k] for row in range(3) for k in range(3) if not regions[row][:, columns[k]].any()
        ]
        out = [f"no view reaches the image's {name}" for name in empty]
        limit = np.radians(_LEANT_DEG)
        for axis, (low, high) in enumerate((("left", "right"), ("top", "bottom"))):
            for name, leant in ((low, self.leans[:, axis] < -limit), (high, self.leans[:, axis] > limit)):
                if not leant.any():
                    out.append(f"no view with the board's {name} side {_LEANT_DEG:.0f} degrees nearer")
        if self.distances.max() < 1.3 * self.distances.min():
            out.append("all views are from one distance: go nearer and farther")
        return tuple(out)


def coverage(pixels: Sequence[F64], T_cam_target: F64, target: Target, size: tuple[int, int]) -> Coverage:
    """Of the corners (N, 2) px of each view, and its pose (V, 4, 4); what it does not see does not count."""
    T_cam_target = T_cam_target[[len(px) > 0 for px in pixels]]
    middle = np.append(target.extent.mean(axis=0), 0)
    at = T_cam_target[:, :3, :3] @ middle + T_cam_target[:, :3, 3]
    normal = -T_cam_target[:, :3, 2]  # away from who looks
    leans = np.arctan2(normal[:, :2], normal[:, 2:])
    cells = np.bincount(cells_of(np.concatenate(pixels), size), minlength=GRID[0] * GRID[1])
    return Coverage(cells.reshape(GRID), leans, np.linalg.norm(at, axis=1))


def cells_of(px: F64, size: tuple[int, int]) -> I64:
    """Number of the cell (N,) of each pixel (N, 2), along rows."""
    column, row = np.clip(px / size * GRID[::-1], 0, np.array(GRID[::-1]) - 1).astype(np.int64).T
    return np.asarray(row * GRID[1] + column, np.int64)


def choose(views: Sequence[View], target: Target, size: tuple[int, int], most: int) -> list[int]:
    """Which views, rising, at most `most`: one after another the one that adds most of what is still rare,
    cells of the image, ways a board lies in it, stretches of the recording (views are in its order)."""
    told = [_told(view, target, size) for view in views]
    for k, what in enumerate(told):
        if what:
            what["stretch", k * most // len(views)] = _STRETCH_WEIGHT
    met: dict[object, int] = {}
    chosen: list[int] = []
    left = [k for k, what in enumerate(told) if what]
    while left and len(chosen) < most:
        gains = [sum(weight / (1 + met.get(key, 0)) ** 2 for key, weight in told[k].items()) for k in left]
        best = left.pop(int(np.argmax(gains)))
        chosen.append(best)
        for key in told[best]:
            met[key] = met.get(key, 0) + 1
    return sorted(chosen)


def _told(view: View, target: Target, size: tuple[int, int]) -> dict[object, float]:
    """What a view has to say, with weights: cells, and classes of lean and size by its homography."""
    out: dict[object, float] = {}
    for eye, seen in enumerate(view.seen):
        board = target.corners[seen.ids, :2]
        if not enough(board):
            continue
        for cell in np.unique(cells_of(seen.px, size)).tolist():
            out[eye, "cell", cell] = 1.0
        H = homography(board, (seen.px - np.array(size) / 2) / max(size))
        H = H / H[2, 2]
        leant = np.clip(np.round(H[2, :2] / 0.25), -2, 2).astype(int)
        out[eye, "lean", *leant.tolist()] = _SHAPE_WEIGHT
        out[eye, "size", round(np.log2(abs(np.linalg.det(H[:2, :2]))))] = _SHAPE_WEIGHT
    return out


# ---- How well two cameras agree on where a corner can be, whatever the board is like.
#
# A corner of cam0 leaves a line on which cam1 must see it (Hartley and Zisserman, Multiple View Geometry,
# 9.2). By how much it misses that line says nothing of the board's shape or pose, so pictures that had no
# part in the calibration are a check of it, too. It is what stereo matching suffers from: rows that are off.


def off_line(cam0: Camera, cam1: Camera, T_cam1_cam0: F64, views: Sequence[View]) -> F64:
    """(N,) px of cam1 without its distortion, signed: each corner that both saw, from the line on which
    cam0's puts it. Of fisheye lenses px of the image, of those corners that have normalised coordinates."""
    pairs = [_both(view) for view in views]
    px0, px1 = (np.concatenate([pair[eye] for pair in pairs] or [np.empty((0, 2))]) for eye in (0, 1))
    lines = rays(cam0.normalise(px0)) @ (hat(T_cam1_cam0[:3, 3]) @ T_cam1_cam0[:3, :3]).T
    uv1 = cam1.normalise(px1)
    apart = (rays(uv1) * lines).sum(axis=1)
    off: F64 = cam1.focal * apart / np.linalg.norm(lines[:, :2], axis=1)
    if not cam1.fisheye:
        return off
    nearest = uv1 - (apart / (lines[:, :2] ** 2).sum(axis=1))[:, None] * lines[:, :2]
    miss = cam1.focal * np.linalg.norm(cam1.evened(uv1) - cam1.evened(nearest), axis=1) * np.sign(apart)
    return np.asarray(miss[np.isfinite(miss)])


def typical_miss(cam0: Camera, cam1: Camera, T_cam1_cam0: F64, views: Sequence[View]) -> float:
    """px that half of the corners stay within: a few that were found wrongly change nothing. NaN of none."""
    miss = np.abs(off_line(cam0, cam1, T_cam1_cam0, views))
    return float(np.median(miss)) if len(miss) else float("nan")


def _both(view: View) -> tuple[F64, F64]:
    """Where cam0 and cam1 saw the same corners, (N, 2) px each."""
    one, other = view.seen
    _, mine, theirs = np.intersect1d(one.ids, other.ids, assume_unique=True, return_indices=True)
    return one.px[mine], other.px[theirs]
