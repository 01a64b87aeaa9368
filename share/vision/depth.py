"""Depth of image points, from a depth camera that need not be registered, or from a stereo pair.

In a pair a point is tracked into the other image from a guess (`from_stereo`), or searched for along its
whole epipolar line (`search_depth`).
"""

from __future__ import annotations

import cv2
import numpy as np

from share.geometry import se3
from share.geometry.camera import Rig, rays
from share.types import F32, F64, U8, Frame
from share.vision import optical_flow
from share.vision.patches import sample_square

EDGE_RATIO = 0.05  # relative depth step within 3 x 3 px at an object's edge
MIN_DEPTH, MAX_DEPTH = 0.2, 12.0  # m
MIN_RHO = 0.03  # 1/m; the depth of what is further away is unknown
_DEFAULT_DEPTH_M = 3.0  # initial guess


def measures_depth(frame: Frame, rig: Rig) -> bool:
    """Return whether stereo or a depth camera measures depth."""
    return (frame.depth is not None and rig.depth is not None) or (
        frame.image1 is not None and rig.cam1 is not None
    )


def measure_depth(frame: Frame, rig: Rig, px: F32, uv: F64) -> F64:
    """Return the depth (N,) m in cam0 of image points, from stereo or a depth camera; NaN where
    unknown."""
    if frame.depth is not None and rig.depth is not None:
        return from_depth_camera(frame.depth, rig, uv)
    if frame.image1 is not None and rig.cam1 is not None:
        return from_stereo(frame.image0, frame.image1, rig, px, uv)
    return np.full(len(px), np.nan)


def from_depth_camera(depth: F32, rig: Rig, uv: F64) -> F64:
    """Return the depth (N,) m along cam0's axis of normalised points uv (N, 2); NaN where there is none.

    Which pixel of the depth camera shows a point depends on its depth, because the camera is elsewhere:
    iterate from a guess. A fixed point is right if it projects back onto the point in cam0; several guesses
    also find it behind a near edge.
    """
    assert rig.depth is not None and rig.T_depth_cam0 is not None
    if len(uv) == 0:
        return np.zeros(0)
    T_cam0_depth = se3.inverse(rig.T_depth_cam0)
    without_edges = _without_edges(depth)
    ray = rays(uv)
    out = np.full(len(uv), np.nan)
    for guess in (2.0, 1.0, 4.0):
        z = np.where(np.isnan(out), guess, out)
        for _ in range(4):
            px = rig.depth.project(se3.transform(rig.T_depth_cam0, ray * z[:, None]))
            depth_at_px = _sample(without_edges, px)
            points = _back_project(rig, px, depth_at_px)
            points = se3.transform(T_cam0_depth, points)
            z = np.where(np.isnan(points[:, 2]), z, points[:, 2])
        error_px = np.abs(points[:, :2] / points[:, 2:] - uv).max(axis=1) * rig.cam0.focal
        out = np.where(np.isnan(out) & (error_px < 1.0), points[:, 2], out)
        if rig.T_depth_cam0[0, 3] == 0 and not np.isnan(out).any():
            break
    return out


def _without_edges(depth: F32) -> F32:
    """Return the depth with NaN at holes and edges of objects: an interpolated edge is a point in mid-air."""
    filled = np.where((depth > MIN_DEPTH) & (depth < MAX_DEPTH), depth, np.float32(0))
    low = cv2.erode(filled, np.ones((3, 3), np.uint8))  # 0 beside a hole
    high = cv2.dilate(filled, np.ones((3, 3), np.uint8))
    out: F32 = np.where((low > 0) & (high - low < EDGE_RATIO * high), filled, np.float32("nan"))
    return out


def _sample(depth: F32, px: F64) -> F64:
    """Return the bilinear depth at (N, 2) px, NaN outside or beside a NaN."""
    xy = np.nan_to_num(px, nan=-10.0).astype(np.float32).reshape(-1, 1, 2)
    x, y = np.ascontiguousarray(xy[..., 0]), np.ascontiguousarray(xy[..., 1])
    sampled = cv2.remap(
        depth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan")
    )
    return np.asarray(sampled, np.float64).reshape(-1)


