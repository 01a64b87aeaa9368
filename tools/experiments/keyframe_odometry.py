"""Simulated odometry of an inertial tracker, from the true poses: yaw and position drift, the vertical does
not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.types import F64, I64


@dataclass(frozen=True)
class Drift:
    """Standard deviations of errors from one keyframe to the next: m and m per m of path, on each axis; rad
    and rad per rad of rotation, about the vertical. tilt_rad: of roll and pitch at any time; they vary within
    tilt_s seconds, as gravity is observed."""

    step_m: float = 0.002
    per_metre: float = 0.003
    yaw_rad: float = float(np.radians(0.02))
    per_radian: float = 0.001
    tilt_rad: float = float(np.radians(0.1))
    tilt_s: float = 10.0


def odometry(T_world_body: F64, stamps_ns: I64, rng: np.random.Generator, drift: Drift) -> tuple[F64, F64]:
    """Return T_odom_body (N, 4, 4), and covariances (N, 6, 6) of each pose relative to the one before, of the
    first one to odom. T_world_body (N, 4, 4): the true poses at stamps (N,), rising.

    With the true step D_k between poses of distance d and angle a, that of odometry is D_k Exp(xi_k), xi =
    (rotation, translation), right-perturbed as in `share.geometry.se3`:

    * translation ~ N(0, step_m^2 + (per_metre d)^2) on each axis of the body;
    * rotation about the vertical by the yaw error, N(0, (yaw_rad + per_radian a)^2), and by the changes of
    roll and pitch: each is a first-order Gauss-Markov process of standard deviation tilt_rad with time
    constant tilt_s, so its step has variance 2 tilt_rad^2 (1 - exp(-dt / tilt_s)).

    odom begins at the first body with a random yaw; its z is up except for the tilt.
    """
    T_step = se3.inverse(T_world_body[:-1]) @ T_world_body[1:]
    distances = np.append(0.0, np.linalg.norm(T_step[:, :3, 3], axis=1))
    turn = np.append(0.0, se3.rotation_angle(T_step))
    # correlation of the tilt over a step
    keeps = np.append(0.0, np.exp(-np.diff(stamps_ns) * 1e-9 / drift.tilt_s))
    sigma_m = np.hypot(drift.step_m, drift.per_metre * distances)
    sigma_yaw = drift.yaw_rad + drift.per_radian * turn
    sigma_tilt = drift.tilt_rad * np.sqrt(np.where(keeps > 0, 2 * (1 - keeps), 1.0))
    R_odom_body = _turned(T_world_body[:, :3, :3], sigma_yaw, keeps, drift.tilt_rad, rng)
    shift = sigma_m[:, None] * rng.standard_normal((len(distances), 3))
    poses = [se3.from_rt(R_odom_body[0], np.zeros(3))]
    for k, D in enumerate(T_step, start=1):
        reached = poses[-1] @ D
        rotation = se3.so3_log(reached[:3, :3].T @ R_odom_body[k])
        poses.append(reached @ se3.exp(np.concatenate([rotation, shift[k]])))
    return se3.orthonormal(np.array(poses)), _covariances(R_odom_body, sigma_tilt, sigma_yaw, sigma_m)


def _turned(R_world_body: F64, sigma_yaw: F64, keeps: F64, tilt_rad: float, rng: np.random.Generator) -> F64:
    """Return R_odom_body (N, 3, 3) with a yaw error that accumulates, from a random start, and a tilt error
    that does not."""
    steps = sigma_yaw * rng.standard_normal(len(keeps))
    steps[0] = rng.uniform(-np.pi, np.pi)
    tilt = np.zeros((len(keeps), 3))
    drawn = tilt_rad * rng.standard_normal((len(keeps), 2))
    for k, keep in enumerate(keeps):
        tilt[k, :2] = keep * tilt[k - 1, :2] + np.sqrt(1 - keep**2) * drawn[k]
    yaw = np.cumsum(steps)[:, None] * (0.0, 0.0, 1.0)
    out: F64 = se3.so3_exp(yaw) @ se3.so3_exp(tilt) @ R_world_body
    return out


def _covariances(R_odom_body: F64, sigma_tilt: F64, sigma_yaw: F64, sigma_m: F64) -> F64:
    """Return covariances (N, 6, 6) in the body frame."""
    vertical = np.zeros((len(sigma_m), 3, 3))
    vertical[:, [0, 1], [0, 1]] = sigma_tilt[:, None] ** 2
    vertical[:, 2, 2] = sigma_yaw**2
    out = np.zeros((len(sigma_m), 6, 6))
    out[:, :3, :3] = np.swapaxes(R_odom_body, 1, 2) @ vertical @ R_odom_body
    out[:, :3, :3] = (out[:, :3, :3] + np.swapaxes(out[:, :3, :3], 1, 2)) / 2
    out[:, [3, 4, 5], [3, 4, 5]] = sigma_m[:, None] ** 2
    return out
