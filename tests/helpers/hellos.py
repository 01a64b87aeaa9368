"""What an agent says of itself, for tests that do not care how it sees."""

from __future__ import annotations

import numpy as np

from share.geometry.camera import Camera, ImuNoise, Rig
from share.types import F64, AgentKind
from share.wire.messages import Hello

NOISE = ImuNoise(1.7e-4, 2.0e-3, 1.9e-5, 3.0e-3, 200.0)


def rig_of(focal: float = 400.0, T_body_cam0: F64 | None = None) -> Rig:
    """One camera of 640 x 480 px with an IMU; at the body, unless said otherwise."""
    T = np.eye(4) if T_body_cam0 is None else T_body_cam0
    return Rig(Camera(640, 480, focal, focal, 319.5, 239.5), T, imu=NOISE)


def hello_of(
    name: str, run_id: int, kind: AgentKind = AgentKind.AR, focal: float = 400.0, T: F64 | None = None
) -> Hello:
    return Hello(name, kind, run_id, rig_of(focal, T))