def _back_project(rig: Rig, px: F64, z: F64) -> F64:
    assert rig.depth is not None
    uv = rig.depth.normalise(px)
    return rays(uv) * z[:, None]


def from_stereo(image0: U8, image1: U8, rig: Rig, px: F32, uv: F64, guess_m: F64 | None = None) -> F64:
    """Return the depth (N,) m in cam0 of points px (N, 2) by tracking them into cam1; NaN where that fails.

    guess_m (N,): expected depths, NaN unknown. A match must lie on its epipolar line (1.5 px), in front of
    both cameras, with an NCC of 0.8.
    """
    assert rig.cam1 is not None and rig.T_cam1_cam0 is not None
    out = np.full(len(px), np.nan)
    if len(px) == 0:
        return out
    ray = rays(uv)
    expected = np.full(len(px), np.nan) if guess_m is None else guess_m
    for fallback in (_DEFAULT_DEPTH_M, 1.2):  # the second where no depth was expected
        todo = np.flatnonzero(np.isnan(out) & (np.isnan(expected) | (fallback == _DEFAULT_DEPTH_M)))
        if len(todo) == 0:
            break
        z = np.where(np.isnan(expected[todo]), fallback, expected[todo])
        guess = rig.cam1.project(se3.transform(rig.T_cam1_cam0, ray[todo] * z[:, None]))
        start = np.where(np.isnan(guess), px[todo], guess).astype(np.float32)
        levels = 1 if guess_m is not None and fallback == _DEFAULT_DEPTH_M else 2
        right, found = optical_flow.track_points(
            image0, image1, px[todo], start, window=15, levels=levels, back_check_px=None
        )
        depth, error_px = _triangulate(rig, ray[todo], rig.cam1.normalise(right.astype(np.float64)))
        found &= (error_px < 1.5) & (depth > MIN_DEPTH) & (depth < MAX_DEPTH * 2)
        found &= optical_flow.ncc(image0, image1, px[todo], right) > 0.8
        out[todo[found]] = depth[found]
    return out


def _triangulate(rig: Rig, rays0: F64, uv1: F64) -> tuple[F64, F64]:
    """Return the depth in cam0 that best explains uv1, and the distance from the epipolar line in px, NaN
    where cam1 cannot see it.

    With p1 = z R r0 + t, uv1 p1_z = p1_xy is two equations linear in z; this is their least-squares solution.
    """
    assert rig.T_cam1_cam0 is not None and rig.cam1 is not None
    a, t = rays0 @ rig.T_cam1_cam0[:3, :3].T, rig.T_cam1_cam0[:3, 3]
    A = a[:, :2] - uv1 * a[:, 2:]
    b = uv1 * t[2] - t[:2]
    z = (A * b).sum(axis=1) / np.maximum((A * A).sum(axis=1), 1e-12)
    p1 = z[:, None] * a + t
    depth1 = np.where(p1[:, 2:] > 0, p1[:, 2:], np.nan)
    error_uv = rig.cam1.to_image_plane(p1[:, :2] / depth1) - rig.cam1.to_image_plane(uv1)
    error: F64 = np.linalg.norm(error_uv, axis=1) * rig.cam1.focal
    return z, error


