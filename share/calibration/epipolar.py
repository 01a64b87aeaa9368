"""How well two cameras agree on where a corner can be, whatever the board is like.

A corner of cam0 leaves a line on which cam1 must see it (Hartley and Zisserman, Multiple View Geometry, 9.2).
By how much it misses that line says nothing of the board's shape or pose, so pictures that had no part in the
calibration are a check of it, too. It is what stereo matching suffers from: rows that are off.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from share.calibration.bundle import View
from share.geometry.camera import Camera, rays
from share.geometry.se3 import hat
from share.types import F64


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
