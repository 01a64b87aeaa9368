"""How far new features may be where neither stereo nor a depth camera tells: about as far as what is seen
near them.

What they share with their neighbours is the scale, and if the filter is unsure of that it stays as
unsure: a hundred independent guesses would fix the scale at whatever rooms are like on average."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.array_table import ArrayTable
from share.geometry.camera import rays
from share.odometry.feature_matching import anchors_in_camera
from share.odometry.state import FilterState
from share.types import F32, F64

MEAN_RHO = 0.4  # 1/m, where nothing is known
ROOM_LOG_SIGMA = 0.8  # by how much rooms differ, sigma of the logarithm
FEATURE_SPREAD = 0.5  # of an inverse depth, by which a feature may differ from the others
_MIN_NEIGHBOURS = 8  # features that tell how far the room is
_NEIGHBOUR_PX = 30.0  # that count all alike
_MIN_RHO = 0.03  # 1/m


@dataclass(frozen=True, eq=False)
class DepthPrior(ArrayTable):
    """Inverse depths (N,) 1/m. Their errors: sigma (N,) of their own; like (N, M), how those of the M
    features of the state come in, M = 0 where they do not; common (N,), one that they share among
    themselves."""

    rho: F64
    sigma: F64
    J_existing: F64
    common_sigma: F64


def prior_from_neighbours(state: FilterState, px: F32, known_px: F32) -> DepthPrior:
    """Of features at px (N, 2) of the newest keyframe's image, where the state's are at known_px (M, 2)."""
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
        rho, FEATURE_SPREAD * rho, weight * (known_rho / np.maximum(state.rho, _MIN_RHO)), np.zeros(N)
    )


def current_rho(state: FilterState) -> F64:
    """1/m (M,) of the state's features, along cam0's axis where it is now; 0.03 at least."""
    T = anchors_in_camera(state)
    z = (T[:, 2, :3] * rays(state.ray)).sum(axis=1) + state.rho * T[:, 2, 3]
    out: F64 = np.maximum(state.rho, _MIN_RHO) / np.maximum(z, 0.1)
    return np.maximum(out, _MIN_RHO)
