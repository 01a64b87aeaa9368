"""Check a camera-IMU calibration: does it pass, and if not, what to do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.lab.calibrate import corners
from share.lab.calibrate.camera_imu.fit import CameraImuFit
from share.lab.calibrate.camera_imu.problem import conservative_rms
from share.types import F64

_STANDARD_GRAVITY = 9.80665
_NEAR_DEG = 1.0  # one unit of distance between two mountings
_NEAR_MM = 5.0  # likewise
_FAR_UNITS = 4.0  # more is reported


@dataclass(frozen=True)
class CameraImuLimits:
    """Limits to pass. rms_px: of inlier corners. outlier_share: of corners. imu_noise_ratio: residuals
    over stated noise. gravity, m/s^2: error of its norm. rotation_rate_rms rad/s, acceleration_rms m/s^2:
    at least, about and along the least excited axis. The rest: sigmas of the result."""

    rms_px: float = 1.0
    outlier_share: float = 0.05
    imu_noise_ratio: float = 10.0
    gravity: float = 0.15
    rotation_rate_rms: float = 0.15
    acceleration_rms: float = 0.2
    rotation_deg: float = 0.05
    position_mm: float = 1.0
    shift_ms: float = 0.1


@dataclass(frozen=True, eq=False)
class CameraImuVerdict:
    """reasons: of a failure, empty if it passes. rms_px and outlier corners of each camera.
    rotation_rate_rms (3,) rad/s, acceleration_rms (3,) m/s^2: by principal axes, largest first. Noise
    ratios: residuals' `conservative_rms` over stated noise."""

    reasons: tuple[str, ...]
    rms_px: tuple[float, ...]
    outlier_corners: tuple[int, ...]
    rotation_rate_rms: F64
    acceleration_rms: F64
    gyro_noise_ratio: float
    accel_noise_ratio: float

    @property
    def passed(self) -> bool:
        return not self.reasons


def judge_camera_imu(fit: CameraImuFit, limits: CameraImuLimits = CameraImuLimits()) -> CameraImuVerdict:
    """Check a fit against the limits."""
    inliers = [corners.inlier_mask(r, fit.sigmas.px) for r in fit.corners]
    rms = tuple(corners.rms(r[k]) for r, k in zip(fit.corners, inliers, strict=True))
    outliers = tuple(int((~k).sum()) for k in inliers)
    gyro = conservative_rms(fit.imu.stamps_ns, fit.gyro) / fit.stated_sigmas.gyro
    accel = conservative_rms(fit.imu.stamps_ns, fit.accel) / fit.stated_sigmas.accel
    rotation_rms, acceleration_rms = _excitation(fit)
    reasons = [
        *_corner_failures(fit, rms, limits),
        *_motion_failures(rotation_rms, acceleration_rms, limits),
        *_imu_failures(gyro, accel, fit.state.gravity, limits),
        *_sigma_failures(fit, limits),
    ]
    return CameraImuVerdict(tuple(reasons), rms, outliers, rotation_rms, acceleration_rms, gyro, accel)


def _excitation(fit: CameraImuFit) -> tuple[F64, F64]:
    curve, at = fit.state.curve, fit.state.curve.locate(fit.imu.stamps_ns)
    rates, accelerations = curve.rotation(at).rate, curve.position(at, 2)[0]
    turning, moving = (np.linalg.svd(x, compute_uv=False) / np.sqrt(len(x)) for x in (rates, accelerations))
    return turning, moving


def _corner_failures(fit: CameraImuFit, rms: tuple[float, ...], limits: CameraImuLimits) -> list[str]:
    out = []
    for cam, residuals in enumerate(fit.corners):
        if len(residuals) and not rms[cam] <= limits.rms_px:
            out.append(
                f"cam{cam}: {rms[cam]:.2f} px RMS, at most {limits.rms_px:g} allowed: are the images "
                "blurred, or --target or the intrinsics wrong?"
            )
        unfit = corners.count_outliers(residuals, fit.sigmas.px, limits.rms_px)
        if unfit > limits.outlier_share * len(residuals):
            out.append(
                f"cam{cam}: {unfit} of {len(residuals)} corners do not fit within {limits.rms_px:g} px, at "
                f"most {limits.outlier_share:.0%} allowed"
            )
    return out


