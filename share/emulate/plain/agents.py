"""Who is in the demo's room, and with which sensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from share.emulate.plain.motion import STYLES, Style
from share.geometry.camera import Camera, Rig
from share.geometry.se3 import compose
from share.types import AgentKind

RATE_HZ = 20  # of every camera
BASELINE = 0.05  # m, of a D435i's infrared pair
_CAMERA = Camera(640, 480, 385.0, 385.0, 319.5, 239.5)

STEREO = Rig(
    _CAMERA, np.eye(4), cam1=_CAMERA, T_cam1_cam0=compose(np.eye(3), np.array([-BASELINE, 0.0, 0.0]))
)
RGBD = Rig(_CAMERA, np.eye(4), depth=_CAMERA, T_depth_cam0=np.eye(4))


@dataclass(frozen=True)
class Agent:
    """One recording of a session. Its body is cam0: the plain room has no IMU."""

    name: str
    kind: AgentKind
    rig: Rig
    style: Style


AGENTS = (
    Agent("ar1", AgentKind.AR, STEREO, STYLES["walker"]),
    Agent("ar2", AgentKind.AR, STEREO, STYLES["stroller"]),
    Agent("robot", AgentKind.ROBOT, RGBD, STYLES["robot"]),
)


def calibration(rig: Rig) -> dict[str, Any]:
    """A rig without IMU as plain data, under Kalibr's names (`share.io.calibration` reads it)."""
    out = {"cam0": _camera(rig.cam0)}
    if rig.cam1 is not None and rig.T_cam1_cam0 is not None:
        out["cam1"] = _camera(rig.cam1) | {"T_cn_cnm1": rig.T_cam1_cam0.tolist()}
    if rig.depth is not None and rig.T_depth_cam0 is not None:
        out["depth"] = _camera(rig.depth) | {"T_depth_cam0": rig.T_depth_cam0.tolist(), "depth_scale": 1000.0}
    return out


def _camera(camera: Camera) -> dict[str, Any]:
    return {
        "camera_model": "pinhole",
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "distortion_model": "none",
        "resolution": [camera.width, camera.height],
    }
