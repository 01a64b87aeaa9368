"""Contents of a firmware profile: the device, its host, and the emulator's error models of the device.

The fields are the keys of the YAML files in firmware_profiles/ (see `share.sensors.profile`). The unit "u" is
rad/s for a gyroscope, m/s^2 for an accelerometer.
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
    """A gyroscope or accelerometer with three equal axes, at one of the rates that it offers.

    density, u/sqrt(Hz), and walk, u/s/sqrt(Hz): white noise and bias random walk (IEEE Std 952, Kalibr's
    model). instability, u, and instability_s: sigma and correlation time of a first-order Gauss-Markov part
    of the bias. start_bias, u: sigma of the bias at power-on. range, u: saturation. step, u: resolution.
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
        """The random walk that grows as fast as this bias over times shorter than instability_s."""
        return float(np.hypot(self.walk, self.instability * np.sqrt(2 / self.instability_s)))


@dataclass(frozen=True)
class ImuFacts:
    """An IMU. joined: one stream with both sensors, sampled together; else two streams with own stamps."""

    model: str
    joined: bool
    gyro: InertialFacts
    accel: InertialFacts

    def __post_init__(self) -> None:
        if self.joined and self.gyro.rate_hz != self.accel.rate_hz:
            raise ValueError("joined: gyro and accel must have the same rate")


@dataclass(frozen=True)
class LensFacts:
    """A lens. intrinsics: fx fy cx cy, px. distortion: empty, k1 k2 p1 p2 [k3] for model radtan, or
    k1 k2 k3 k4 for equidistant."""

    intrinsics: tuple[float, float, float, float]
    distortion: tuple[float, ...] = ()
    model: str = RADTAN


@dataclass(frozen=True)
class CameraMode:
    """One image size of both cameras, and its frame rates."""

    width: int
    height: int
    rates_hz: tuple[float, ...]
    cam0: LensFacts
    cam1: LensFacts

    def __post_init__(self) -> None:
        _check_rates(self.rates_hz)
        self.cameras()

    def cameras(self) -> tuple[Camera, Camera]:
        """Return both cameras. Raises ValueError for an invalid lens."""
        size = (self.width, self.height)
        left, right = (
            Camera(*size, *eye.intrinsics, eye.distortion, eye.model) for eye in (self.cam0, self.cam1)
        )
        return left, right


@dataclass(frozen=True)
class DepthFacts:
    """Depth by stereo matching on the device, in the left camera. step_px: resolution of disparity."""

    range_m: tuple[float, float]
    step_px: float

    def __post_init__(self) -> None:
        _check_positive(self, "step_px")
        if not 0 < self.range_m[0] < self.range_m[1]:
            raise ValueError(f"range_m: {_format_numbers(self.range_m)}: expected 0 < near < far")


@dataclass(frozen=True)
class ClockFacts:
    """The device's clock. tick_ns: resolution. bits: width of the counter, 0: never wraps. triggered: one
    clock triggers all sensors, so images coincide with IMU samples; else each stream runs freely."""

    tick_ns: int
    bits: int = 0
    triggered: bool = False

    def __post_init__(self) -> None:
        _check_positive(self, "tick_ns")
        if not 0 <= self.bits <= 64:
            raise ValueError(f"bits: {self.bits} must lie in 0 .. 64")


@dataclass(frozen=True, eq=False)
class DeviceFacts:
    """The sensor. firmware: versions known to be good; firmware_oldest: older ones are unreliable (both empty
    for a device without firmware). exposure_ms, gain: (min, max). emitter: how the infrared projector is set.
    T_imu_cam0, T_imu_cam1 (4, 4)."""

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
                raise ValueError(f"{name}: {low:g}, {high:g}: expected 0 < min <= max")


@dataclass(frozen=True)
class HostFacts:
    """Settings of the computer at the sensor. cpu_governor: "" = any. usbfs_mb: memory for USB transfers,
    0 = any."""

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
    """Emulated imager at gain 1. full_well_e: electrons at gray level 255. read_e, pixel_offset_e: noise over
    time and over pixels, electrons rms; pixel_gain: relative, rms over pixels. corner_light: brightness in
    the corner relative to the centre. psf_px: sigma of the lens blur. reference_ms: the exposure at which a
    radiance gives the gray level of the same value."""

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
    """Auto exposure. target: mean gray level. delay_frames: from an image to its effect. damping: fraction of
    the error (in stops) corrected at once. step: smallest relative change. longest_ms: longest exposure;
    beyond it the gain rises."""

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
    """Errors of block-matching stereo. sigma_px: disparity noise on rich texture. window_px: side of the
    matching window. hole_snr: gradient over noise at which half of the pixels have no match; hole_spread:
    sigma of that limit. smooth_px: correlation length (blur sigma) of errors. edge_px: displacement of object
    edges."""

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
class EmulatorModel:
    """Properties that data sheets do not state, as the emulator assumes them."""

    camera: CameraModel
    exposure: ExposureModel
    depth: DepthModel | None = None


@dataclass(frozen=True, eq=False)
class Profile:
    """One sensor and its host, at one image size and rate."""

    name: str
    device: DeviceFacts
    host: HostFacts
    emulation: EmulatorModel
    mode: CameraMode
    rate_hz: float

    def rig(self, depth: bool = False) -> Rig:
        """Return the stereo rig (or left image with registered depth) and IMU noise; body = IMU.

        Raises ConfigError if depth is asked of a device without depth."""
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
            raise ConfigError(f"profile '{self.name}': the device has no depth; use stereo, or d435i")
        return replace(base, depth=replace(left, distortion=(), model=RADTAN), T_depth_cam0=np.eye(4))

    @property
    def baseline_m(self) -> float:
        """Distance between the two cameras, m."""
        return float(np.linalg.norm((inverse(self.device.T_imu_cam1) @ self.device.T_imu_cam0)[:3, 3]))


_EMITTERS = ("off", "on", "interleaved", "none")
_GOVERNORS = ("performance", "powersave", "ondemand", "conservative", "schedutil", "userspace")
_MAX_USBFS_MB = 2047  # the kernel's limit
_MAX_RATE_HZ = 10_000.0  # anything above is a mistaken unit


def _check_rates(rates_hz: tuple[float, ...]) -> None:
    if not rates_hz or not all(0 < hz <= _MAX_RATE_HZ for hz in rates_hz):
        raise ValueError(
            f"rates_hz: [{_format_numbers(rates_hz)}]: each must be above 0 and at most {_MAX_RATE_HZ:g} Hz"
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
