"""What people and a robot see on their way through the plain room, and where they truly were."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

from share.geometry import se3
from share.lab.emulate.motion.motion_plan import plan_motions
from share.lab.emulate.plain.render import DEFAULT_SIZE, PlainRenderer, plain_layout
from share.lab.emulate.sensor.device import EmulatedDevice
from share.lab.emulate.types import MotionPath, SceneInstant
from share.sensors.profile import load_profile
from share.types import F64, U8

MOTIONS = {  # heads that turn at leisure: the tests want to see the room, not motion
    "walker": "walk:speed=0.65,turns=0.9",
    "stroller": "walk:speed=0.55,turns=0.9",
    "robot": "robot:speed=0.3",
}
_DEVICE = load_profile("d435i", "640x480@15")
RIG = _DEVICE.rig(depth=False)
STEREO = replace(RIG, T_body_cam0=np.eye(4), imu=None)  # its body is cam0
CAMERA = RIG.cam0
T_CAM1_CAM0 = RIG.T_cam1_cam0


def poses(who: str, seconds: F64, seed: int, lasts: float = 20.0) -> F64:
    """T_world_cam0 (N, 4, 4) at `seconds` (N,) from the start of one of MOTIONS; for the same `seed` and
    `lasts` they all go about the room together. Each stands still for a second at first."""
    path = _paths(seed, lasts)[who]
    return path.poses(path.start_ns + np.rint(seconds * 1e9).astype(np.int64)) @ RIG.T_body_cam0


def gray(T_world_cam: F64, seed: int, frame: int, camera: int = 0) -> U8:
    """Image (480, 640) of the plain room of this seed, as a D435i delivers it at its reference exposure."""
    radiance = _renderer(seed).radiance(CAMERA, [SceneInstant(T_world_cam)])
    return _device(seed).develop_image(radiance, frame, camera)


def pairs(T_world_cam0: F64, seed: int) -> list[tuple[U8, U8]]:
    """Images of cam0 and cam1 from poses (N, 4, 4) of cam0."""
    right = T_world_cam0 @ se3.inverse(T_CAM1_CAM0)
    return [
        (gray(T, seed, k, 0), gray(T_right, seed, k, 1))
        for k, (T, T_right) in enumerate(zip(T_world_cam0, right, strict=True))
    ]


@functools.cache
def _paths(seed: int, lasts: float) -> dict[str, MotionPath]:
    specs = [f"{name}={spec}" for name, spec in MOTIONS.items()]
    return {agent.name: agent.path for agent in plan_motions(specs, plain_layout(seed), lasts, seed).agents}


@functools.cache
def _renderer(seed: int) -> PlainRenderer:
    return PlainRenderer(seed, DEFAULT_SIZE)


@functools.cache
def _device(seed: int) -> EmulatedDevice:
    return EmulatedDevice(_DEVICE, seed=(seed,))
