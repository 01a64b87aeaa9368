"""Which of a device's stream profiles are opened."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from share.errors import UsageError
from share.sensors.imu_check import ImuRange
from share.sensors.intake import ACCEL, GYRO
from share.sensors.measurement import CAM0, CAM1, DEPTH
from share.sensors.profile_types import Inertial, Profile

_SCALE = 1.1
_ENOUGH_HZ = 100  # of an IMU; slower ones are taken only where there is nothing else
Fits = Callable[[Any], bool]  # whether a profile of the SDK is the one


@dataclass(frozen=True)
class Wanted:
    """What to read: images, depth, IMU, as the firmware profile says. right: the other eye's images too."""

    profile: Profile
    images: bool = True
    depth: bool = False
    right: bool = True

    def rates_hz(self) -> dict[str, float]:
        """Expected rate of every stream. Of images with an interleaved emitter, every other one is used."""
        imu = self.profile.device.imu
        rates = {ACCEL: imu.accel.rate_hz, GYRO: imu.gyro.rate_hz}
        image_hz = self.profile.rate_hz / (2 if self.interleaved else 1)
        return rates | {name: self.profile.rate_hz if name == DEPTH else image_hz for name in self.cameras}

    def imu_range(self) -> ImuRange:
        """Beyond what the sensor shows where it saturates, by as much as its scale and bias are corrected."""
        imu = self.profile.device.imu
        return ImuRange(_SCALE * imu.gyro.range, _SCALE * imu.accel.range)

    @property
    def cameras(self) -> tuple[str, ...]:
        """The streams of images."""
        have = ((CAM0, self.images), (CAM1, self.images and self.right), (DEPTH, self.depth))
        return tuple(name for name, wanted in have if wanted)

    @property
    def interleaved(self) -> bool:
        """Whether the dots are on in every other image."""
        return self.profile.device.emitter == "interleaved"


@dataclass(frozen=True, eq=False)
class Opened:
    """One sensor of a device and those of its profiles that are wanted, by our name of the stream."""

    sensor: Any
    profiles: dict[str, Any]


def choose_streams(rs: Any, device: Any, wanted: Wanted) -> list[Opened]:
    """Sensors and profiles for all that is wanted. Raises UsageError naming what the device lacks."""
    missing = {name: _matchers(rs, name, wanted) for name in wanted.rates_hz()}
    out = []
    for sensor in device.query_sensors():
        found, offered = {}, sensor.get_stream_profiles()
        for name, (matchers, _) in list(missing.items()):
            profile = next((p for fits in matchers for p in offered if fits(p)), None)
            if profile is not None:
                found[name] = profile
                del missing[name]
        if found:
            out.append(Opened(sensor, found))
    if missing:
        told = ", ".join(f"{name} ({what})" for name, (_, what) in missing.items())
        modes = ", ".join(_modes(rs, device)) or "none"
        raise UsageError(
            f"the camera does not offer {told}; choose another --mode or --profile; infrared has {modes}"
        )
    return out


def _modes(rs: Any, device: Any) -> list[str]:
    """Of the left eye, as --mode takes them."""
    found = set()
    for p in (p for sensor in device.query_sensors() for p in sensor.get_stream_profiles()):
        if (p.stream_type(), p.stream_index(), p.format()) == (rs.stream.infrared, 1, rs.format.y8):
            video = p.as_video_stream_profile()
            found.add((video.width(), video.height(), p.fps()))
    return [f"{width}x{height}@{hz}" for width, height, hz in sorted(found)]


def rates_hz(opened: list[Opened], wanted: Wanted) -> dict[str, float]:
    """Of every stream as it comes: an IMU may have other rates than the profile states."""
    inertial = {
        name: float(profile.fps())
        for one in opened
        for name, profile in one.profiles.items()
        if name in (ACCEL, GYRO)
    }
    return wanted.rates_hz() | inertial


def preferred_hz(facts: Inertial) -> list[float]:
    """An IMU's rates, best first: as stated, then the nearest of those that are enough, then the others."""
    return sorted(
        facts.rates_hz, key=lambda hz: (hz != facts.rate_hz, hz < _ENOUGH_HZ, abs(hz - facts.rate_hz))
    )


def _matchers(rs: Any, name: str, wanted: Wanted) -> tuple[list[Fits], str]:
    """What knows the stream's profile, the best first, and words for it."""
    imu = wanted.profile.device.imu
    if name in (ACCEL, GYRO):
        kind, facts = (rs.stream.accel, imu.accel) if name == ACCEL else (rs.stream.gyro, imu.gyro)
        rates = preferred_hz(facts)
        return [_motion(kind, hz) for hz in rates], f"{' or '.join(f'{hz:g}' for hz in rates)} Hz"
    stream = {CAM0: (rs.stream.infrared, 1), CAM1: (rs.stream.infrared, 2), DEPTH: (rs.stream.depth, 0)}[name]
    form = rs.format.z16 if name == DEPTH else rs.format.y8
    mode, hz = wanted.profile.mode, wanted.profile.rate_hz

    def fits(p: Any) -> bool:
        if (p.stream_type(), p.stream_index(), p.format(), p.fps()) != (*stream, form, hz):
            return False
        video = p.as_video_stream_profile()
        return bool((video.width(), video.height()) == (mode.width, mode.height))

    return [fits], f"{mode.width}x{mode.height}@{hz:g}"


def _motion(kind: Any, hz: float) -> Fits:
    return lambda p: bool(p.stream_type() == kind and abs(p.fps() - hz) <= 1)
