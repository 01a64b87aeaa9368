"""Whether a calibration of cameras and IMU may be believed, and what to do where not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.lab.calibrate import corners
from share.lab.calibrate.camera_imu.fit import CameraImuFit
from share.lab.calibrate.camera_imu.problem import conservative_rms
from share.types import F64

_STANDARD_GRAVITY = 9.80665
_NEAR_DEG, _NEAR_MM = 1.0, 5.0  # as one unit of distance between two mountings
_FAR_UNITS = 4.0  # of these: worth a word


@dataclass(frozen=True)
class CameraImuLimits:
    """What passes. rms_px: of corners kept; wrong: share of those not; imu: residuals over stated noise;
    gravity m/s^2: off the standard; turning rad/s, moving m/s^2: rms about and along the least moved axis;
    the rest: one sigma of the result."""

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
    """reasons: what fails, none where it passes. rms_px and wrong corners of each camera; turning (3,) rad/s
    and moving (3,) m/s^2: rms by principal axes, largest first; gyro, accel: residuals, the rms of all or
    of slow ones, over stated."""

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
    """Of a fit."""
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
                f"cam{cam}: {rms[cam]:.2f} px RMS, at most {limits.rms_px:g}: blur, or --target or "
                "intrinsics of something else"
            )
        unfit = corners.count_outliers(residuals, fit.sigmas.px, limits.rms_px)
        if unfit > limits.outlier_share * len(residuals):
            out.append(
                f"cam{cam}: {unfit} of {len(residuals)} corners do not fit within {limits.rms_px:g} px, at "
                f"most {limits.outlier_share:.0%}"
            )
    return out


def _motion_failures(turning: F64, moving: F64, limits: CameraImuLimits) -> list[str]:
    out = []
    if turning[2] < limits.rotation_rate_rms:
        out.append(
            f"turned by {turning[2]:.2f} "
            f"rad/s rms about one axis, "
            f"{limits.rotation_rate_rms:g} needed about each: "
            "nod, roll and look around"
        )
    if moving[2] < limits.acceleration_rms:
        out.append(
            f"accelerated by {moving[2]:.2f} m/s^2 rms along one "
            f"axis, {limits.acceleration_rms:g} "
            f"needed along each: "
            "move to and fro, up and down, near and far"
        )
    return out


def _imu_failures(gyro: float, accel: float, gravity: F64, limits: CameraImuLimits) -> list[str]:
    out = [
        f"{name}'s residuals are {times:.1f} times its stated "
        f"noise, at most "
        f"{limits.imu_noise_ratio:g}: is --imu of "
        "this device, the IMU fixed to the cameras, the board as large as --target says?"
        for name, times in (("gyroscope", gyro), ("accelerometer", accel))
        if not times <= limits.imu_noise_ratio
    ]
    deviation = float(np.linalg.norm(gravity)) - _STANDARD_GRAVITY
    if not abs(deviation) <= limits.gravity:
        out.append(
            f"gravity comes out {deviation:+.2f} m/s^2 off "
            f"{_STANDARD_GRAVITY:g}, at "
            f"most {limits.gravity:g}: "
            "the accelerometer's scale, or its units"
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
    """The largest of seven sigmas: deg, mm, ms."""
    return float(np.degrees(sigmas[:3]).max()), 1e3 * float(sigmas[3:6].max()), 1e3 * float(sigmas[6])


@dataclass(frozen=True)
class MountingComparison:
    """How far found mounting and given one are apart; inverted: the inverse of the given one is what was
    found."""

    turned_deg: float
    shifted_mm: float
    inverted: bool

    @property
    def is_far(self) -> bool:
        return _distance_units(self.turned_deg, self.shifted_mm) > _FAR_UNITS


def compare_mountings(T_imu_cam0: F64, other: F64) -> MountingComparison:
    """The mounting that was found with T_imu_cam0 (4, 4) as a file has it."""
    straight, inverse = _difference(T_imu_cam0, other), _difference(T_imu_cam0, se3.inverse(other))
    inverted = _distance_units(*straight) > 1 and _distance_units(*inverse) < min(
        _FAR_UNITS, _distance_units(*straight) / 3
    )
    return MountingComparison(*straight, inverted)


def _difference(T: F64, other: F64) -> tuple[float, float]:
    """deg, mm."""
    distance = np.linalg.norm(T[:3, 3] - other[:3, 3])
    return float(np.degrees(se3.rotation_angle(T[:3, :3].T @ other[:3, :3]))), 1e3 * float(distance)


def _distance_units(turned_deg: float, shifted_mm: float) -> float:
    return turned_deg / _NEAR_DEG + shifted_mm / _NEAR_MM
