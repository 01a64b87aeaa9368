"""The streams of a RealSense: which of the SDK's profiles to open, and the SDK's data in our types: frames as
samples, the factory calibration as a rig with the body in the IMU.

Pixels are copied at once, since the SDK has few buffers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from share.checks import checked_pose
from share.errors import DataError, UsageError
from share.geometry import se3
from share.geometry.camera import Camera, ImuNoise, Rig
from share.geometry.lens import EQUIDISTANT, RADTAN
from share.recordings.images import ArrayImage
from share.sensors.imu_check import ImuRange
from share.sensors.measurement import CAM0, CAM1, DEPTH
from share.sensors.profile_types import InertialFacts, Profile
from share.sensors.sample_processor import ACCEL, GYRO, DeviceSample
from share.types import F32, F64

_RANGE_MARGIN = 1.1  # for the correction of scale and bias
_MIN_IMU_HZ = 100  # slower rates are used only if there is no other
_INTEGER_TOLERANCE = 1e-3  # of the inverse of a depth unit
ProfileMatcher = Callable[[Any], bool]  # whether an SDK stream profile is the requested one


@dataclass(frozen=True)
class StreamRequest:
    """Streams to read, with modes by the firmware profile. right: also the right images (cam1)."""

    profile: Profile
    images: bool = True
    depth: bool = False
    right: bool = True

    def rates_hz(self) -> dict[str, float]:
        """Return the expected rate of each stream; of images half with an interleaved emitter."""
        imu = self.profile.device.imu
        rates = {ACCEL: imu.accel.rate_hz, GYRO: imu.gyro.rate_hz}
        image_hz = self.profile.rate_hz / (2 if self.is_interleaved else 1)
        return rates | {name: self.profile.rate_hz if name == DEPTH else image_hz for name in self.cameras}

    def imu_range(self) -> ImuRange:
        """Return the range of valid IMU samples: the sensor's, with a margin for scale and bias
        corrections."""
        imu = self.profile.device.imu
        return ImuRange(_RANGE_MARGIN * imu.gyro.range, _RANGE_MARGIN * imu.accel.range)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the image streams."""
        options = ((CAM0, self.images), (CAM1, self.images and self.right), (DEPTH, self.depth))
        return tuple(name for name, is_requested in options if is_requested)

    @property
    def is_interleaved(self) -> bool:
        """Whether every other image has dots."""
        return self.profile.device.emitter == "interleaved"


@dataclass(frozen=True, eq=False)
class OpenedSensor:
    """A sensor of a device and its requested stream profiles, by our stream names."""

    sensor: Any
    profiles: dict[str, Any]


def choose_streams(rs: Any, device: Any, request: StreamRequest) -> list[OpenedSensor]:
    """Return sensors and profiles for all requested streams. Raises UsageError that lists missing ones."""
    missing = {name: _matchers(rs, name, request) for name in request.rates_hz()}
    out = []
    for sensor in device.query_sensors():
        matched, offered = {}, sensor.get_stream_profiles()
        for name, (matchers, _) in list(missing.items()):
            profile = next((p for fits in matchers for p in offered if fits(p)), None)
            if profile is not None:
                matched[name] = profile
                del missing[name]
        if matched:
            out.append(OpenedSensor(sensor, matched))
    if missing:
        lacking = ", ".join(f"{name} ({what})" for name, (_, what) in missing.items())
        modes = ", ".join(_infrared_modes(rs, device)) or "none"
        raise UsageError(
            f"the camera does not offer {lacking}; choose another --mode or --profile; infrared has {modes}"
        )
    return out


def _infrared_modes(rs: Any, device: Any) -> list[str]:
    """Return the modes of the left infrared camera, in the form of --mode."""
    modes = set()
    for p in (p for sensor in device.query_sensors() for p in sensor.get_stream_profiles()):
        if (p.stream_type(), p.stream_index(), p.format()) == (rs.stream.infrared, 1, rs.format.y8):
            video = p.as_video_stream_profile()
            modes.add((video.width(), video.height(), p.fps()))
    return [f"{width}x{height}@{hz}" for width, height, hz in sorted(modes)]


def stream_rates_hz(sensors: list[OpenedSensor], request: StreamRequest) -> dict[str, float]:
    """Return the actual rate of each stream: an IMU's may differ from the profile's."""
    inertial = {
        name: float(profile.fps())
        for one in sensors
        for name, profile in one.profiles.items()
        if name in (ACCEL, GYRO)
    }
    return request.rates_hz() | inertial


def preferred_hz(facts: InertialFacts) -> list[float]:
    """Return an IMU's rates, best first: the stated one, then the nearest sufficient ones, then the
    others."""
    return sorted(
        facts.rates_hz, key=lambda hz: (hz != facts.rate_hz, hz < _MIN_IMU_HZ, abs(hz - facts.rate_hz))
    )


def _matchers(rs: Any, name: str, request: StreamRequest) -> tuple[list[ProfileMatcher], str]:
    """Return matchers of the stream's profile, best first, and their description."""
    imu = request.profile.device.imu
    if name in (ACCEL, GYRO):
        kind, facts = (rs.stream.accel, imu.accel) if name == ACCEL else (rs.stream.gyro, imu.gyro)
        rates = preferred_hz(facts)
        return [_motion_matcher(kind, hz) for hz in rates], f"{' or '.join(f'{hz:g}' for hz in rates)} Hz"
    stream = {CAM0: (rs.stream.infrared, 1), CAM1: (rs.stream.infrared, 2), DEPTH: (rs.stream.depth, 0)}[name]
    form = rs.format.z16 if name == DEPTH else rs.format.y8
    mode, hz = request.profile.mode, request.profile.rate_hz

    def fits(p: Any) -> bool:
        if (p.stream_type(), p.stream_index(), p.format(), p.fps()) != (*stream, form, hz):
            return False
        video = p.as_video_stream_profile()
        return bool((video.width(), video.height()) == (mode.width, mode.height))

    return [fits], f"{mode.width}x{mode.height}@{hz:g}"


