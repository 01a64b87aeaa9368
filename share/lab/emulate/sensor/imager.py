"""From light to gray levels: auto exposure and motion blur, and the effects of lens and imager.

Electrons e = radiance * light * (exposure / reference) * vignetting * full_well / 255, and gray = K e with K
= 255 gain / full_well. The variance of gray is affine in it (EMVA 1288): shot noise K gray, and read noise (K
read_e)^2. Rounding to 8 bits adds its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from share.geometry.camera import Camera
from share.lab.emulate.sensor.clock import Seed
from share.sensors.profile_types import CameraModel, ExposureModel
from share.types import F32, F64, I64, U8

_MIN_BLUR_SAMPLES, _MAX_BLUR_SAMPLES = 3, 16  # of one blurred picture
_SHARP_MOTION_PX = 0.3  # less motion during the exposure is not visible
_SAMPLE_STEP_PX = 1.0  # motion between two samples of a blurred picture, each a pixel wide itself


@dataclass(frozen=True)
class Exposure:
    """Exposure of one picture. light: of the lamps, relative to the room's nominal light."""

    exposure_ms: float
    gain: float = 1.0
    light: float = 1.0


@dataclass(frozen=True, eq=False)
class ExposureSeries:
    """Exposures of a series: exposure_ms, gain, light, each (N,)."""

    exposure_ms: F64
    gain: F64
    light: F64

    def __len__(self) -> int:
        return len(self.exposure_ms)

    def part(self, first: int, last: int) -> ExposureSeries:
        """Return those of pictures first .. last - 1."""
        rows = slice(first, last)
        return ExposureSeries(self.exposure_ms[rows], self.gain[rows], self.light[rows])

    def __getitem__(self, i: int) -> Exposure:
        return Exposure(float(self.exposure_ms[i]), float(self.gain[i]), float(self.light[i]))


def auto_exposure(
    brightness: F64,
    model: ExposureModel,
    reference_ms: float,
    exposure_ms: tuple[float, float],
    gain: tuple[float, float],
) -> tuple[F64, F64]:
    """Return exposure_ms and gain, each (N,), for scenes of mean radiance `brightness` (N,), 0..255.

    exposure_ms, gain: range of the device. Frame k follows from the mean of frame k - 1 - delay, which is 255
    at most: it goes `damping` of the way to the target in stops, in steps of a fixed ratio, and stays within
    a step. The first picture is well exposed: the device has been running.
    """
    longest = min(model.longest_ms, exposure_ms[1])
    log_min, log_max = np.log([exposure_ms[0] * gain[0], longest * gain[1]])
    log_step = np.log1p(model.step)
    scene = np.log(np.maximum(brightness, 1e-3) / reference_ms)  # log(gray) = log(scene * exposure * gain)
    product = np.empty(len(scene))
    now = np.log(model.target) - scene[0] if len(scene) else 0.0
    for k in range(len(scene)):
        measured_frame = k - 1 - model.delay_frames
        if measured_frame >= 0:
            measured = min(scene[measured_frame] + product[measured_frame], np.log(255))
            error = product[measured_frame] + np.log(model.target) - measured - now
            now += model.damping * error if abs(error) > log_step else 0.0
        now = np.clip(now, log_min, log_max)
        product[k] = np.clip(np.rint(now / log_step) * log_step, log_min, log_max)
    total = np.exp(product)
    time = np.minimum(total, longest)
    return time, total / time


def lamp_light(seed: Seed, since_ns: I64, every_s: float, stops: float) -> F64:
    """Return the light (N,) at times since the session's start: it changes now and then by up to `stops` (a
    power of two).

    Times between changes are exponentially distributed; the light returns to 1 at every second one.
    """
    if every_s <= 0 or len(since_ns) == 0:
        return np.ones(len(since_ns))
    count = int(since_ns.max() / 1e9 / every_s * 2) + 50
    switch_ns = np.cumsum(np.random.default_rng((*seed, 0)).exponential(every_s, count)) * 1e9
    level = 2.0 ** np.random.default_rng((*seed, 1)).uniform(-stops, stops, count)
    switchings = np.searchsorted(switch_ns, since_ns, side="right")
    out: F64 = np.where(switchings % 2 == 1, level[switchings - 1], 1.0)
    return out


def blur_offsets(exposure_ms: float, pixels_of_motion: float) -> F64:
    """Return times (S,) s, relative to the middle of the exposure, at which to draw a picture with motion
    blur.

    pixels_of_motion: largest image motion during the exposure. The times are the middles of S equal parts, so
    that their mean is the integral by the midpoint rule. S is 1 below 0.3 px, else 3 to 16.
    """
    if pixels_of_motion < _SHARP_MOTION_PX:
        return np.zeros(1)
    samples = int(np.clip(np.ceil(pixels_of_motion / _SAMPLE_STEP_PX), _MIN_BLUR_SAMPLES, _MAX_BLUR_SAMPLES))
    return ((np.arange(samples) + 0.5) / samples - 0.5) * exposure_ms * 1e-3


# The imager.

BANK_MARGIN = 512  # the noise bank exceeds a picture by this, so there are 512^2 offsets to read it at


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
            self._bank = rng.standard_normal([n + BANK_MARGIN for n in shape], np.float32)

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
        top, left = np.random.default_rng((*self._seed, 1, frame)).integers(0, BANK_MARGIN, 2)
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
