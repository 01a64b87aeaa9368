"""Choice of the stream profiles of a RealSense to open."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from share.errors import UsageError
from share.sensors.imu_check import ImuRange
from share.sensors.measurement import CAM0, CAM1, DEPTH
from share.sensors.profile_types import InertialFacts, Profile
from share.sensors.sample_processor import ACCEL, GYRO

_RANGE_MARGIN = 1.1  # for the correction of scale and bias
_MIN_IMU_HZ = 100  # slower rates are used only if there is no other
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
