"""One emulated device: turns perfect pictures and motion into a recording's data.

All random numbers follow from (seed, stream, frame), in any order and any process.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from share.lab.emulate.sensor import clock as clocks
from share.lab.emulate.sensor import imager
from share.lab.emulate.sensor.clock import DeviceClock, SampleStream, Seed
from share.lab.emulate.sensor.depth import DepthSensor
from share.lab.emulate.sensor.effects import Effects
from share.lab.emulate.sensor.imager import Exposure, ExposureSeries, Imager
from share.lab.emulate.sensor.imu import (
    ImuStreams,
    knock_acceleration,
    measured_samples,
    rotation_rates,
    saturate_and_quantise,
    vibration_acceleration,
)
from share.lab.emulate.types import MotionPath
from share.sensors.profile_types import InertialFacts, Profile
from share.sensors.stamps import unwrap_stamps
from share.types import F32, F64, I64, U8

_MAX_EXPOSURE_SHARE = 0.9  # longest exposure, as a share of the frame period
# indices of random streams
(
    _PHASE_STREAM,
    _DROP_STREAM,
    _JITTER_STREAM,
    _LAMP_STREAM,
    _CAMERA_STREAM,
    _DEPTH_STREAM,
    _GYRO_STREAM,
    _ACCEL_STREAM,
    _VIBRATION_STREAM,
) = range(9)


@dataclass(frozen=True, eq=False)
class PictureTimes:
    """Recorded frames: index (N,), middle of exposure (true time) and stamps, both (N,) ns."""

    index: I64
    true_ns: I64
    stamp_ns: I64

    def __len__(self) -> int:
        return len(self.index)


class EmulatedDevice:
    """A device of `profile` with `effects`.

    origin_ns: true time (that of the path) at which it is switched on, where frame 0 is. seed: its own;
    room_seed: of the lamps, which all devices in the room share.
    """

    def __init__(
        self,
        profile: Profile,
        effects: Effects | None = None,
        seed: Seed = (0,),
        origin_ns: int = 0,
        room_seed: Seed = (0,),
    ) -> None:
        self.profile, self.effects = profile, effects or Effects()
        self._seed, self._origin_ns, self._room_seed = seed, origin_ns, room_seed
        facts = profile.device.clock
        self.clock = DeviceClock(
            origin_ns,
            round(self.effects.clock_offset_ms * 1e6),
            self.effects.clock_drift_ppm,
            facts.tick_ns,
            facts.bits if self.effects.wrap else 0,
        )

    # -- pictures ----------------------------------------------------------------------------

    def picture_times(self, start_ns: int, end_ns: int) -> PictureTimes:
        """Return the frames exposed in [start, end] true time that are not dropped."""
        effects = self.effects
        index, true = self._stream(self.profile.rate_hz, _CAMERA_STREAM).sample_times(start_ns, end_ns)
        is_dropped = clocks.dropped_mask(
            (*self._seed, _DROP_STREAM), index, effects.drops, effects.drop_burst
        )
        index, true = index[~is_dropped], true[~is_dropped]
        error = clocks.stamp_jitter_ns(
            (*self._seed, _JITTER_STREAM, _CAMERA_STREAM),
            index,
            effects.jitter_ms * 1e6,
            self.profile.rate_hz,
        )
        return PictureTimes(index, true, self.clock.read(true - round(effects.time_offset_ms * 1e6) + error))

    def truth_times(self, pictures: PictureTimes) -> tuple[I64, I64]:
        """Return (true_ns, stamp_ns), each (N,): the true times at which the clock shows the stamps of
        `picture_times`, and these stamps unwrapped."""
        stamp_error = pictures.stamp_ns - self.clock.read(pictures.true_ns)
        if period := self.clock.period_ns:
            stamp_error = (stamp_error + period // 2) % period - period // 2
        return pictures.true_ns + stamp_error, unwrap_stamps(pictures.stamp_ns, self.clock.period_ns)

    def lamp_light(self, true_ns: I64) -> F64:
        """Return the light of the room's lamps (N,) at true times (N,), relative to the room's nominal
        light."""
        effects = self.effects
        since = np.asarray(true_ns) - self._origin_ns
        return imager.lamp_light(
            (*self._room_seed, _LAMP_STREAM), since, effects.lamp_every_s, effects.lamp_stops
        )

    def exposures(self, true_ns: I64, brightness: F64) -> ExposureSeries:
        """Return the exposures of pictures at true_ns (N,); brightness (N,): mean radiance of their views."""
        light, device = self.lamp_light(true_ns), self.profile.device
        model, reference = self.profile.emulation.exposure, self._reference_ms
        if not self.effects.exposure:
            return ExposureSeries(np.full(len(light), reference), np.ones(len(light)), light)
        scene_brightness = np.asarray(brightness, np.float64) * light * self._imagers[0].mean_response
        shortest, longest = device.exposure_ms
        longest = min(longest, _MAX_EXPOSURE_SHARE * 1000 / self.profile.rate_hz)
        time, gain = imager.auto_exposure(
            scene_brightness, model, reference, (shortest, longest), device.gain
        )
        return ExposureSeries(time, gain, light)

    def blur_offsets(self, shot: Exposure, pixels_of_motion: float) -> F64:
        """Return times (S,) s, relative to a picture's, at which to draw it; pixels_of_motion: largest image
        motion during the exposure."""
        return imager.blur_offsets(shot.exposure_ms, pixels_of_motion if self.effects.blur else 0.0)

    def develop_image(self, radiance: F32, frame: int, camera: int, shot: Exposure | None = None) -> U8:
        """Convert radiance (H, W) float32 of camera 0 or 1 to gray (H, W) uint8. frame: its
        `PictureTimes.index`. Without `shot`: the reference exposure."""
        return self._imagers[camera].develop(radiance, frame, shot or Exposure(self._reference_ms))

    def depth_mm(self, depth: F32, left_image: U8, frame: int, shot: Exposure | None = None) -> np.ndarray:
        """Convert exact depth (H, W) m and the developed left picture to the device's depth, uint16 mm, 0 =
        none."""
        return self._depth.depth_reading(depth, left_image, frame, shot.gain if shot else 1.0)

    # -- IMU ---------------------------------------------------------------------------------

    def imu_errors(self, seconds: float) -> tuple[F64, F64]:
        """Return what noise and bias add to each sample of the gyroscope (N, 3) and accelerometer (M, 3) in
        the device's first `seconds`."""
        gyro, accel = (
            self._with_errors(np.zeros((int(facts.rate_hz * seconds) + 2, 3)), facts, k, limits=False)
            for k, facts in enumerate((self.profile.device.imu.gyro, self.profile.device.imu.accel))
        )
        return gyro, accel

    def imu_streams(self, path: MotionPath, errors: tuple[F64, F64] | None = None) -> ImuStreams:
        """Return all IMU samples within the span of `path`: recorded ones as they are, else simulated. Stamps
        are the device clock's. errors: as from `imu_errors`, where `path` is a piece of a longer one."""
        if path.recorded is not None:
            stamps = self.clock.read(path.recorded.stamps_ns)
            return ImuStreams(stamps, path.recorded.gyro, stamps, path.recorded.accel, self.clock.period_ns)
        facts = self.profile.device.imu
        accel_stream = _GYRO_STREAM if facts.joined else _ACCEL_STREAM
        gyro_ns, gyro = self._sensor_samples(path, facts.gyro, _GYRO_STREAM, 0, errors)
        accel_ns, accel = self._sensor_samples(path, facts.accel, accel_stream, 1, errors)
        return ImuStreams(gyro_ns, gyro, accel_ns, accel, self.clock.period_ns)

    def _sensor_samples(
        self,
        path: MotionPath,
        sensor: InertialFacts,
        stream: int,
        sensor_index: int,
        errors: tuple[F64, F64] | None,
    ) -> tuple[I64, F64]:
        index, true = self._stream(sensor.rate_hz, stream).sample_times(path.start_ns, path.end_ns)
        effects = self.effects
        with_vibration = path.inertial(true)[sensor_index] + self._vibration(true, sensor_index)
        if errors is None:
            values = self._with_errors(with_vibration, sensor, sensor_index, effects.imu_limits)
        else:
            values = with_vibration + errors[sensor_index][index]
            values = saturate_and_quantise(values, sensor) if effects.imu_limits else values
        sigma_ns = effects.imu_jitter_ms * 1e6
        error = clocks.stamp_jitter_ns((*self._seed, _JITTER_STREAM, stream), index, sigma_ns, sensor.rate_hz)
        return self.clock.read(true + error), values

    def _with_errors(self, perfect: F64, sensor: InertialFacts, sensor_index: int, limits: bool) -> F64:
        seed = (*self._seed, _GYRO_STREAM, sensor_index)
        return measured_samples(perfect, sensor, seed, self.effects.imu_noise, self.effects.imu_bias, limits)

    def _vibration(self, times_ns: I64, sensor_index: int) -> F64:
        """Return what vibration and knocks add to gyro (0) or accelerometer (1), (N, 3)."""
        effects, seed = self.effects, (*self._seed, _VIBRATION_STREAM)
        seconds = np.asarray((times_ns - self._origin_ns) * 1e-9, np.float64)
        out = np.zeros((len(seconds), 3))
        if effects.vibration:
            out += vibration_acceleration(seconds, effects.vibration, seed)
        if effects.knocks:
            out += knock_acceleration(seconds, effects.knocks, effects.knock_every_s, seed)
        return out if sensor_index else rotation_rates(out)

    # -- parts -------------------------------------------------------------------------------

    def _stream(self, rate_hz: float, stream: int) -> SampleStream:
        """Return a stream; a free-running one begins within its first period, a triggered one at the
        origin."""
        begin_ns = self._origin_ns
        if stream == _CAMERA_STREAM:
            begin_ns += round(self.effects.camera_phase_ms * 1e6)
        if not self.profile.device.clock.triggered:
            begin_ns += clocks.phase_ns((*self._seed, _PHASE_STREAM, stream), rate_hz)
        return SampleStream(rate_hz, begin_ns)

    @property
    def _reference_ms(self) -> float:
        return self.profile.emulation.camera.reference_ms

    @cached_property
    def _imagers(self) -> list[Imager]:
        effects, model = self.effects, self.profile.emulation.camera
        return [
            Imager(
                camera,
                model,
                (*self._seed, _CAMERA_STREAM, i),
                effects.noise,
                effects.vignetting,
                effects.lens_blur,
            )
            for i, camera in enumerate(self.profile.mode.cameras())
        ]

    @cached_property
    def _depth(self) -> DepthSensor:
        return DepthSensor(self.profile, (*self._seed, _DEPTH_STREAM), self.effects.depth_noise)
