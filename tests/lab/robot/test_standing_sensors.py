"""A robot that stands looks from one place: what it sees is drawn once; its IMU feels the fans."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from share.geometry.camera import Camera
from share.lab.emulate.sensor.device import EmulatedDevice
from share.lab.emulate.sensor.effects import Effects
from share.lab.emulate.types import START_NS, SceneInstant
from share.lab.robot.body import BodyPath
from share.lab.robot.drive import DifferentialDrive, DriveModel
from share.lab.robot.sensors import RobotSensors
from share.robot.planar import PlanarPose
from share.sensors.profile import load_profile
from share.types import F32, F64, I64

SECONDS = 8.0
STOPS_S = 2.0


class _Poses:
    """Notes from where is drawn, and draws gray."""

    def __init__(self) -> None:
        self.seen: list[F64] = []

    def radiance(self, camera: Camera, instants: Sequence[SceneInstant]) -> F32:
        self.seen.append(instants[0].T_world_cam)
        return np.full((camera.height, camera.width), 90.0, np.float32)


def nobody(session_ns: I64) -> list[dict[str, F64]]:
    return [{} for _ in session_ns]


def test_a_robot_that_stands_looks_from_one_place() -> None:
    profile, rng = load_profile("d435i", "640x480@15"), np.random.default_rng(3)
    drive = DifferentialDrive(DriveModel(), PlanarPose(3.0, 2.0, 0.4), rng)
    body = BodyPath(np.eye(4), SECONDS + 1.0, rng)
    body.add(drive.last)
    for k in range(int((SECONDS + 0.5) * 200)):
        if k % 10 == 0:
            drive.command(drive.now_ns, *((0.3, 0.2) if k < 200 * STOPS_S else (0.0, 0.0)))
        body.add(drive.step())
    drawn = _Poses()
    device = EmulatedDevice(profile, Effects(), (1,), START_NS, (2,))
    sensors = RobotSensors(profile.rig(depth=False), device, drawn, body, nobody, SECONDS)  # type: ignore[arg-type]
    standing, moving = list[tuple[bytes, bytes]](), set[bytes]()
    for number, time_ns in enumerate(sensors.frame_times_ns[:-2]):
        drawn.seen.clear()
        frame = sensors.frame(number)
        left = drawn.seen[-2]
        at_ns = np.array([time_ns + START_NS])
        T_true = body.part(time_ns, time_ns).poses(at_ns)[0] @ profile.rig(depth=False).T_body_cam0
        if time_ns > (STOPS_S + 1.5) * 1e9:
            standing.append((left.tobytes(), T_true.tobytes()))
            assert np.linalg.norm(left[:3, 3] - T_true[:3, 3]) < 1e-4  # m
            assert frame.imu is not None and frame.imu.accel[:, 2].std() > 0
        elif time_ns < STOPS_S * 1e9:
            moving.add(left.tobytes())
    places, truths = (set(ones) for ones in zip(*standing, strict=True))
    assert len(truths) == len(standing) > 50 and len(places) == 1
    assert len(moving) > 20 and not moving & places