def _motion_failures(turning: F64, moving: F64, limits: CameraImuLimits) -> list[str]:
    out = []
    if turning[2] < limits.rotation_rate_rms:
        out.append(
            f"turned by {turning[2]:.2f} rad/s rms about one axis, {limits.rotation_rate_rms:g} needed "
            "about each: nod, roll and look around"
        )
    if moving[2] < limits.acceleration_rms:
        out.append(
            f"accelerated by {moving[2]:.2f} m/s^2 rms along one axis, {limits.acceleration_rms:g} needed "
            "along each: move to and fro, up and down, near and far"
        )
    return out


def _imu_failures(gyro: float, accel: float, gravity: F64, limits: CameraImuLimits) -> list[str]:
    out = [
        f"{name}: residuals are {times:.1f} times the stated noise, at most {limits.imu_noise_ratio:g} "
        "allowed: is --imu of this device, the IMU fixed to the cameras, the board's size as in --target?"
        for name, times in (("gyroscope", gyro), ("accelerometer", accel))
        if not times <= limits.imu_noise_ratio
    ]
    deviation = float(np.linalg.norm(gravity)) - _STANDARD_GRAVITY
    if not abs(deviation) <= limits.gravity:
        out.append(
            f"gravity differs by {deviation:+.2f} m/s^2 from {_STANDARD_GRAVITY:g}, at most "
            f"{limits.gravity:g} allowed: check the accelerometer's scale and units"
        )
    return out


def _sigma_failures(fit: CameraImuFit, limits: CameraImuLimits) -> list[str]:
    total_sigmas = largest_sigmas(fit.axis_sigmas(fit.covariance))
    noise_sigmas = largest_sigmas(fit.axis_sigmas(fit.by_noise))
    names = (
        ("rotation", limits.rotation_deg, "deg"),
        ("position", limits.position_mm, "mm"),
        ("time offset", limits.shift_ms, "ms"),
    )
    return [
        f"{name} known to {sigma:.3g} {unit} (one sigma), {limit:g} needed: "
        + ("record longer, turn quicker" if alone**2 > sigma**2 / 2 else "calibrate the cameras better first")
        for (name, limit, unit), sigma, alone in zip(names, total_sigmas, noise_sigmas, strict=True)
        if not sigma <= limit
    ]


def largest_sigmas(sigmas: F64) -> tuple[float, float, float]:
    """Return the largest of seven sigmas: deg, mm, ms."""
    return float(np.degrees(sigmas[:3]).max()), 1e3 * float(sigmas[3:6].max()), 1e3 * float(sigmas[6])


@dataclass(frozen=True)
class MountingComparison:
    """Difference of the estimated extrinsics from the given ones. inverted: the inverse of the given ones
    matches."""

    turned_deg: float
    shifted_mm: float
    inverted: bool

    @property
    def is_far(self) -> bool:
        return _distance_units(self.turned_deg, self.shifted_mm) > _FAR_UNITS


def compare_mountings(T_imu_cam0: F64, other: F64) -> MountingComparison:
    """Compare the estimated T_imu_cam0 (4, 4) with that of a file."""
    straight, inverse = _difference(T_imu_cam0, other), _difference(T_imu_cam0, se3.inverse(other))
    inverted = _distance_units(*straight) > 1 and _distance_units(*inverse) < min(
        _FAR_UNITS, _distance_units(*straight) / 3
    )
    return MountingComparison(*straight, inverted)


def _difference(T: F64, other: F64) -> tuple[float, float]:
    """Return the difference, deg and mm."""
    distance = np.linalg.norm(T[:3, 3] - other[:3, 3])
    return float(np.degrees(se3.rotation_angle(T[:3, :3].T @ other[:3, :3]))), 1e3 * float(distance)


def _distance_units(turned_deg: float, shifted_mm: float) -> float:
    return turned_deg / _NEAR_DEG + shifted_mm / _NEAR_MM
