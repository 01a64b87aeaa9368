"""What a firmware profile says: what a device is and does, its host, and what the emulator adds.

The fields are the keys of the YAML files in firmware_profiles/ (see `share.sensors.profile`). "u" is rad/s
for a gyroscope and m/s^2 for an accelerometer.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np

from share.errors import ConfigError
from share.geometry.camera import Camera, ImuNoise, Rig
from share.geometry.lens import RADTAN
from share.geometry.se3 import inverse
from share.types import F64


@dataclass(frozen=True)
class InertialFacts:
    """Three alike axes of a gyroscope or an accelerometer, and one of the rates that it offers.

    density u/sqrt(Hz) and walk u/s/sqrt(Hz): white noise and bias random walk (IEEE Std 952, Kalibr's
    model). instability u, instability_s: sigma and correlation time of a first-order Gauss-Markov part
    of the bias. start_bias u: sigma of the bias at switch-on. range u: what saturates; step u: one digit.
    """

    rate_hz: float
    rates_hz: tuple[float, ...]
    range: float
    step: float
    density: float
    walk: float
    start_bias: float
    instability: float = 0.0
    instability_s: float = 100.0

    def __post_init__(self) -> None:
        _check_rates(self.rates_hz)
        _check_positive(self, "rate_hz", "range", "instability_s")
        _check_not_negative(self, "step", "density", "walk", "start_bias", "instability")
        if self.rate_hz not in self.rates_hz:
            raise ValueError(f"rate_hz: {self.rate_hz:g} is not one of {_format_numbers(self.rates_hz)}")

    @property
    def kalibr_walk(self) -> float:
        """The random walk that grows as this bias does over times shorter than instability_s."""
        return float(np.hypot(self.walk, self.instability * np.sqrt(2 / self.instability_s)))


@dataclass(frozen=True)
class ImuFacts:
    """joined: one stream with both sensors, sampled together; else two with stamps of their own."""

    model: str
    joined: bool
    gyro: InertialFacts
    accel: InertialFacts

    def __post_init__(self) -> None:
        if self.joined and self.gyro.rate_hz != self.accel.rate_hz:
            raise ValueError("joined: needs one rate for gyro and accel")


@dataclass(frozen=True)
class LensFacts:
    """intrinsics: fx fy cx cy, px; distortion: none or k1 k2 p1 p2 [k3] of model radtan, k1 k2 k3 k4 of
    equidistant."""

    intrinsics: tuple[float, float, float, float]
    distortion: tuple[float, ...] = ()
    model: str = RADTAN


@dataclass(frozen=True)
class CameraMode:
    """One image size of both cameras, and the rates that it comes at."""

    width: int
    height: int
    rates_hz: tuple[float, ...]
    cam0: LensFacts
    cam1: LensFacts

    def __post_init__(self) -> None:
        _check_rates(self.rates_hz)
        self.cameras()

    def cameras(self) -> tuple[Camera, Camera]:
        """Both cameras. Raises ValueError where a lens is none."""
        size = (self.width, self.height)
        left, right = (
            Camera(*size, *eye.intrinsics, eye.distortion, eye.model) for eye in (self.cam0, self.cam1)
        )
        return left, right


@dataclass(frozen=True)
class DepthFacts:
    """Depth by stereo matching on the device, in the left camera. step_px: smallest step of disparity."""

    range_m: tuple[float, float]
    step_px: float

    def __post_init__(self) -> None:
        _check_positive(self, "step_px")
        if not 0 < self.range_m[0] < self.range_m[1]:
            raise ValueError(f"range_m: {_format_numbers(self.range_m)} is not near < far")


@dataclass(frozen=True)
class ClockFacts:
    """tick_ns: what the device counts in. bits: width of the counter, 0 = does not wrap. triggered: one
    clock starts every sample, so pictures fall on IMU samples; else each stream runs freely."""

    tick_ns: int
    bits: int = 0
    triggered: bool = False

    def __post_init__(self) -> None:
        _check_positive(self, "tick_ns")
        if not 0 <= self.bits <= 64:
            raise ValueError(f"bits: {self.bits} must lie in 0 .. 64")


@dataclass(frozen=True, eq=False)
class DeviceFacts:
    """The sensor itself. firmware: known to be good; firmware_oldest: below it the device is not to be
    trusted (none where there is no such thing). exposure_ms and gain: least and most. emitter: how
    infrared dots are to be set. T_imu_cam0, T_imu_cam1 (4, 4)."""

    model: str
    firmware: tuple[str, ...]
    firmware_oldest: str | None
    emitter: str
    default_mode: str
    modes: tuple[CameraMode, ...]
    T_imu_cam0: F64
    T_imu_cam1: F64
    exposure_ms: tuple[float, float]
    gain: tuple[float, float]
    clock: ClockFacts
    imu: ImuFacts
    depth: DepthFacts | None = None

    def __post_init__(self) -> None:
        if self.emitter not in _EMITTERS:
            raise ValueError(f"emitter: '{self.emitter}' is not one of {', '.join(_EMITTERS)}")
        for text in (*self.firmware, *filter(None, [self.firmware_oldest])):
            if not re.fullmatch(r"\d+(\.\d+)+", text, re.ASCII):
                raise ValueError(f"firmware: '{text}' is not dotted numbers such as 5.16.0.1")
        for name in ("exposure_ms", "gain"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise ValueError(f"{name}: {low:g}, {high:g} is not least and most")


@dataclass(frozen=True)
class HostFacts:
    """How the computer at the sensor is to be set. cpu_governor: "" = leave it. usbfs_mb: memory for USB
    transfers, 0 = leave it."""

    cpu_governor: str
    usb_autosuspend: bool
    usbfs_mb: int

    def __post_init__(self) -> None:
        if self.cpu_governor not in ("", *_GOVERNORS):
            raise ValueError(
                f"cpu_governor: '{self.cpu_governor}' is not one of {', '.join(_GOVERNORS)}, or \"\""
            )
        if not 0 <= self.usbfs_mb <= _MAX_USBFS_MB:
            raise ValueError(f"usbfs_mb: {self.usbfs_mb} must lie in 0 .. {_MAX_USBFS_MB}")


@dataclass(frozen=True)
class CameraModel:
    """Emulated imager at gain 1. full_well_e: electrons at gray level 255. read_e, pixel_offset_e:
    electrons rms, in time and over the pixels; pixel_gain: relative rms over the pixels. corner_light:
    light in the image's corner over that in the middle. psf_px: sigma of the lens's blur.
    reference_ms: the exposure at which a radiance becomes the same gray level."""

    full_well_e: float
    read_e: float
    pixel_offset_e: float
    pixel_gain: float
    corner_light: float
    psf_px: float
    reference_ms: float

    def __post_init__(self) -> None:
        _check_positive(self, "full_well_e", "corner_light", "reference_ms")
        _check_not_negative(self, "read_e", "pixel_offset_e", "pixel_gain", "psf_px")
        if self.corner_light > 1:
            raise ValueError(f"corner_light: {self.corner_light:g} must not exceed 1")


@dataclass(frozen=True)
class ExposureModel:
    """Auto exposure. target: mean gray level. delay_frames: from a picture to what follows from it.
    damping: share of the way (in stops) that is gone at once. step: smallest change, relative.
    longest_ms: it lengthens the exposure so far, then raises the gain."""

    target: float
    delay_frames: int
    damping: float
    step: float
    longest_ms: float

    def __post_init__(self) -> None:
        _check_positive(self, "target", "damping", "step", "longest_ms")
        if not (0 <= self.delay_frames <= 30 and self.damping <= 1 and self.target < 255):
            raise ValueError("delay_frames: 0 .. 30, damping: up to 1, target: below 255")


@dataclass(frozen=True)
class DepthModel:
    """Errors of stereo matching, as block matching has them. sigma_px: of disparity where texture is
    plenty. window_px: side of the matcher's window. hole_snr: gradient over noise at which half of the
    pixels find no match; hole_spread: sigma of that limit. smooth_px: sigma of the blur over which errors
    agree. edge_px: how far edges of things wander."""

    sigma_px: float
    window_px: int
    hole_snr: float
    hole_spread: float
    smooth_px: float
    edge_px: int

    def __post_init__(self) -> None:
        _check_positive(self, "window_px")
        _check_not_negative(self, "sigma_px", "hole_snr", "hole_spread", "smooth_px", "edge_px")


@dataclass(frozen=True)
class Emulation:
    """What a true device has and its maker does not state, as the emulator assumes it."""

    camera: CameraModel
    exposure: ExposureModel
    depth: DepthModel | None = None


@dataclass(frozen=True, eq=False)
class Profile:
    """One sensor and its host, with one image size and rate chosen."""

    name: str
    device: DeviceFacts
    host: HostFacts
    emulation: Emulation
    mode: CameraMode
    rate_hz: float

    def rig(self, depth: bool = False) -> Rig:
        """Stereo (or left image and depth registered to it) and the IMU's noise, body = IMU.

        Raises ConfigError where depth is asked of a device without."""
        left, right = self.mode.cameras()
        imu = self.device.imu
        noise = ImuNoise(
            imu.gyro.density, imu.accel.density, imu.gyro.kalibr_walk, imu.accel.kalibr_walk, imu.gyro.rate_hz
        )
        base = Rig(cam0=left, T_body_cam0=self.device.T_imu_cam0, imu=noise)
        if not depth:
            T_cam1_cam0 = inverse(self.device.T_imu_cam1) @ self.device.T_imu_cam0
            try:
                return replace(base, cam1=right, T_cam1_cam0=T_cam1_cam0)
            except ValueError as error:
                raise ConfigError(f"profile '{self.name}': {error}") from None
        if self.device.depth is None:
            raise ConfigError(f"profile '{self.name}': its device measures no depth; use stereo, or d435i")
        return replace(base, depth=replace(left, distortion=(), model=RADTAN), T_depth_cam0=np.eye(4))

    @property
    def baseline_m(self) -> float:
        """Distance of the two cameras, m."""
        return float(np.linalg.norm((inverse(self.device.T_imu_cam1) @ self.device.T_imu_cam0)[:3, 3]))


_EMITTERS = ("off", "on", "interleaved", "none")
_GOVERNORS = ("performance", "powersave", "ondemand", "conservative", "schedutil", "userspace")
_MAX_USBFS_MB = 2047  # of the kernel


_MAX_RATE_HZ = 10_000.0  # Hz; above it somebody has mistaken the unit


def _check_rates(rates_hz: tuple[float, ...]) -> None:
    if not rates_hz or not all(0 < hz <= _MAX_RATE_HZ for hz in rates_hz):
        raise ValueError(
            f"rates_hz: [{_format_numbers(rates_hz)}] must be rates above 0, up to {_MAX_RATE_HZ:g} Hz"
        )


def _format_numbers(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:g}" for value in values)


def _check_positive(obj: object, *names: str) -> None:
    for name in names:
        if not getattr(obj, name) > 0:
            raise ValueError(f"{name}: {getattr(obj, name)} must be positive")


def _check_not_negative(obj: object, *names: str) -> None:
    for name in names:
        if not getattr(obj, name) >= 0:
            raise ValueError(f"{name}: {getattr(obj, name)} must not be negative")
