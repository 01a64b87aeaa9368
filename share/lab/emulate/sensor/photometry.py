"""From light to gray levels: the effects of lens and imager on a perfect picture.

Electrons e = radiance * light * (exposure / reference) * vignetting * full_well / 255, and gray = K e with K
= 255 gain / full_well. The variance of gray is affine in it (EMVA 1288): shot noise K gray, and read noise (K
read_e)^2. Rounding to 8 bits adds its own.
"""

from __future__ import annotations

import cv2
import numpy as np

from share.geometry.camera import Camera
from share.lab.emulate.sensor.exposure import Exposure
from share.lab.emulate.sensor.indexed_random import Seed
from share.sensors.profile_types import CameraModel
from share.types import F32, U8

_BANK_MARGIN = 512  # the noise bank exceeds a picture by this, so there are 512^2 offsets to read it at


class Imager:
    """One camera of one device. Pure: the result depends on seed, frame and picture, not on the order of
    calls."""

    def __init__(
        self, camera: Camera, model: CameraModel, seed: Seed, noise: bool, vignetting: bool, blur: bool
    ) -> None:
        shape = (camera.height, camera.width)
        rng = np.random.default_rng((*seed, 0))
        self._model, self._seed, self._noise = model, seed, noise
        self._psf = model.psf_px if blur else 0.0
        self._response = (
            vignetting_gain(camera, model.corner_light) if vignetting else np.ones(shape, np.float32)
        )
        if noise:
            self._response *= 1 + model.pixel_gain * rng.standard_normal(shape, np.float32)
            self._offset_e = model.pixel_offset_e * rng.standard_normal(shape, np.float32)
            self._bank = rng.standard_normal([n + _BANK_MARGIN for n in shape], np.float32)

    @property
    def mean_response(self) -> float:
        """Return the share of the mean brightness left by vignetting."""
        return float(self._response.mean())

    def develop(self, radiance: F32, frame: int, shot: Exposure) -> U8:
        """Convert radiance (H, W) float32, 0..255 and beyond, to gray levels (H, W) uint8."""
        exposed = shot.light * shot.gain * shot.exposure_ms / self._model.reference_ms
        gray = cv2.multiply(self._blurred(radiance), self._response, scale=exposed)
        if self._noise:
            gray = cv2.add(gray, self._noise_image(gray, frame, shot.gain))
        out: U8 = cv2.convertScaleAbs(np.maximum(gray, 0))  # rounds, and saturates at 255
        return out

    def _blurred(self, radiance: F32) -> F32:
        if self._psf <= 0:
            return radiance
        soft: F32 = cv2.GaussianBlur(radiance, (5, 5), self._psf, borderType=cv2.BORDER_REPLICATE)
        return soft

    def _noise_image(self, gray: F32, frame: int, gain: float) -> F32:
        K = 255 * gain / self._model.full_well_e
        top, left = np.random.default_rng((*self._seed, 1, frame)).integers(0, _BANK_MARGIN, 2)
        white = self._bank[top : top + gray.shape[0], left : left + gray.shape[1]]
        sigma = cv2.sqrt(cv2.add(gray * K, (K * self._model.read_e) ** 2))
        out: F32 = cv2.add(cv2.multiply(white, sigma), self._offset_e * K)
        return out


def vignetting_gain(camera: Camera, corner_light: float) -> F32:
    """Return the light (H, W) float32 relative to the middle: cos(field angle)^n, with n such that the corner
    farthest from the axis gets `corner_light`; for a fisheye lens by half that angle. n = 4 is the natural
    law; lenses are made to have less."""
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    if camera.is_fisheye:  # it sees beyond 90 degrees, where the law ends
        cos = np.nan_to_num(camera.directions(grid.astype(np.float64))[..., 2], nan=-1.0)
        cos2 = np.maximum((1 + cos) / 2, 0.1)
    else:
        cos2 = 1 / (1 + (camera.normalise(grid.astype(np.float64)) ** 2).sum(axis=-1))
    power = np.log(corner_light) / np.log(cos2.min())
    out: F32 = (cos2**power).astype(np.float32)
    return out