def _motion_matcher(kind: Any, hz: float) -> ProfileMatcher:
    return lambda p: bool(p.stream_type() == kind and abs(p.fps() - hz) <= 1)


# ---- Frames as samples


def to_sample(rs: Any, frame: Any, depth_unit_m: float, arrived_ns: int, epoch: int) -> DeviceSample:
    """Return a sample: an image, a depth map (m) or three IMU values, with the device's stamp in whole µs."""
    stream = _stream_name(rs, frame.profile)
    motion = stream in (ACCEL, GYRO)
    return DeviceSample(
        stream=stream,
        stamp_ns=round(frame.timestamp * 1e3) * 1000,
        payload=_motion_values(frame) if motion else ArrayImage(_pixels(frame, stream, depth_unit_m)),
        arrived_ns=arrived_ns,
        number=None if motion else int(frame.frame_number),  # the IMU's two streams may share a counter
        is_device_clock=frame.frame_timestamp_domain == rs.timestamp_domain.hardware_clock,
        epoch=epoch,
    )


def has_dots(rs: Any, frame: Any) -> bool | None:
    """Return whether the emitter was on; None if the frame lacks the metadata."""
    metadata = rs.frame_metadata_value
    # Not the laser power, which is only a setting.
    for kind in (metadata.frame_emitter_mode, metadata.frame_laser_power_mode):
        if frame.supports_frame_metadata(kind):
            return bool(frame.get_frame_metadata(kind))
    return None


def _stream_name(rs: Any, profile: Any) -> str:
    kind = profile.stream_type()
    if kind == rs.stream.infrared:
        return CAM0 if profile.stream_index() == 1 else CAM1
    return {rs.stream.depth: DEPTH, rs.stream.accel: ACCEL, rs.stream.gyro: GYRO}[kind]


def _motion_values(frame: Any) -> list[float]:
    motion = frame.as_motion_frame().get_motion_data()
    return [motion.x, motion.y, motion.z]


def _pixels(frame: Any, stream: str, depth_unit_m: float) -> NDArray[Any]:
    pixels = np.asarray(frame.get_data())
    return scale_depth(pixels, depth_unit_m) if stream == DEPTH else pixels.copy()


def scale_depth(steps: NDArray[np.uint16], unit_m: float) -> F32:
    """Return depth (H, W) in m. The SDK gives the unit in single precision. A unit near 1/n m is taken as
    exactly that, by division, so that whole millimetres are exact to the last bit."""
    n = round(1 / unit_m)
    if n and abs(1 / unit_m - n) < _INTEGER_TOLERANCE:
        return np.asarray(steps / np.float32(n))
    return np.asarray(steps * np.float32(unit_m))


# ---- The factory calibration


def factory_rig(rs: Any, profiles: dict[str, Any], noise: ImuNoise | None) -> Rig:
    """Return the rig. profiles: SDK stream profiles of cam0 and, if read, of cam1, depth and gyro, by stream.

    noise: of the IMU; the factory gives none. Raises DataError for an unknown lens model or invalid values.
    """
    cam0 = profiles[CAM0]
    try:
        rig: dict[str, Any] = {"cam0": read_camera(rs, cam0), "T_body_cam0": np.eye(4)}
        for name in (CAM1, DEPTH):
            if name in profiles:
                rig |= {name: read_camera(rs, profiles[name])}
                rig |= {f"T_{name}_cam0": read_extrinsics(cam0, profiles[name])}
        if GYRO in profiles and noise is not None:
            rig |= {"imu": noise, "T_body_cam0": read_extrinsics(cam0, profiles[GYRO])}
        return Rig(**rig)
    except ValueError as error:
        raise DataError(f"the camera's factory calibration: {error}") from None


def read_extrinsics(source: Any, target: Any) -> F64:
    """Return T_target_source (4, 4) of two stream profiles. The SDK's rotation is column-major."""
    extrinsics = source.get_extrinsics_to(target)
    T = np.eye(4)
    T[:3, :3] = np.reshape(extrinsics.rotation, (3, 3), order="F")
    T[:3, 3] = extrinsics.translation
    return se3.orthonormal(checked_pose("extrinsics", T))  # the SDK's single precision is rigid to 1e-7 only


def read_camera(rs: Any, profile: Any) -> Camera:
    """Return the intrinsics of a video stream profile. Raises ValueError for an unknown distortion model."""
    found = profile.as_video_stream_profile().get_intrinsics()
    distortion, model = tuple(float(c) for c in found.coeffs), RADTAN
    if found.model == rs.distortion.kannala_brandt4:  # T265; the fifth coefficient is 0
        distortion, model = distortion[:4], EQUIDISTANT
    elif not any(distortion):
        distortion = ()
    elif found.model != rs.distortion.brown_conrady:
        raise ValueError(f"distortion model {found.model} is unknown; calibrate it: `share calibrate camera`")
    return Camera(found.width, found.height, found.fx, found.fy, found.ppx, found.ppy, distortion, model)
