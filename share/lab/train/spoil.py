"""What goes wrong for a tracker, put into frames that went right: so that errors of all sizes are met.

A run in a well-lit room errs by millimetres. Spoiled by and by, the same recording gives others in which
it is dark, blurred, hazy, covered, or frames and IMU samples are missing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from share.geometry.camera import Rig
from share.types import F32, U8, Frame, ImuBatch

QUIET_S, SPOILED_S = (2.0, 10.0), (1.0, 8.0)  # drawn evenly; how long a spell and what is between lasts
_READ_NOISE = 2.0  # gray levels, of a sensor
_FULL_WELL = 40.0  # photons a gray level
_BLUR_PX = 6.0  # sigma, at the worst
_COVER_M = (0.1, 0.5)  # how far away what covers is
_NEAREST_M = 0.28  # that a depth camera measures


@dataclass(frozen=True)
class Spell:
    """Something is wrong from begin_ns until end_ns. how: one of `KINDS`. much: from 0, hardly, to 1, worst.
    where: three numbers from 0 to 1, of what covers a part of the image: to the right, down, and away."""

    how: str
    begin_ns: int
    end_ns: int
    much: float
    where: tuple[float, float, float] = (0.5, 0.5, 0.5)

    def holds(self, stamp_ns: int) -> bool:
        return self.begin_ns <= stamp_ns < self.end_ns


def draw(rng: np.random.Generator, begin_ns: int, end_ns: int, kinds: Iterable[str]) -> list[Spell]:
    """Spells of each of `kinds`, which come and go independently of each other."""
    spells = []
    for how in kinds:
        at = begin_ns + _ns(rng.uniform(*QUIET_S))
        while at < end_ns:
            lasts = _ns(rng.uniform(*SPOILED_S))
            x, y, z = rng.random(3).tolist()
            spells.append(Spell(how, at, at + lasts, float(rng.random()), (x, y, z)))
            at += lasts + _ns(rng.uniform(*QUIET_S))
    return spells


def spoiled(frames: Iterable[Frame], spells: Iterable[Spell], seed: int, rig: Rig) -> Iterator[Frame]:
    """What a tracker is given of `frames`, which are rig's. IMU samples of a frame that is missing come with
    the next one."""
    spells = list(spells)
    held, missing_since_ns = ImuBatch.empty(), 0
    for frame in frames:
        now = [spell for spell in spells if spell.holds(frame.stamp_ns)]
        imu = held.join(frame.imu)
        if any(spell.how == "deaf" for spell in now):
            imu = ImuBatch.empty()
        rng = np.random.default_rng((seed, frame.index))
        if any(spell.how == "drop" and rng.random() < 0.3 + 0.7 * spell.much for spell in now):
            held, missing_since_ns = imu, missing_since_ns or frame.stamp_ns - frame.gap_ns
            continue
        gap_ns = frame.gap_ns + (frame.stamp_ns - missing_since_ns if missing_since_ns else 0)
        held, missing_since_ns = ImuBatch.empty(), 0
        for spell in now:
            frame = _seen(frame, spell, seed, rig)
        yield replace(frame, imu=imu, gap_ns=gap_ns)


def _seen(frame: Frame, spell: Spell, seed: int, rig: Rig) -> Frame:
    """What is seen of it."""
    image0, image1, depth = frame.image0, frame.image1, frame.depth
    noise0, noise1 = (np.random.default_rng((seed, frame.index, eye)) for eye in (0, 1))
    if spell.how in _OPTICAL:
        image0 = _OPTICAL[spell.how](image0, spell, noise0)
        image1 = None if image1 is None else _OPTICAL[spell.how](image1, spell, noise1)
    elif spell.how == "cover":
        image0 = _cover(image0, spell, noise0, 0.0)
        image1 = None if image1 is None else _cover(image1, spell, noise1, rig.cam0.focal * rig.baseline)
        depth = None if depth is None else _cover_depth(depth, spell)
    return replace(frame, image0=image0, image1=image1, depth=depth)


def _dark(image: U8, spell: Spell, rng: np.random.Generator) -> U8:
    """Fewer photons, down to a hundredth, and the noise of those that are left."""
    mean = image.astype(np.float32) * 10 ** (-2 * spell.much)
    noise = np.sqrt(mean / _FULL_WELL + _READ_NOISE**2) * rng.standard_normal(image.shape, np.float32)
    return _as_image(mean + noise)


def _blur(image: U8, spell: Spell, rng: np.random.Generator) -> U8:
    """Out of focus."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.5 + (_BLUR_PX - 0.5) * spell.much), np.uint8)


def _haze(image: U8, spell: Spell, rng: np.random.Generator) -> U8:
    """Less contrast, down to a fiftieth: walls without a texture, glare, fog."""
    kept = 50 ** (-spell.much)
    return _as_image(kept * image.astype(np.float32) + (1 - kept) * float(image.mean()))


def _cover(image: U8, spell: Spell, rng: np.random.Generator, disparity_px_m: float) -> U8:
    """A hand or a wall right in front, which moves with the camera: a plain patch, from a third of the image
    to nearly all of it. disparity_px_m: focal length times baseline, 0 for cam0."""
    rows, columns = _covered(image.shape, spell, disparity_px_m)
    out = image.copy()
    plain = float(image.mean()) + _READ_NOISE * rng.standard_normal(out[rows, columns].shape, np.float32)
    out[rows, columns] = _as_image(plain)
    return out


def _cover_depth(depth: F32, spell: Spell) -> F32:
    out, away_m = depth.copy(), _away_m(spell)
    out[_covered(depth.shape, spell, 0.0)] = away_m if away_m > _NEAREST_M else 0.0
    return out


def _covered(shape: tuple[int, ...], spell: Spell, disparity_px_m: float) -> tuple[slice, slice]:
    """Rows and columns."""
    height, width = shape
    side = np.sqrt(0.33 + 0.65 * spell.much)
    w, h = round(side * width), round(side * height)
    left, top = spell.where[0] * (width - w), round(spell.where[1] * (height - h))
    x = round(left - disparity_px_m / _away_m(spell))
    return slice(top, top + h), slice(max(0, x), max(0, x + w))


def _away_m(spell: Spell) -> float:
    nearest, farthest = _COVER_M
    return nearest + spell.where[2] * (farthest - nearest)


def _as_image(values: np.ndarray) -> U8:
    return np.asarray(np.rint(values).clip(0, 255), np.uint8)


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)


_OPTICAL = {"dark": _dark, "blur": _blur, "haze": _haze}
KINDS = (*_OPTICAL, "cover", "drop", "deaf")
