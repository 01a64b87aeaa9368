"""Features of the state in the images of a frame: expected where the filter says, found by their patches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.config import InertialConfig
from share.estimator.inertial import observe
from share.estimator.inertial.features import Looks
from share.estimator.inertial.state import State
from share.geometry.camera import Camera
from share.types import F32, F64, I64, U8
from share.vision import klt, patches

_BORDER_PX = 6.0


@dataclass(frozen=True, eq=False)
class Sought:
    """Of all N features in one image: px (N, 2) and whether each was found; expected (N, 2), NaN behind the
    camera."""

    px: F32
    found: NDArray[np.bool_]
    expected: F64


def seek(
    image: U8,
    camera: Camera,
    state: State,
    looks: Looks,
    config: InertialConfig,
    T_right_left: F64 | None = None,
    fresh: int = 0,
) -> Sought:
    """In cam0's image, or with T_right_left in cam1's; of features from number `fresh` on."""
    which = np.arange(len(state.ids))
    expected, warp = _expected(camera, state, which, looks, T_right_left)
    out = np.nan_to_num(expected, nan=-1e6).astype(np.float32)
    found = np.zeros(len(which), bool)
    inside = np.flatnonzero(camera.inside(np.nan_to_num(expected, nan=-1e6), _BORDER_PX) & (which >= fresh))
    if len(inside):
        out[inside], found[inside] = _settle(
            image, looks, inside, expected[inside], warp[inside], config, config.reach_px
        )
    return Sought(out, found, expected)


def rescue(
    before: U8, image: U8, camera: Camera, state: State, looks: Looks, sought: Sought, config: InertialConfig
) -> Sought:
    """Those of cam0 that were not found, followed from the image before to wherever they went."""
    inside = camera.inside(np.nan_to_num(sought.expected, nan=-1e6), _BORDER_PX)
    todo = np.flatnonzero(~sought.found & inside & (looks.age > 0))
    if len(todo) == 0:
        return sought
    guess = sought.expected[todo].astype(np.float32)
    px, ok = klt.follow(before, image, looks.px[todo], guess, window=15, levels=2, back_check_px=1.0)
    todo, px = todo[ok], px[ok]
    _, warp = _expected(camera, state, todo, looks, None)
    out, found = sought.px.copy(), sought.found.copy()
    out[todo], found[todo] = _settle(image, looks, todo, px.astype(np.float64), warp, config, 1.5)
    return Sought(out, found, sought.expected)


def _expected(
    camera: Camera, state: State, which: I64, looks: Looks, T_right_left: F64 | None
) -> tuple[F64, F64]:
    """px (N, 2), NaN behind the camera, and warps (N, 2, 2) px by px."""
    uv = observe.predict(state, which, T_right_left).uv
    slant = np.zeros((len(which), 2))
    turned = observe.warp(state, which, looks.spread[which], slant, T_right_left)
    return camera.distort(uv), camera.jacobian(uv) @ turned


def _settle(
    image: U8, looks: Looks, which: I64, px: F64, warp: F64, config: InertialConfig, reach_px: float
) -> tuple[F32, NDArray[np.bool_]]:
    out = patches.align(image, looks.patch.take(which), px, warp)
    strayed = np.linalg.norm(out.px - px, axis=1)
    return out.px, (out.alike > config.alike) & (out.step < config.settled_px) & (strayed < reach_px)
