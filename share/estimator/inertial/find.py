"""Features of the state in the images of a frame: expected where the filter says, found by their patches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.config import InertialConfig
from share.estimator.inertial import observe
from share.estimator.inertial.features import Looks, seen_twice
from share.estimator.inertial.observe import Prediction
from share.estimator.inertial.state import State
from share.geometry.camera import Camera
from share.types import F32, F64, I64, U8
from share.vision import klt, patches

_BORDER_PX = 6.0
_AGREE_PX = 1.5  # how far the way by the image before may be from what the first patch says
_TINY = 1e-12 * np.eye(2)


@dataclass(frozen=True, eq=False)
class Sought:
    """Of all N features in one image: px (N, 2) and whether each was found, and, for others to say, went its
    own way; expected (N, 2), NaN behind the camera, what it is from, and how patches look there, (N, 2, 2) px
    by px. For `patches.slanted`: error (N, S), along (N, 2)."""

    px: F32
    found: NDArray[np.bool_]
    astray: NDArray[np.bool_]
    expected: F64
    prediction: Prediction
    warp: F64
    error: F32
    along: F64

    def due(self, camera: Camera) -> int:
        """How many should be in view."""
        return int(camera.inside(np.nan_to_num(self.expected, nan=-1e6), 0.0).sum())


def seek(
    image: U8,
    camera: Camera,
    state: State,
    looks: Looks,
    config: InertialConfig,
    T_right_left: F64 | None = None,
    fresh: int = 0,
    left: Sought | None = None,
) -> Sought:
    """In cam0's image, or with T_right_left in cam1's; of features from number `fresh` on. left: of the same
    frame; only what it found is sought, as far from where it was expected as there."""
    n = len(state.ids)
    seen, where, warp, along = _expected(camera, state, looks, T_right_left)
    nowhere = np.zeros((n, len(patches.OFFSETS)), np.float32)
    px = np.nan_to_num(where, nan=-1e6).astype(np.float32)
    out = Sought(px, np.zeros(n, bool), np.zeros(n, bool), where, seen, warp, nowhere, along)
    start = where if left is None else where + (left.px - left.expected)
    inside = camera.inside(np.nan_to_num(start, nan=-1e6), _BORDER_PX) & (np.arange(n) >= fresh)
    todo = np.flatnonzero(inside if left is None else inside & left.found & ~left.astray & seen_twice(looks))
    _settle(image, looks, todo, start[todo], warp[todo], config, config.reach_px, out)
    return out


def rescue(
    before: U8, image: U8, camera: Camera, looks: Looks, sought: Sought, config: InertialConfig
) -> None:
    """Those of cam0 that were not found, followed from the image before to wherever they went."""
    inside = camera.inside(np.nan_to_num(sought.expected, nan=-1e6), _BORDER_PX)
    todo = np.flatnonzero(~sought.found & inside)
    if len(todo) == 0:
        return
    guess = sought.expected[todo].astype(np.float32)
    px, ok = klt.follow(before, image, looks.px[todo], guess, window=15, levels=2, back_check_px=1.0)
    todo = todo[ok]
    _settle(image, looks, todo, px[ok].astype(np.float64), sought.warp[todo], config, _AGREE_PX, sought)


def _expected(
    camera: Camera, state: State, looks: Looks, T_right_left: F64 | None
) -> tuple[Prediction, F64, F64, F64]:
    """What is predicted; px (N, 2), NaN behind the camera; warps (N, 2, 2) px by px; and by how many px of
    its first image a feature moves for one unit more of inverse depth (N, 2)."""
    which = np.arange(len(state.ids))
    seen = observe.predict(state, which, T_right_left)
    turned = observe.warp(state, which, looks.spread, looks.slant, T_right_left)
    along = np.linalg.solve(np.nan_to_num(turned) + _TINY, np.nan_to_num(seen.by_rho)[..., None])[..., 0]
    return seen, camera.distort(seen.uv), camera.jacobian(seen.uv) @ turned, np.asarray(along, np.float64)


def _settle(
    image: U8,
    looks: Looks,
    which: I64,
    px: F64,
    warp: F64,
    config: InertialConfig,
    reach_px: float,
    out: Sought,
) -> None:
    """Align features `which` from px (N, 2) and put into `out` what came of it."""
    if len(which) == 0:
        return
    found = patches.align(image, looks.patch.take(which), px, warp)
    strayed = np.linalg.norm(found.px - px, axis=1)
    out.px[which], out.error[which] = found.px, found.error
    good = (found.alike > config.alike) & (found.step < config.settled_px) & (strayed < reach_px)
    out.found[which] = good
