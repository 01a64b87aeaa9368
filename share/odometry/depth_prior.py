"""How far new features may be where neither stereo nor a depth camera tells: about as far as what is seen
near them.

What they share with their neighbours is the scale, and if the filter is unsure of that it stays as
unsure: a hundred independent guesses would fix the scale at whatever rooms are like on average."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.columns import Columns
from share.geometry.camera import rays
from share.odometry.measurement import hosts_in_camera
from share.odometry.state import State
from share.types import F32, F64

ROOM = 0.4  # 1/m, where nothing is known
ROOMS = 0.8  # by how much rooms differ, sigma of the logarithm
DIFFER = 0.5  # of an inverse depth, by which a feature may differ from the others
_FEWEST_NEIGHBOURS = 8  # features that tell how far the room is
_NEAR_PX = 30.0  # that count all alike
_LEAST = 0.03  # 1/m


@dataclass(frozen=True, eq=False)
class Guess(Columns):
    """Inverse depths (N,) 1/m. Their errors: sigma (N,) of their own; like (N, M), how those of the M
    features of the state come in, M = 0 where they do not; common (N,), one that they share among
    themselves."""

    rho: F64
    sigma: F64
    like: F64
    common: F64


def guess(state: State, px: F32, known_px: F32) -> Guess:
    """Of features at px (N, 2) of the newest keyframe's image, where the state's are at known_px (M, 2)."""
    N, M = len(px), len(state.ids)
    if M < _FEWEST_NEIGHBOURS:
        each = np.ones(N)
        return Guess(ROOM * each, DIFFER * ROOM * each, np.zeros((N, 0)), ROOMS * ROOM * each)
    here = inverse_depths(state)
    unsure = state.rho_variance / here**2
    apart = ((px[:, None] - known_px[None]) ** 2).sum(axis=2)
    weight = 1 / (apart + _NEAR_PX**2) / (unsure + DIFFER**2)
    weight /= weight.sum(axis=1, keepdims=True)
    rho = weight @ here
    return Guess(rho, DIFFER * rho, weight * (here / np.maximum(state.rho, _LEAST)), np.zeros(N))


def inverse_depths(state: State) -> F64:
    """1/m (M,) of the state's features, along cam0's axis where it is now; 0.03 at least."""
    T = hosts_in_camera(state)
    z = (T[:, 2, :3] * rays(state.ray)).sum(axis=1) + state.rho * T[:, 2, 3]
    out: F64 = np.maximum(state.rho, _LEAST) / np.maximum(z, 0.1)
    return np.maximum(out, _LEAST)
