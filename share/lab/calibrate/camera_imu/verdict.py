"""Whether a calibration of cameras and IMU may be believed, and what to do where not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.lab.calibrate import corners
from share.lab.calibrate.camera_imu.batch import rough
from share.lab.calibrate.camera_imu.fit import Fit
from share.types import F64

_STANDARD_GRAVITY = 9.80665
_NEAR_DEG, _NEAR_MM = 1.0, 5.0  # as one unit of distance between two mountings
_FAR = 4.0  # of these: worth a word


@dataclass(frozen=True)
class Limits:
    """What passes. rms_px: of corners kept; wrong: share of those not; imu: residuals over stated noise;
    gravity m/s^2: off the standard; turning rad/s, moving m/s^2: rms about and along the least moved axis;
    the rest: one sigma of the result."""

    rms_px: float = 1.0
    wrong: float = 0.05
    imu: float = 10.0
    gravity: float = 0.15
    turning: float = 0.15
    moving: float = 0.2
    rotation_deg: float = 0.05
    position_mm: float = 1.0
    shift_ms: float = 0.1


@dataclass(frozen=True, eq=False)
class Verdict:
    """reasons: what fails, none where it passes. rms_px and wrong corners of each camera; turning (3,) rad/s
    and moving (3,) m/s^2: rms by principal axes, largest first; gyro, accel: residuals, the rms of all or
    of slow ones, over stated."""

    reasons: tuple[str, ...]
    rms_px: tuple[float, ...]
    wrong: tuple[int, ...]
    turning: F64
    moving: F64
    gyro: float
    accel: float

    @property
    def passed(self) -> bool:
        return not self.reasons


def judge(fit: Fit, limits: Limits = Limits()) -> Verdict:
    """Of a fit."""
    inside = [corners.kept(r, fit.sigmas.px) for r in fit.corners]
    rms = tuple(corners.rms(r[k]) for r, k in zip(fit.corners, inside, strict=True))
    wrong = tuple(int((~k).sum()) for k in inside)
    gyro = rough(fit.imu.stamps_ns, fit.gyro) / fit.stated.gyro
    accel = rough(fit.imu.stamps_ns, fit.accel) / fit.stated.accel
    turning, moving = _excitation(fit)
    reasons = [
        *_corner_reasons(fit, rms, limits),
        *_motion_reasons(turning, moving, limits),
        *_imu_reasons(gyro, accel, fit.state.gravity, limits),
        *_sigma_reasons(fit, limits),
    ]
    return Verdict(tuple(reasons), rms, wrong, turning, moving, gyro, accel)


def _excitation(fit: Fit) -> tuple[F64, F64]:
    curve, at = fit.state.curve, fit.state.curve.place(fit.imu.stamps_ns)
    rates, moves = curve.turning(at).rate, curve.position(at, 2)[0]
    turning, moving = (np.linalg.svd(x, compute_uv=False) / np.sqrt(len(x)) for x in (rates, moves))
    return turning, moving


def _corner_reasons(fit: Fit, rms: tuple[float, ...], limits: Limits) -> list[str]:
    out = []
    for eye, residuals in enumerate(fit.corners):
        if len(residuals) and not rms[eye] <= limits.rms_px:
            out.append(
                f"cam{eye}: {rms[eye]:.2f} px RMS, at most {limits.rms_px:g}: blur, or --target or "
                "intrinsics of something else"
            )
        lost = corners.lost(residuals, fit.sigmas.px, limits.rms_px)
        if lost > limits.wrong * len(residuals):
            out.append(
                f"cam{eye}: {lost} of {len(residuals)} corners do not fit within {limits.rms_px:g} px, at "
                f"most {limits.wrong:.0%}"
            )
    return out


def _motion_reasons(turning: F64, moving: F64, limits: Limits) -> list[str]:
    out = []
    if turning[2] < limits.turning:
        out.append(
            f"turned by {turning[2]:.2f} rad/s rms about one axis, {limits.turning:g} needed about each: "
            "nod, roll and look around"
        )
    if moving[2] < limits.moving:
        out.append(
            f"accelerated by {moving[2]:.2f} m/s^2 rms along one axis, {limits.moving:g} needed along each: "
            "move to and fro, up and down, near and far"
        )
    return out


def _imu_reasons(gyro: float, accel: float, gravity: F64, limits: Limits) -> list[str]:
    out = [
        f"{name}'s residuals are {times:.1f} times its stated noise, at most {limits.imu:g}: is --imu of "
        "this device, the IMU fixed to the cameras, the board as large as --target says?"
        for name, times in (("gyroscope", gyro), ("accelerometer", accel))
        if not times <= limits.imu
    ]
    off = float(np.linalg.norm(gravity)) - _STANDARD_GRAVITY
    if not abs(off) <= limits.gravity:
        out.append(
            f"gravity comes out {off:+.2f} m/s^2 off {_STANDARD_GRAVITY:g}, at most {limits.gravity:g}: "
            "the accelerometer's scale, or its units"
        )
    return out


def _sigma_reasons(fit: Fit, limits: Limits) -> list[str]:
    whole = largest(fit.sigmas_of(fit.covariance))
    noise = largest(fit.sigmas_of(fit.by_noise))
    names = (
        ("rotation", limits.rotation_deg, "deg"),
        ("position", limits.position_mm, "mm"),
        ("time offset", limits.shift_ms, "ms"),
    )
    return [
        f"{name} known to {sigma:.3g} {unit} (one sigma), {limit:g} needed: "
        + ("record longer, turn quicker" if alone**2 > sigma**2 / 2 else "calibrate the cameras better first")
        for (name, limit, unit), sigma, alone in zip(names, whole, noise, strict=True)
        if not sigma <= limit
    ]


def largest(sigmas: F64) -> tuple[float, float, float]:
    """The largest of seven sigmas: deg, mm, ms."""
    return float(np.degrees(sigmas[:3]).max()), 1e3 * float(sigmas[3:6].max()), 1e3 * float(sigmas[6])


@dataclass(frozen=True)
class Comparison:
    """How far found mounting and given one are apart; inverted: the inverse of the given one is what was
    found."""

    turned_deg: float
    shifted_mm: float
    inverted: bool

    @property
    def far(self) -> bool:
        return _units(self.turned_deg, self.shifted_mm) > _FAR


def compare(T_imu_cam0: F64, given: F64) -> Comparison:
    """The mounting that was found with T_imu_cam0 (4, 4) as a file has it."""
    straight, inverse = _apart(T_imu_cam0, given), _apart(T_imu_cam0, se3.inverse(given))
    inverted = _units(*straight) > 1 and _units(*inverse) < min(_FAR, _units(*straight) / 3)
    return Comparison(*straight, inverted)


def _apart(T: F64, other: F64) -> tuple[float, float]:
    """deg, mm."""
    away = np.linalg.norm(T[:3, 3] - other[:3, 3])
    return float(np.degrees(se3.angle(T[:3, :3].T @ other[:3, :3]))), 1e3 * float(away)


def _units(turned_deg: float, shifted_mm: float) -> float:
    return turned_deg / _NEAR_DEG + shifted_mm / _NEAR_MM
