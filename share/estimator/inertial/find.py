"""Features of the state in the images of a frame: expected where the filter says, found by their patches."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from share.config import InertialConfig
from share.estimator.inertial import observe
from share.estimator.inertial.features import Looks, seen_twice
from share.estimator.inertial.observe import Aim
from share.estimator.inertial.state import State
from share.geometry.camera import Camera, Rig
from share.types import F32, F64, I64, U8, Frame
from share.vision import klt, patches

_BORDER_PX = 6.0
_AGREE_PX = 1.5  # how far the way by the image before may be from what the first patch says
_MANY = 0.15  # of the features in view that are not found: then they are followed from the image before


@dataclass(frozen=True, eq=False)
class Right:
    """Features number which (M,) in cam1: px (M, 2) where found; uv (M, 2) normalised, as expected."""

    which: I64
    px: F32
    uv: F64


@dataclass(frozen=True, eq=False)
class Sought:
    """Of all N features in cam0: px (N, 2) and whether each was found, and, for others to say, went its own
    way; expected (N, 2) px and uv (N, 2) normalised, NaN behind the camera; what patches look like there,
    warp (N, 2, 2) px by px, and by how many px of its first image a feature moves for one unit more of
    inverse depth, along (N, 2). samples (N, S), shift (N, 2): see `patches.Found`. right: in cam1."""

    px: F32
    found: NDArray[np.bool_]
    astray: NDArray[np.bool_]
    expected: F64
    uv: F64
    warp: F64
    along: F64
    samples: F32
    shift: F32
    right: Right | None = None

    def due(self, camera: Camera) -> int:
        """How many should be in view."""
        return int(camera.inside(self.expected, 0.0).sum())


def seek(
    frame: Frame, rig: Rig, state: State, looks: Looks, config: InertialConfig, fresh: int = 0
) -> Sought:
    """Those from number `fresh` on in the images of a frame, both in one pass; in cam1 only those whose turn
    it is."""
    n = len(state.ids)
    which = np.arange(fresh, n)
    images: tuple[U8, ...] = (frame.image0,)
    cameras, first = [rig.cam0], len(which)
    if frame.image1 is not None and rig.cam1 is not None and not fresh:
        images, cameras = (frame.image0, frame.image1), [rig.cam0, rig.cam1]
        which = np.concatenate([which, np.flatnonzero(seen_twice(looks))])
    right = np.arange(len(which)) >= first
    T = rig.T_cam1_cam0 if len(cameras) > 1 else None
    aim = observe.aim(state, which, looks.spread[which], looks.slant[which], T, right)
    parts = [slice(0, first), slice(first, None)][: len(cameras)]
    expected = np.concatenate([c.distort(aim.uv[part]) for c, part in zip(cameras, parts, strict=True)])
    jacobian = np.concatenate([c.jacobian(aim.uv[part]) for c, part in zip(cameras, parts, strict=True)])
    warp = jacobian @ aim.warp
    inside = np.concatenate(
        [c.inside(expected[part], _BORDER_PX) for c, part in zip(cameras, parts, strict=True)]
    )
    todo = np.flatnonzero(inside)
    left = Aim(aim.uv[:first], aim.warp[:first], aim.by_rho[:first])
    out = _nothing(n, which[:first], expected[:first], left, warp[:first])
    if len(todo) == 0:
        return out
    ahead = int(np.searchsorted(todo, first))
    at = expected[todo]
    found = patches.align(images, ahead, looks.patch.probe[which[todo]], at, warp[todo])
    good = _good(found, at, config, config.reach_px)
    for camera, part in zip(cameras, (slice(0, ahead), slice(ahead, None)), strict=False):
        if camera.bounded:  # it may have strayed to where there is no ray
            good[part] &= camera.knows(found.px[part].astype(np.float64))
    _put(out, which[todo[:ahead]], found, good, slice(0, ahead))
    if len(cameras) == 1:
        return out
    seen, where = todo[ahead:], np.flatnonzero(good[ahead:] & out.found[which[todo[ahead:]]])
    there = Right(which[seen[where]], found.px[ahead:][where], aim.uv[seen[where]])
    return replace(out, right=there)


def rescue(
    before: U8, image: U8, camera: Camera, looks: Looks, sought: Sought, config: InertialConfig
) -> None:
    """Where many of cam0 were not found, these are followed from the image before to wherever they went."""
    inside = camera.inside(sought.expected, _BORDER_PX)
    todo = np.flatnonzero(~sought.found & inside)
    if len(todo) <= _MANY * inside.sum():
        return
    guess = sought.expected[todo].astype(np.float32)
    px, ok = klt.follow(before, image, looks.px[todo], guess, window=15, levels=2, back_check_px=1.0)
    todo, at = todo[ok], px[ok].astype(np.float64)
    if len(todo) == 0:
        return
    found = patches.align((image,), len(todo), looks.patch.probe[todo], at, sought.warp[todo])
    good = _good(found, at, config, _AGREE_PX) & camera.knows(found.px.astype(np.float64))
    _put(sought, todo, found, good, slice(None))


def _nothing(n: int, which: I64, expected: F64, aim: Aim, warp: F64) -> Sought:
    """Of n features, where `which` (M,) are to be looked for."""
    where, uv = np.full((n, 2), np.nan), np.full((n, 2), np.nan)
    where[which], uv[which] = expected, aim.uv
    warps, along = np.zeros((n, 2, 2)), np.zeros((n, 2))
    warps[which], along[which] = warp, _along(aim)
    no, s = np.zeros(n, bool), len(patches.OFFSETS)
    px = np.where(np.isnan(where), -1e6, where).astype(np.float32)
    samples, shift = np.zeros((n, s), np.float32), np.zeros((n, 2), np.float32)
    return Sought(px, no, no.copy(), where, uv, warps, along, samples, shift)


def _along(aim: Aim) -> F64:
    """px (N, 2) of the first image by which a feature moves for one unit more of inverse depth."""
    (a, b), (c, d) = np.moveaxis(aim.warp, 0, 2)
    x, y = aim.by_rho.T
    with np.errstate(divide="ignore", invalid="ignore"):
        out = np.stack([d * x - b * y, a * y - c * x], axis=1) / (a * d - b * c)[:, None]
    return np.where(np.isfinite(out), out, 0.0)


def _good(found: patches.Found, px: F64, config: InertialConfig, reach_px: float) -> NDArray[np.bool_]:
    """Which are what was looked for, near px (N, 2)."""
    strayed = np.hypot(*(found.px - px).T)
    near = (found.step < config.settled_px) & (strayed < reach_px)
    out: NDArray[np.bool_] = near & (found.alike > config.alike)
    return out


def _put(out: Sought, which: I64, found: patches.Found, good: NDArray[np.bool_], part: slice) -> None:
    out.px[which], out.found[which] = found.px[part], good[part]
    out.samples[which], out.shift[which] = found.samples[part], found.shift[part]
