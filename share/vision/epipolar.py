"""Depth of image points by a search along their epipolar lines in the other image of a stereo pair."""

from __future__ import annotations

import numpy as np

from share.geometry.camera import Rig, rays
from share.types import F32, F64, U8
from share.vision.depth import disparity_per_rho
from share.vision.patches import sample

_MIN_DEPTH_M = 0.3
_STEP_PX = 1.5  # between positions on the line
_AXIS = np.arange(-4, 5, dtype=np.float32)
_OFFSETS: F32 = np.stack(np.meshgrid(_AXIS, _AXIS), axis=-1).reshape(-1, 2)
_MIN_CORRELATION = 0.75  # of the best position
_MIN_PEAK_MARGIN = 0.03  # of its correlation over that of any other peak
_PEAK_WIDTH = 3  # positions nearer than this belong to the same peak


def search_depth(image0: U8, image1: U8, rig: Rig, px: F32, uv: F64) -> F64:
    """Return the depth (N,) m in cam0, to a pixel of disparity, of points px (N, 2) at normalised uv (N, 2).

    NaN where no position on the line matches, or more than one does: repeated texture, edges along the line.
    """
    assert rig.cam1 is not None and rig.T_cam1_cam0 is not None
    if len(px) == 0:
        return np.zeros(0)
    scale = rig.cam0.focal * rig.baseline
    rho = np.arange(0.0, scale / _MIN_DEPTH_M, _STEP_PX) / scale
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
    patches1 = _patches(image1, px1).reshape(len(px), rho.shape[-1], -1)
    score = np.einsum("nks,ns->nk", patches1, _patches(image0, px))
    inside = rig.cam1.is_inside(px1.astype(np.float64), 1.0).reshape(score.shape)
    out: F32 = np.where(inside, score, np.float32(-1))
    return out


def _patches(image: U8, px: F32) -> F32:
    """Return patches (N, S) of zero mean and unit norm."""
    gray = sample(image, px[:, :1] + _OFFSETS[:, 0], px[:, 1:] + _OFFSETS[:, 1])
    gray = gray - gray.mean(axis=1, keepdims=True)
    out: F32 = gray / np.maximum(np.linalg.norm(gray, axis=1, keepdims=True), np.float32(1e-3))
    return out
