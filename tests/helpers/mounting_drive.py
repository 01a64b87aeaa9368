"""Drives of an emulated robot, as its wheels and a tracker see them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from share.geometry.se3 import from_rt, so3_exp
from share.lab.emulate.types import START_NS
from share.lab.robot.body import BodyPath
from share.lab.robot.drive import STEP_NS, STEP_S, DifferentialDrive, DriveModel
from share.robot.mounting import MountingDrive
from share.robot.planar import PlanarPose
from share.types import F64

Command = Callable[[float], tuple[float, float]]  # speed m/s and turn rad/s at a time, s


def eight(t: float) -> tuple[float, float]:
    """A figure of eight, 12 s a loop."""
    return 0.2, 0.55 if (t // 12) % 2 == 0 else -0.55


def mounting_drive(
    T_base_body: F64, command: Command, seconds: float, seed: int, late_s: float = 0.0
) -> MountingDrive:
    """Drive with slip, latency and unequal wheels; poses at 15 Hz with 1 mm and 0.05° of noise, a drift of
    1 % of the way and 0.02 °/s, and gravity off by 0.2°; odometry at 20 Hz, stamped late."""
    drive_rng, body_rng, rng = np.random.default_rng(seed).spawn(3)
    drive = DifferentialDrive(DriveModel(), PlanarPose(1.0, 2.0, 0.7), drive_rng)
    body = BodyPath(T_base_body, seconds + 2.0, body_rng)
    body.add(drive.last)
    steps = [drive.last]
    for k in range(round((seconds + 1.0) / STEP_S)):
        if k % 20 == 0:
            drive.command(k * STEP_NS, *command(k * STEP_S))
        steps.append(drive.step())
        body.add(drive.last)
    pose_ns = np.arange(0, int(seconds * 1e9), 66_666_667)
    path = body.part(0, int(pose_ns[-1]))
    true = path.poses(pose_ns + START_NS)
    scale, drift = 1 + 0.01 * rng.standard_normal(), 0.02 * rng.standard_normal()
    tilt = from_rt(so3_exp(np.radians(0.2) * np.append(rng.standard_normal(2), 0.0)), np.zeros(3))
    poses = np.empty_like(true)
    for k, T in enumerate(true):
        turn = so3_exp(np.array([0.0, 0.0, np.radians(drift) * pose_ns[k] / 1e9]))
        noise = so3_exp(np.radians(0.05) * rng.standard_normal(3))
        moved = turn @ (scale * T[:3, 3]) + 1e-3 * rng.standard_normal(3)
        poses[k] = tilt @ from_rt(turn @ T[:3, :3] @ noise, moved)
    wheel_ns = np.arange(0, int(seconds * 1e9), 50_000_000)
    wheels = np.array([[(p := steps[one // STEP_NS].T_odom_base).x, p.y, p.yaw] for one in wheel_ns])
    return MountingDrive(pose_ns, poses, wheel_ns + int(late_s * 1e9), wheels)
