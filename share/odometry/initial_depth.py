"""Initial inverse depth of new features: measured by stereo or a depth camera, else about that of features
near them.

Without a measurement, new features share the scale error of their neighbours. Treated as independent guesses,
a hundred of them would fix the scale at that of an average room.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.array_table import ArrayTable
from share.geometry.camera import Rig, rays
from share.odometry.feature_matching import anchors_in_camera
from share.odometry.state import FilterState
from share.types import F32, F64, U8, Frame
from share.vision.depth import (
    MIN_RHO,
    disparity_per_rho,
    from_depth_camera,
    from_stereo,
    measures_depth,
    search_depth,
)

MEAN_RHO = 0.4  # 1/m, where nothing is known
ROOM_LOG_SIGMA = 0.8  # sigma of the logarithm of a room's inverse depth
FEATURE_SPREAD = 0.5  # sigma of a feature's inverse depth, relative to the room's
_MIN_NEIGHBOURS = 8  # features in the state; with fewer the prior is that of an unknown room
_NEIGHBOUR_PX = 30.0  # features nearer than this weigh about the same
_STEREO_PX = 0.25  # noise of a disparity
_DEPTH_SIGMA_PX, _DEPTH_BASELINE_M = 0.3, 0.05  # px, m: of the stereo pair inside a depth camera
_MAX_DISPARITY_ERROR_PX = 2.0  # between the epipolar search and its refinement
_MIN_MEASURED_SHARE = 0.1  # of the new features; with less the second camera is covered, blinded or stuck


@dataclass(frozen=True, eq=False)
class DepthPrior(ArrayTable):
    """Inverse depths rho (N,) 1/m and their errors.

    sigma (N,): independent error of each. J_existing (N, M): derivative by the inverse depths of the M
    features of the state, M = 0 where there is no dependence. common_sigma (N,): an error that all N share.
    """

    rho: F64
    sigma: F64
    J_existing: F64
    common_sigma: F64


def initial_depths(
    frame: Frame, rig: Rig, state: FilterState, px: F32, ray: F64, known_px: F32
) -> DepthPrior:
    """Return the inverse depths of new features at px (N, 2) of the frame, on rays (N, 2): measured, or else
    by the state's features at known_px (M, 2). NaN where a measurement fails, unless nearly all do."""
    if not measures_depth(frame, rig):
        return prior_from_neighbours(state, px, known_px)
    measured = _measured_depths(frame, rig, px, ray)
    has_enough = min(len(px), len(state.feature_ids)) >= _MIN_NEIGHBOURS
    if has_enough and np.isfinite(measured.rho).mean() < _MIN_MEASURED_SHARE:
        return prior_from_neighbours(state, px, known_px)
    return measured


def _measured_depths(frame: Frame, rig: Rig, px: F32, ray: F64) -> DepthPrior:
    """Return the inverse depths by stereo or a depth camera; NaN where that fails."""
    focal, n = rig.cam0.focal, len(px)
    if frame.image1 is not None and rig.cam1 is not None:
        z = _stereo_depth(frame.image0, frame.image1, rig, px, ray)
        sigma = np.full(n, _STEREO_PX / focal / rig.baseline)
        if rig.cam1.is_fisheye:
            sigma = _STEREO_PX / disparity_per_rho(rig, ray, 1 / z)
    else:
        assert frame.depth is not None
        z = from_depth_camera(frame.depth, rig, ray)
        sigma = np.full(n, _DEPTH_SIGMA_PX / focal / _DEPTH_BASELINE_M)
    return DepthPrior(1 / z, sigma, np.zeros((n, 0)), np.zeros(n))


def _stereo_depth(image0: U8, image1: U8, rig: Rig, px: F32, ray: F64) -> F64:
    """Return the depth (N,) m by epipolar search and subpixel refinement; NaN where it is ambiguous or they
    disagree."""
    coarse = search_depth(image0, image1, rig, px, ray)
    out, found = np.full(len(px), np.nan), np.flatnonzero(~np.isnan(coarse))
    z = from_stereo(image0, image1, rig, px[found], ray[found], coarse[found])
    px_per_rho: F64 | float = rig.cam0.focal * rig.baseline
    if rig.cam0.is_fisheye:
        px_per_rho = disparity_per_rho(rig, ray[found], 1 / coarse[found])
    error_px = np.abs(1 / z - 1 / coarse[found]) * px_per_rho
    out[found] = np.where(error_px < _MAX_DISPARITY_ERROR_PX, z, np.nan)
    return out


def prior_from_neighbours(state: FilterState, px: F32, known_px: F32) -> DepthPrior:
    """Return the prior of features at px (N, 2) in the newest keyframe's image, where the state's features
    are at known_px (M, 2)."""
    N, M = len(px), len(state.feature_ids)
    if M < _MIN_NEIGHBOURS:
        ones = np.ones(N)
        return DepthPrior(
            MEAN_RHO * ones,
            FEATURE_SPREAD * MEAN_RHO * ones,
            np.zeros((N, 0)),
            ROOM_LOG_SIGMA * MEAN_RHO * ones,
        )
    known_rho = current_rho(state)
    relative_variance = state.rho_variance / known_rho**2
    squared_px = ((px[:, None] - known_px[None]) ** 2).sum(axis=2)
    weight = 1 / (squared_px + _NEIGHBOUR_PX**2) / (relative_variance + FEATURE_SPREAD**2)
    weight /= weight.sum(axis=1, keepdims=True)
    rho = weight @ known_rho
    return DepthPrior(
        rho, FEATURE_SPREAD * rho, weight * (known_rho / np.maximum(state.rho, MIN_RHO)), np.zeros(N)
    )


def current_rho(state: FilterState) -> F64:
    """Return the inverse depths (M,) 1/m of the state's features along cam0's axis in its present pose; at
    least 0.03."""
    T = anchors_in_camera(state)
    z = (T[:, 2, :3] * rays(state.ray)).sum(axis=1) + state.rho * T[:, 2, 3]
    out: F64 = np.maximum(state.rho, MIN_RHO) / np.maximum(z, 0.1)
    return np.maximum(out, MIN_RHO)
