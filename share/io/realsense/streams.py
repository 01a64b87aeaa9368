"""Which of a device's stream profiles are opened."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from share.core.intake import ACCEL, GYRO
from share.core.measurement import CAM0, CAM1, DEPTH
from share.errors import UsageError
from share.io.profile_types import Profile


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
    missing = {name: _matcher(rs, name, wanted) for name in wanted.rates_hz()}
    out = []
    for sensor in device.query_sensors():
        found = {}
        for name, (fits, _) in list(missing.items()):
            profile = next((p for p in sensor.get_stream_profiles() if fits(p)), None)
            if profile is not None:
                found[name] = profile
                del missing[name]
        if found:
            out.append(Opened(sensor, found))
    if missing:
        told = ", ".join(f"{name} ({what})" for name, (_, what) in missing.items())
        raise UsageError(f"the camera does not offer {told}; choose another mode or another --profile")
    return out


def _matcher(rs: Any, name: str, wanted: Wanted) -> tuple[Any, str]:
    """What knows the stream's profile, and words for it."""
    imu = wanted.profile.device.imu
    if name in (ACCEL, GYRO):
        kind, hz = (
            (rs.stream.accel, imu.accel.rate_hz) if name == ACCEL else (rs.stream.gyro, imu.gyro.rate_hz)
        )
        return lambda p: p.stream_type() == kind and abs(p.fps() - hz) <= 1, f"{hz:g} Hz"
    stream = {CAM0: (rs.stream.infrared, 1), CAM1: (rs.stream.infrared, 2), DEPTH: (rs.stream.depth, 0)}[name]
    form = rs.format.z16 if name == DEPTH else rs.format.y8
    mode, hz = wanted.profile.mode, wanted.profile.rate_hz

    def fits(p: Any) -> bool:
        if (p.stream_type(), p.stream_index(), p.format(), p.fps()) != (*stream, form, hz):
            return False
        video = p.as_video_stream_profile()
        return bool((video.width(), video.height()) == (mode.width, mode.height))

    return fits, f"{mode.width}x{mode.height}@{hz:g}"