def disparity_per_rho(rig: Rig, uv: F64, rho: F64) -> F64:
    """Return the derivative (N,) px of the position in cam1 by inverse depth, of points on rays uv (N, 2) at
    inverse depths (N,).

    Of a fisheye lens it falls off the axis; of other lenses the value on the axis is used for all.
    """
    assert rig.cam1 is not None and rig.T_cam1_cam0 is not None
    if not rig.cam1.is_fisheye:
        return np.full(len(uv), rig.cam1.focal * rig.baseline)
    R, t = rig.T_cam1_cam0[:3, :3], rig.T_cam1_cam0[:3, 3]
    q = rays(uv) @ R.T + np.nan_to_num(rho)[:, None] * t
    J_rho = (t[:2] - q[:, :2] / q[:, 2:] * t[2]) / q[:, 2:]
    J = rig.cam1.jacobian(q[:, :2] / q[:, 2:]) @ J_rho[:, :, None]
    out: F64 = np.linalg.norm(J[:, :, 0], axis=1)
    return out


# ---- Search along epipolar lines

_MIN_SEARCH_DEPTH_M = 0.3
_STEP_PX = 1.5  # between positions on the line
_HALF_SIZE = 4  # px; patches are 9 x 9
_MIN_CORRELATION = 0.75  # of the best position
_MIN_PEAK_MARGIN = 0.03  # of its correlation over that of any other peak
_PEAK_WIDTH = 3  # positions nearer than this belong to the same peak


def search_depth(image0: U8, image1: U8, rig: Rig, px: F32, uv: F64) -> F64:
    """Return the depth (N,) m in cam0, to a pixel of disparity, of points px (N, 2) at normalised uv (N, 2).

    NaN where no position on the line matches, or more than one does: repeated texture, edges along the line.
    """
    assert rig.cam1 is not None
    if len(px) == 0:
        return np.zeros(0)
    scale = rig.cam0.focal * rig.baseline
    rho = np.arange(0.0, scale / _MIN_SEARCH_DEPTH_M, _STEP_PX) / scale
    if rig.cam1.is_fisheye:  # a step of 1.5 px is more inverse depth off the axis
        rho = rho * (scale / np.maximum(disparity_per_rho(rig, uv, np.zeros(len(uv))), 0.02 * scale))[:, None]
    score = _correlations(image0, image1, rig, px, uv, rho)
    best = score.argmax(axis=1)
    top = score[np.arange(len(px)), best]
    is_same_peak = np.abs(np.arange(rho.shape[-1]) - best[:, None]) < _PEAK_WIDTH
    is_clear = (top > _MIN_CORRELATION) & (
        np.where(is_same_peak, -1, score).max(axis=1) < top - _MIN_PEAK_MARGIN
    )
    best_rho = rho[best] if rho.ndim == 1 else rho[np.arange(len(px)), best]
    out: F64 = np.where(is_clear, 1 / np.maximum(best_rho, 0.25 / scale), np.nan)
    return out


def _correlations(image0: U8, image1: U8, rig: Rig, px: F32, uv: F64, rho: F64) -> F32:
    """Return the correlation (N, K) of each patch at each inverse depth, (K,) or (N, K); -1 outside the
    image."""
    assert rig.cam1 is not None and rig.T_cam1_cam0 is not None
    R, t = rig.T_cam1_cam0[:3, :3], rig.T_cam1_cam0[:3, 3]
    q = (rays(uv) @ R.T)[:, None] + rho[..., None] * t
    projected = rig.cam1.project(q.reshape(-1, 3))
    px1 = np.nan_to_num(projected, nan=-1e3).astype(np.float32)
    patches1 = _unit_patches(image1, px1).reshape(len(px), rho.shape[-1], -1)
    score = np.einsum("nks,ns->nk", patches1, _unit_patches(image0, px))
    inside = rig.cam1.is_inside(px1.astype(np.float64), 1.0).reshape(score.shape)
    out: F32 = np.where(inside, score, np.float32(-1))
    return out


def _unit_patches(image: U8, px: F32) -> F32:
    """Return patches (N, S) of zero mean and unit norm."""
    gray = sample_square(image, px, _HALF_SIZE)
    gray = gray - gray.mean(axis=1, keepdims=True)
    out: F32 = gray / np.maximum(np.linalg.norm(gray, axis=1, keepdims=True), np.float32(1e-3))
    return out
