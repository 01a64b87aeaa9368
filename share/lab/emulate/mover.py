"""Paths of a large panel that moves while a camera looks at it, in the world frame, upright."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from share.geometry import se3
from share.geometry.camera import Camera
from share.lab.emulate.moving_panel import Panel, share_of_view
from share.types import F64

_ENTER_S = 1.5
_SWAY_S = 4.0  # period
_DISTANCE_M, _START_ASIDE_M, _SWAY_M = 1.0, 1.7, 0.3
_TARGET_VIEW_SHARE, _MAX_VIEW_SHARE = 0.4, 0.6  # share of the view that the panel should have, and its limit
_MIN_CLEARANCE_M = 0.4  # least distance from the camera
_BEFORE_S, _AFTER_S = 3.0, 6.0  # the panel should be visible that long before and after it starts to move


def path_comes(t: F64, T_world_cam: F64, begin: float, last: float) -> F64:
    """Return T_world_panel (N, 4, 4) of a panel that comes in from the left at `begin` (s) and for `last`
    seconds sways about 1 m before the camera, on a smooth path of its own through the world; NaN while
    absent."""
    ahead = _smoothed(t, _horizontal(T_world_cam[:, :3, 2]), 0.7)
    centre = _smoothed(t, T_world_cam[:, :3, 3], 0.7)
    aside = _enter_offset(t, begin, last) + _SWAY_M * np.sin(2 * np.pi * (t - begin) / _SWAY_S)
    T = _upright_poses(centre, _horizontal(ahead), _DISTANCE_M, aside)
    T[(t < begin) | (t > begin + last)] = np.nan
    return T


def path_follows(t: F64, T_world_cam: F64, begin: float, last: float) -> F64:
    """Return T_world_panel (N, 4, 4) of a panel that moves with the camera: fixed at the left of its view, 1
    m away."""
    aside = _enter_offset(t, begin, last) - 0.35
    R, zero = np.tile(np.eye(3), (len(t), 1, 1)), np.zeros(len(t))
    T = T_world_cam @ se3.from_rt(R, np.stack([aside, zero, zero + _DISTANCE_M], axis=1))
    T[(t < begin) | (t > begin + last)] = np.nan
    return np.asarray(T, np.float64)


def path_starts(
    t: F64, T_world_cam: F64, camera: Camera, panel: Panel, last: float, speed: float = 0.15
) -> F64:
    """Return T_world_panel (N, 4, 4) of a panel that rests in the room, starts to move aside at `speed` (m/s)
    after 30 to 55 % of the recording for `last` seconds, and rests again. Place and time are those where it
    fills about 40 % of the view. Raises ValueError where the camera comes too near everywhere."""
    best, best_path = -np.inf, None
    for begin, T in _candidate_placements(t, T_world_cam):
        moved = speed * (t - begin).clip(0, last)
        path = np.tile(T, (len(t), 1, 1))
        path[:, :3, 3] += moved[:, None] * T[:3, 0]
        if _clearance(panel, se3.inverse(path) @ T_world_cam) < _MIN_CLEARANCE_M:
            continue
        near = np.flatnonzero((t > begin - _BEFORE_S) & (t < begin + _AFTER_S))[::8]
        view_share = share_of_view(camera, panel, se3.inverse(T_world_cam[near]) @ path[near])
        if (
            score := float(
                (view_share.clip(0, _TARGET_VIEW_SHARE) - 2 * (view_share - _MAX_VIEW_SHARE).clip(0)).mean()
            )
        ) > best:
            best, best_path = score, path
    if best_path is None:
        raise ValueError("no place for a panel that the camera does not run into")
    return best_path


def _candidate_placements(t: F64, T_world_cam: F64) -> Iterator[tuple[float, F64]]:
    """Yield (time at which it starts, T_world_panel at rest): before the camera about then."""
    span = t[-1] - t[0]
    for begin in np.arange(t[0] + 0.3 * span, t[0] + 0.55 * span, 0.5):
        for k in np.searchsorted(t, begin + np.array([-1.5, 0.0, 1.5, 3.0])).clip(0, len(t) - 1):
            ahead, eye = _horizontal(T_world_cam[k : k + 1, :3, 2]), T_world_cam[k : k + 1, :3, 3]
            for metres in (1.0, 1.4, 1.8):
                yield float(begin), _upright_poses(eye, ahead, metres, np.zeros(1))[0]


def _clearance(panel: Panel, T_panel_cam: F64) -> float:
    """Return the least distance from cameras to the panel, m."""
    p = T_panel_cam[:, :3, 3]
    beyond = np.maximum(np.abs(p) - (panel.width / 2, panel.height / 2, 0.0), 0)
    return float(np.linalg.norm(beyond, axis=1).min())


def _enter_offset(t: F64, begin: float, last: float) -> F64:
    """Return the offset to the right, m: in from the left, and out again."""
    inside = np.minimum(t - begin, begin + last - t) / _ENTER_S
    out: F64 = -_START_ASIDE_M * (1 - inside.clip(0, 1))
    return out


def _upright_poses(centre: F64, ahead: F64, metres: float, aside: F64) -> F64:
    """Return T (N, 4, 4), upright, `metres` ahead of `centre` (N, 3) and `aside` to the right, its back to
    `ahead`."""
    down = np.tile([0.0, 0.0, -1.0], (len(ahead), 1))
    right = np.cross(down, ahead)
    R = np.stack([right, down, ahead], axis=-1)
    return se3.from_rt(R, centre + metres * ahead + aside[:, None] * right)


def _horizontal(directions: F64) -> F64:
    """Return unit vectors (N, 3) without their vertical part."""
    flat = directions * (1.0, 1.0, 0.0)
    out: F64 = flat / np.linalg.norm(flat, axis=1, keepdims=True).clip(1e-6)
    return out


def _smoothed(t: F64, values: F64, sigma: float) -> F64:
    """Return (N, 3) smoothed over time by a Gaussian of `sigma` s."""
    weights = np.exp(-0.5 * ((t[:, None] - t[None, :]) / sigma) ** 2)
    out: F64 = weights @ values / weights.sum(axis=1, keepdims=True)
    return out
