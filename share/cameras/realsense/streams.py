"""Which of a device's stream profiles are opened."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from share.errors import UsageError
from share.sensors.imu_check import ImuRange
from share.sensors.measurement import CAM0, CAM1, DEPTH
from share.sensors.profile_types import InertialFacts, Profile
from share.sensors.sample_processor import ACCEL, GYRO

_RANGE_MARGIN = 1.1
_MIN_IMU_HZ = 100  # of an IMU; slower ones are taken only where there is nothing else
ProfileMatcher = Callable[[Any], bool]  # whether a profile of the SDK is the one


@dataclass(frozen=True)
class StreamRequest:
    """What to read: images, depth, IMU, as the firmware profile says. right: the other eye's images too."""

    profile: Profile
    images: bool = True
    depth: bool = False
    right: bool = True

    def rates_hz(self) -> dict[str, float]:
        """Expected rate of every stream. Of images with an interleaved emitter, every other one is used."""
        imu = self.profile.device.imu
        rates = {ACCEL: imu.accel.rate_hz, GYRO: imu.gyro.rate_hz}
        image_hz = self.profile.rate_hz / (2 if self.is_interleaved else 1)
        return rates | {name: self.profile.rate_hz if name == DEPTH else image_hz for name in self.cameras}

    def imu_range(self) -> ImuRange:
        """Beyond what the sensor shows where it saturates, by as much as its scale and bias are corrected."""
        imu = self.profile.device.imu
        return ImuRange(_RANGE_MARGIN * imu.gyro.range, _RANGE_MARGIN * imu.accel.range)

    @property
    def cameras(self) -> tuple[str, ...]:
        """The streams of images."""
        options = ((CAM0, self.images), (CAM1, self.images and self.right), (DEPTH, self.depth))
        return tuple(name for name, is_requested in options if is_requested)

    @property
    def is_interleaved(self) -> bool:
        """Whether the dots are on in every other image."""
        return self.profile.device.emitter == "interleaved"


@dataclass(frozen=True, eq=False)
class OpenedSensor:
    """One sensor of a device and those of its profiles that are wanted, by our name of the stream."""

    sensor: Any
    profiles: dict[str, Any]


def choose_streams(rs: Any, device: Any, request: StreamRequest) -> list[OpenedSensor]:
    """Sensors and profiles for all that is wanted. Raises UsageError naming what the device lacks."""
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
    """Of the left eye, as --mode takes them."""
    modes = set()
    for p in (p for sensor in device.query_sensors() for p in sensor.get_stream_profiles()):
        if (p.stream_type(), p.stream_index(), p.format()) == (rs.stream.infrared, 1, rs.format.y8):
            video = p.as_video_stream_profile()
            modes.add((video.width(), video.height(), p.fps()))
    return [f"{width}x{height}@{hz}" for width, height, hz in sorted(modes)]


def stream_rates_hz(sensors: list[OpenedSensor], request: StreamRequest) -> dict[str, float]:
    """Of every stream as it comes: an IMU may have other rates than the profile states."""
    inertial = {
        name: float(profile.fps())
        for one in sensors
        for name, profile in one.profiles.items()
        if name in (ACCEL, GYRO)
    }
    return request.rates_hz() | inertial


def preferred_hz(facts: InertialFacts) -> list[float]:
    """An IMU's rates, best first: as stated, then the nearest of those that are enough, then the others."""
    return sorted(
        facts.rates_hz, key=lambda hz: (hz != facts.rate_hz, hz < _MIN_IMU_HZ, abs(hz - facts.rate_hz))
    )


def _matchers(rs: Any, name: str, request: StreamRequest) -> tuple[list[ProfileMatcher], str]:
    """What knows the stream's profile, the best first, and words for it."""
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
