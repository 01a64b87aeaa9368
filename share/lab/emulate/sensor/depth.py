"""Depth as of a D435i's stereo matching: texture-dependent disparity errors, and holes.

The model follows block matching (docs/understand/sensors.md compares the two). A window of n pixels with mean
squared horizontal gradient g^2 and gray noise s in both pictures gives disparity to

    sigma^2 = floor^2 + 2 s^2 / (n g^2)          (least squares; Gruen 1985)

There is no reading where g / s is small, where the right camera does not see the point (behind an edge, left
of its picture), and outside the range. Edges are uncertain by the reach of the window over them.
"""

from __future__ import annotations

import cv2
import numpy as np

from share.errors import ConfigError
from share.lab.emulate.sensor.clock import Seed
from share.lab.emulate.sensor.imager import BANK_MARGIN
from share.sensors.profile_types import CameraModel, Profile
from share.types import F32, U8

_EDGE_DISPARITY_PX = 1.5  # disparity step that counts as an edge; slopes have less
_ROUNDING = 1 / 12  # variance of rounding gray levels


class DepthSensor:
    """Depth of one device. Noise depends on seed and frame, not on the order of calls.

    Raises ConfigError where the device measures no depth.
    """

    def __init__(self, profile: Profile, seed: Seed, noise: bool) -> None:
        facts, model = profile.device.depth, profile.emulation.depth
        if facts is None or model is None:
            raise ConfigError(f"profile '{profile.name}': its device measures no depth; use stereo, or d435i")
        self._spec, self._model, self._seed, self._noise = facts, model, seed, noise
        self._camera_model = profile.emulation.camera
        camera = profile.mode.cameras()[0]
        self._focal_baseline = camera.fx * profile.baseline_m
        self._bank = _noise_bank((camera.height, camera.width), model.smooth_px, seed)

    def depth_reading(self, depth: F32, left_image: U8, frame: int, gain: float = 1.0) -> np.ndarray:
        """Convert exact depth (H, W) m, 0 = nothing, and the left picture to uint16 mm, 0 = no reading.

        gain: of the picture; its noise hides texture.
        """
        near, far = self._spec.range_m
        if not self._noise:
            return np.where((depth < near) | (depth > far), 0, depth * 1000 + 0.5).astype(np.uint16)
        first, second = self._read_bank(depth.shape, frame)
        exact = np.where(depth > 0, self._focal_baseline / np.maximum(depth, 1e-3), np.float32(0))
        matched = self._matched_disparity(exact, second)
        inverse_snr = self._inverse_snr(left_image, gain)
        sigma = cv2.sqrt(self._model.sigma_px**2 + (2 / self._model.window_px**2) * inverse_snr)
        step = self._spec.step_px
        disparity = np.rint((matched + sigma * first) * np.float32(1 / step)) * np.float32(step)
        threshold = self._model.hole_snr + self._model.hole_spread * second
        blank = inverse_snr * threshold * np.abs(threshold) > 1
        hole = blank | self._occluded(matched) | (exact <= 0)
        low, high = self._focal_baseline / far, self._focal_baseline / near
        hole |= (disparity < low) | (disparity > high)
        disparity[hole] = np.inf
        mm: np.ndarray = np.float32(self._focal_baseline * 1000) / disparity + np.float32(0.5)
        return mm.astype(np.uint16)

    def _inverse_snr(self, left_image: U8, gain: float) -> F32:
        """Return (s / g)^2 in the window about each pixel (H, W)."""
        size = (self._model.window_px, self._model.window_px)
        slope = cv2.Sobel(left_image, cv2.CV_32F, 1, 0, ksize=1, scale=0.5)
        energy = cv2.boxFilter(cv2.multiply(slope, slope), -1, size)
        variance = noise_variance(cv2.blur(left_image, size), self._camera_model, gain)
        clean = cv2.subtract(energy, 0.5 * variance)  # the central difference of noise
        out: F32 = variance / np.maximum(clean, 0.01 * variance)
        return out

    def _matched_disparity(self, disparity: F32, chance: F32) -> F32:
        """Return the disparity that the window matches: near an edge the front or the back at random, so that
        edges move by `edge_px` to either side."""
        kernel = np.ones((2 * self._model.edge_px + 1,) * 2, np.uint8)
        front, back = cv2.dilate(disparity, kernel), cv2.erode(disparity, kernel)
        edge = cv2.subtract(front, back) > _EDGE_DISPARITY_PX
        out = disparity.copy()
        out[edge] = np.where(chance[edge] > 0, front[edge], back[edge])
        return out

    def _occluded(self, disparity: F32) -> np.ndarray:
        """Return which pixels (H, W) the right camera does not see: a pixel further right lands at the same
        place of its picture or beyond, or they land outside it."""
        at = np.arange(disparity.shape[1], dtype=np.float32) - disparity  # column in the right picture
        nearest = np.minimum.accumulate(at[:, ::-1], axis=1)[:, ::-1]
        hidden: np.ndarray = (nearest < at - 0.5) | (at < self._model.window_px // 2)
        return hidden

    def _read_bank(self, shape: tuple[int, ...], frame: int) -> list[F32]:
        places = np.random.default_rng((*self._seed, 1, frame)).integers(0, BANK_MARGIN, (2, 2))
        return [self._bank[top : top + shape[0], left : left + shape[1]] for top, left in places]


def noise_variance(gray: U8, model: CameraModel, gain: float) -> F32:
    """Return the variance of gray levels (H, W) between two cameras: shot, read, fixed-pattern and rounding
    noise (see `share.lab.emulate.sensor.imager`)."""
    K, level = 255 * gain / model.full_well_e, np.arange(256)
    fixed = (model.pixel_gain * level) ** 2 + (K * model.pixel_offset_e) ** 2
    table = K * level + (K * model.read_e) ** 2 + fixed + _ROUNDING
    out: F32 = cv2.LUT(gray, table.astype(np.float32))
    return out


def _noise_bank(shape: tuple[int, int], smooth_px: float, seed: Seed) -> F32:
    """Return standard normal numbers correlated over `smooth_px` pixels, more than a picture needs."""
    white = np.random.default_rng((*seed, 0)).standard_normal([n + BANK_MARGIN for n in shape], np.float32)
    smooth = cv2.GaussianBlur(white, (0, 0), smooth_px) if smooth_px else white
    out: F32 = (smooth / smooth.std()).astype(np.float32)
    return out
