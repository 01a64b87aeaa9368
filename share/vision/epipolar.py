"""How far image points are, by looking along their epipolar lines in the other image of a pair."""

from __future__ import annotations

import numpy as np

from share.geometry.camera import Rig, rays
from share.types import F32, F64, U8
from share.vision.depth import disparity_px
from share.vision.patches import sample

_NEAREST_M = 0.3
_STEP_PX = 1.5  # between places on the line
_AXIS = np.arange(-4, 5, dtype=np.float32)
_OFFSETS: F32 = np.stack(np.meshgrid(_AXIS, _AXIS), axis=-1).reshape(-1, 2)
_ALIKE, _CLEAR = 0.75, 0.03  # correlation of the best place, and by how much it beats the others
_SAME = 3  # places: what is nearer to the best is the same peak


def search(image0: U8, image1: U8, rig: Rig, px: F32, uv: F64) -> F64:
    """Depth (N,) m in cam0, to a pixel of disparity, of points px (N, 2) at normalised uv (N, 2); NaN where
    no place on the line is alike, or more than one: repeated things, edges along the line."""
    assert rig.cam1 is not None and rig.T_cam1_cam0 is not None
    if len(px) == 0:
        return np.zeros(0)
    scale = rig.cam0.focal * rig.baseline
    rho = np.arange(0.0, scale / _NEAREST_M, _STEP_PX) / scale
    if rig.cam1.fisheye:  # steps of as many px at the edge, where they are more of inverse depth
        rho = rho * (scale / np.maximum(disparity_px(rig, uv, np.zeros(len(uv))), 0.02 * scale))[:, None]
    score = _scores(image0, image1, rig, px, uv, rho)
    best = score.argmax(axis=1)
    top = score[np.arange(len(px)), best]
    near = np.abs(np.arange(rho.shape[-1]) - best[:, None]) < _SAME
    clear = (top > _ALIKE) & (np.where(near, -1, score).max(axis=1) < top - _CLEAR)
    found = rho[best] if rho.ndim == 1 else rho[np.arange(len(px)), best]
    out: F64 = np.where(clear, 1 / np.maximum(found, 0.25 / scale), np.nan)
    return out


def _scores(image0: U8, image1: U8, rig: Rig, px: F32, uv: F64, rho: F64) -> F32:
    """Correlation (N, K) of each patch with that at each inverse depth (K,), or its own (N, K); -1 outside
    the image."""
    assert rig.cam1 is not None and rig.T_cam1_cam0 is not None
    R, t = rig.T_cam1_cam0[:3, :3], rig.T_cam1_cam0[:3, 3]
    q = (rays(uv) @ R.T)[:, None] + rho[..., None] * t
    at = rig.cam1.project(q.reshape(-1, 3))
    here = np.nan_to_num(at, nan=-1e3).astype(np.float32)
    there = _patches(image1, here).reshape(len(px), rho.shape[-1], -1)
    score = np.einsum("nks,ns->nk", there, _patches(image0, px))
    inside = rig.cam1.inside(here.astype(np.float64), 1.0).reshape(score.shape)
    out: F32 = np.where(inside, score, np.float32(-1))
    return out


def _patches(image: U8, px: F32) -> F32:
    """(N, S) of zero mean and unit norm."""
    gray = sample(image, px[:, :1] + _OFFSETS[:, 0], px[:, 1:] + _OFFSETS[:, 1])
    gray = gray - gray.mean(axis=1, keepdims=True)
    out: F32 = gray / np.maximum(np.linalg.norm(gray, axis=1, keepdims=True), np.float32(1e-3))
    return out
