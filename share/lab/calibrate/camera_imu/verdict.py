"""Check a camera-IMU calibration: does it pass, and if not, what to do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.lab.calibrate import corners
from share.lab.calibrate.camera_imu.fit import CameraImuFit
from share.lab.calibrate.camera_imu.problem import conservative_rms
from share.lab.calibrate.imu import STANDARD_GRAVITY
from share.lab.calibrate.report import corner_failures
from share.types import F64

_NEAR_DEG = 1.0  # one unit of distance between two mountings
_NEAR_MM = 5.0  # likewise
_FAR_UNITS = 4.0  # more is reported


# Limits to pass.
MAX_RMS_PX = 1.0  # of inlier corners
MAX_NOISE_RATIO = 10.0  # residuals over stated noise
MAX_GRAVITY_ERROR = 0.15  # m/s^2, of its norm
MIN_ROTATION_RATE = 0.15  # rad/s rms about the least excited axis
MIN_ACCELERATION = 0.2  # m/s^2 rms along the least excited axis
MAX_SIGMAS = (("rotation", 0.05, "deg"), ("position", 1.0, "mm"), ("time offset", 0.1, "ms"))


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


def judge_camera_imu(fit: CameraImuFit) -> CameraImuVerdict:
    """Check a fit against the limits."""
    inliers = [corners.inlier_mask(r, fit.sigmas.px) for r in fit.corners]
    gyro = conservative_rms(fit.imu.stamps_ns, fit.gyro) / fit.stated_sigmas.gyro
    accel = conservative_rms(fit.imu.stamps_ns, fit.accel) / fit.stated_sigmas.accel
    rotation_rms, acceleration_rms = _excitation(fit)
    hint = "are the images blurred, or --target or the intrinsics wrong?"
    reasons = [
        *(
            reason
            for cam, r in enumerate(fit.corners)
            for reason in corner_failures(cam, r, fit.sigmas.px, MAX_RMS_PX, hint)
        ),
        *_motion_failures(rotation_rms[2], acceleration_rms[2]),
        *_imu_failures(gyro, accel, fit.state.gravity),
        *_sigma_failures(fit),
    ]
    return CameraImuVerdict(
        reasons=tuple(reasons),
        rms_px=tuple(corners.rms(r[k]) for r, k in zip(fit.corners, inliers, strict=True)),
        outlier_corners=tuple(int((~k).sum()) for k in inliers),
        rotation_rate_rms=rotation_rms,
        acceleration_rms=acceleration_rms,
        gyro_noise_ratio=gyro,
        accel_noise_ratio=accel,
    )


def _excitation(fit: CameraImuFit) -> tuple[F64, F64]:
    curve, at = fit.state.curve, fit.state.curve.locate(fit.imu.stamps_ns)
    rates, accelerations = curve.rotation(at).rate, curve.position(at, 2)[0]
    by_rates, by_accelerations = (
        np.linalg.svd(x, compute_uv=False) / np.sqrt(len(x)) for x in (rates, accelerations)
    )
    return by_rates, by_accelerations


def _motion_failures(rotation_rate: float, acceleration: float) -> list[str]:
    out = []
    if rotation_rate < MIN_ROTATION_RATE:
        out.append(
            f"turned by {rotation_rate:.2f} rad/s rms about one axis, {MIN_ROTATION_RATE:g} needed about "
            "each: nod, roll and look around"
        )
    if acceleration < MIN_ACCELERATION:
        out.append(
            f"accelerated by {acceleration:.2f} m/s^2 rms along one axis, {MIN_ACCELERATION:g} needed along "
            "each: move to and fro, up and down, near and far"
        )
    return out


def _imu_failures(gyro: float, accel: float, gravity: F64) -> list[str]:
    out = [
        f"{name}: residuals are {times:.1f} times the stated noise, at most {MAX_NOISE_RATIO:g} allowed: is "
        "--imu of this device, the IMU fixed to the cameras, the board's size as in --target?"
        for name, times in (("gyroscope", gyro), ("accelerometer", accel))
        if not times <= MAX_NOISE_RATIO
    ]
    deviation = float(np.linalg.norm(gravity)) - STANDARD_GRAVITY
    if not abs(deviation) <= MAX_GRAVITY_ERROR:
        out.append(
            f"gravity differs by {deviation:+.2f} m/s^2 from {STANDARD_GRAVITY:g}, at most "
            f"{MAX_GRAVITY_ERROR:g} allowed: check the accelerometer's scale and units"
        )
    return out


def _sigma_failures(fit: CameraImuFit) -> list[str]:
    total_sigmas = largest_sigmas(fit.axis_sigmas(fit.covariance))
    noise_sigmas = largest_sigmas(fit.axis_sigmas(fit.by_noise))
    return [
        f"{name} known to {sigma:.3g} {unit} (one sigma), {limit:g} needed: "
        + ("record longer, turn quicker" if alone**2 > sigma**2 / 2 else "calibrate the cameras better first")
        for (name, limit, unit), sigma, alone in zip(MAX_SIGMAS, total_sigmas, noise_sigmas, strict=True)
        if not sigma <= limit
    ]


def largest_sigmas(sigmas: F64) -> tuple[float, float, float]:
    """Return the largest of seven sigmas: deg, mm, ms."""
    return float(np.degrees(sigmas[:3]).max()), 1e3 * float(sigmas[3:6].max()), 1e3 * float(sigmas[6])


@dataclass(frozen=True)
class MountingComparison:
    """Difference of the estimated extrinsics from the given ones. inverted: the inverse of the given ones
    matches."""

    rotation_deg: float
    translation_mm: float
    inverted: bool

    @property
    def is_far(self) -> bool:
        return _distance_units(self.rotation_deg, self.translation_mm) > _FAR_UNITS


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


def _distance_units(rotation_deg: float, translation_mm: float) -> float:
    return rotation_deg / _NEAR_DEG + translation_mm / _NEAR_MM
