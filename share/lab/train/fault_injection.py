"""Faults injected into sound recordings, so that training sees tracking errors of all sizes.

A run in a well-lit room errs by millimetres. With faults, the same recording is at times dark, blurred, hazy
or covered, or frames or IMU samples are missing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from share.geometry.camera import Rig
from share.types import F32, U8, Frame, ImuBatch

BETWEEN_FAULTS_S = (2.0, 10.0)  # uniform, between two faults of a kind
FAULT_S = (1.0, 8.0)  # uniform, duration of a fault
_READ_NOISE = 2.0  # gray levels
_FULL_WELL = 40.0  # photons per gray level
_BLUR_PX = 6.0  # sigma at severity 1
_OCCLUDER_DISTANCE_M = (0.1, 0.5)  # distance of the occluder
_MIN_DEPTH_M = 0.28  # least range of a depth camera


@dataclass(frozen=True)
class FaultInterval:
    """A fault in begin_ns <= t < end_ns. kind: one of `FAULT_KINDS`. severity: 0 to 1. position: three
    numbers in 0 .. 1 that place an occluder: right, down and distance."""

    kind: str
    begin_ns: int
    end_ns: int
    severity: float
    position: tuple[float, float, float] = (0.5, 0.5, 0.5)

    def is_active(self, stamp_ns: int) -> bool:
        return self.begin_ns <= stamp_ns < self.end_ns


def draw_faults(
    rng: np.random.Generator, begin_ns: int, end_ns: int, kinds: Iterable[str]
) -> list[FaultInterval]:
    """Draw intervals of each of `kinds`, independent of each other."""
    faults = []
    for kind in kinds:
        begin = begin_ns + _ns(rng.uniform(*BETWEEN_FAULTS_S))
        while begin < end_ns:
            duration = _ns(rng.uniform(*FAULT_S))
            x, y, z = rng.random(3).tolist()
            faults.append(FaultInterval(kind, begin, begin + duration, float(rng.random()), (x, y, z)))
            begin += duration + _ns(rng.uniform(*BETWEEN_FAULTS_S))
    return faults


def inject_faults(
    frames: Iterable[Frame], faults: Iterable[FaultInterval], seed: int, rig: Rig
) -> Iterator[Frame]:
    """Yield `frames` of `rig` with `faults`. IMU samples of a dropped frame come with the next one."""
    faults = list(faults)
    pending_imu, missing_since_ns = ImuBatch.empty(), 0
    for frame in frames:
        active = [fault for fault in faults if fault.is_active(frame.stamp_ns)]
        imu = pending_imu.concatenate(frame.imu)
        if any(fault.kind == "imu_missing" for fault in active):
            imu = ImuBatch.empty()
        rng = np.random.default_rng((seed, frame.index))
        if any(fault.kind == "drop" and rng.random() < 0.3 + 0.7 * fault.severity for fault in active):
            pending_imu, missing_since_ns = imu, missing_since_ns or frame.stamp_ns - frame.gap_ns
            continue
        gap_ns = frame.gap_ns + (frame.stamp_ns - missing_since_ns if missing_since_ns else 0)
        pending_imu, missing_since_ns = ImuBatch.empty(), 0
        for fault in active:
            frame = _degrade_images(frame, fault, seed, rig)
        yield replace(frame, imu=imu, gap_ns=gap_ns)


def _degrade_images(frame: Frame, fault: FaultInterval, seed: int, rig: Rig) -> Frame:
    """Return the frame with its images and depth degraded by `fault`."""
    image0, image1, depth = frame.image0, frame.image1, frame.depth
    noise0, noise1 = (np.random.default_rng((seed, frame.index, eye)) for eye in (0, 1))
    if fault.kind in _IMAGE_FAULTS:
        image0 = _IMAGE_FAULTS[fault.kind](image0, fault, noise0)
        image1 = None if image1 is None else _IMAGE_FAULTS[fault.kind](image1, fault, noise1)
    elif fault.kind == "cover":
        image0 = _occlude(image0, fault, noise0, 0.0)
        image1 = None if image1 is None else _occlude(image1, fault, noise1, rig.cam0.focal * rig.baseline)
        depth = None if depth is None else _occlude_depth(depth, fault)
    return replace(frame, image0=image0, image1=image1, depth=depth)


def _dark(image: U8, fault: FaultInterval, rng: np.random.Generator) -> U8:
    """Fewer photons, down to 1 %, with their shot noise and read noise."""
    mean = image.astype(np.float32) * 10 ** (-2 * fault.severity)
    noise = np.sqrt(mean / _FULL_WELL + _READ_NOISE**2) * rng.standard_normal(image.shape, np.float32)
    return _as_image(mean + noise)


def _blur(image: U8, fault: FaultInterval, rng: np.random.Generator) -> U8:
    """Defocus: a Gaussian blur."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.5 + (_BLUR_PX - 0.5) * fault.severity), np.uint8)


def _haze(image: U8, fault: FaultInterval, rng: np.random.Generator) -> U8:
    """Less contrast, down to 2 %: untextured walls, glare, fog."""
    contrast = 50 ** (-fault.severity)
    return _as_image(contrast * image.astype(np.float32) + (1 - contrast) * float(image.mean()))


def _occlude(image: U8, fault: FaultInterval, rng: np.random.Generator, disparity_px_m: float) -> U8:
    """Cover a third to nearly all of the image with a plain patch that moves with the camera, like a hand or
    a near wall. disparity_px_m: focal length times baseline, 0 for cam0."""
    rows, columns = _occluded_region(image.shape, fault, disparity_px_m)
    out = image.copy()
    patch = float(image.mean()) + _READ_NOISE * rng.standard_normal(out[rows, columns].shape, np.float32)
    out[rows, columns] = _as_image(patch)
    return out


def _occlude_depth(depth: F32, fault: FaultInterval) -> F32:
    out, away_m = depth.copy(), _occluder_distance_m(fault)
    out[_occluded_region(depth.shape, fault, 0.0)] = away_m if away_m > _MIN_DEPTH_M else 0.0
    return out


def _occluded_region(
    shape: tuple[int, ...], fault: FaultInterval, disparity_px_m: float
) -> tuple[slice, slice]:
    """Return the rows and columns that the occluder covers."""
    height, width = shape
    side = np.sqrt(0.33 + 0.65 * fault.severity)
    w, h = round(side * width), round(side * height)
    left, top = fault.position[0] * (width - w), round(fault.position[1] * (height - h))
    x = round(left - disparity_px_m / _occluder_distance_m(fault))
    return slice(top, top + h), slice(max(0, x), max(0, x + w))


def _occluder_distance_m(fault: FaultInterval) -> float:
    nearest, farthest = _OCCLUDER_DISTANCE_M
    return nearest + fault.position[2] * (farthest - nearest)


def _as_image(values: np.ndarray) -> U8:
    return np.asarray(np.rint(values).clip(0, 255), np.uint8)


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)


_IMAGE_FAULTS = {"dark": _dark, "blur": _blur, "haze": _haze}
FAULT_KINDS = (*_IMAGE_FAULTS, "cover", "drop", "imu_missing")
