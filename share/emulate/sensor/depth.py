"""Depth as a D435i's stereo matching gives it: noise in disparity, and holes."""

from __future__ import annotations

import cv2
import numpy as np

from share.emulate.sensor.draws import Seed
from share.errors import ConfigError
from share.io.profile_types import Profile
from share.types import F32, U8

_MARGIN = 512
_THREE = np.ones((3, 3), np.uint8)
_OCCLUSION_PX = 0.5


class DepthSensor:
    """Depth of one device. Seed and frame decide the noise, not the order of calls.

    Raises ConfigError where the device measures no depth.
    """

    def __init__(self, profile: Profile, seed: Seed, noise: bool) -> None:
        facts, model = profile.device.depth, profile.emulation.depth
        if facts is None or model is None:
            raise ConfigError(f"profile '{profile.name}': its device measures no depth; use stereo, or d435i")
        self._facts, self._model, self._seed, self._noise = facts, model, seed, noise
        camera = profile.mode.cameras()[0]
        self._focal_baseline = camera.fx * profile.baseline_m
        rng = np.random.default_rng((*seed, 0))
        white = rng.standard_normal([n + _MARGIN for n in (camera.height, camera.width)], np.float32)
        smooth = cv2.GaussianBlur(white, (0, 0), model.smooth_px) if model.smooth_px else white
        self._bank = (smooth / smooth.std()).astype(np.float32)

    def read(self, depth: F32, left: U8, frame: int) -> np.ndarray:
        """Exact depth (H, W) m, 0 = nothing there, and the left picture -> uint16 mm, 0 = no reading."""
        near, far = self._facts.range_m
        if not self._noise:
            return np.where((depth < near) | (depth > far), 0, depth * 1000 + 0.5).astype(np.uint16)
        top, at = np.random.default_rng((*self._seed, 1, frame)).integers(0, _MARGIN, 2)
        noise = self._bank[top : top + depth.shape[0], at : at + depth.shape[1]]
        exact = self._focal_baseline / np.maximum(depth, 1e-3)
        step = self._facts.step_px
        disparity = np.rint((exact + self._model.sigma_px * noise) / step) * step
        measured = self._focal_baseline / np.maximum(disparity, step)
        edge = cv2.dilate(exact, _THREE) - cv2.erode(exact, _THREE)
        hole = (edge > _OCCLUSION_PX) | (measured < near) | (measured > far)
        return np.where(hole, 0, measured * 1000 + 0.5).astype(np.uint16)
