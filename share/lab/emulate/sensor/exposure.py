"""Auto exposure: exposure time and gain of each picture by the scene's brightness, and motion blur."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.lab.emulate.sensor.indexed_random import Seed
from share.sensors.profile_types import ExposureModel
from share.types import F64, I64

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
