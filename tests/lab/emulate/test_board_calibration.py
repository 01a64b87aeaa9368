"""The emulator's own dances before a board, with a device's IMU (two streams, digits, biases): cameras and
IMU are calibrated from corners that are projected, not drawn."""

import numpy as np
import pytest

from share.geometry import se3
from share.lab.calibrate.camera_imu.fit import fit_camera_imu
from share.lab.calibrate.camera_imu.verdict import judge_camera_imu
from share.lab.calibrate.corner_observations import BoardView
from share.lab.calibrate.corners import Detection
from share.lab.emulate.motion.motion_plan import plan_motions
from share.lab.emulate.sensor.device import EmulatedDevice
from share.lab.emulate.world.scenes import make_scene_layout
from share.sensors.profile import load_profile
from share.types import F64

SECONDS, SHIFT_S, NOISE_PX = 30.0, 0.005, 0.06


def _views(poses: F64, target, rig, rng: np.random.Generator) -> list[BoardView]:
    out = []
    for T in poses:
        seen = []
        for camera, mount in ((rig.cam0, np.eye(4)), (rig.cam1, rig.T_cam1_cam0)):
            px = camera.project(se3.transform(mount @ se3.inverse(T), target.corners))
            ids = np.flatnonzero(camera.inside(px, 5.0))
            seen.append(Detection(ids, px[ids] + rng.normal(0, NOISE_PX, (len(ids), 2))))
        out.append(BoardView("", tuple(seen)))
    return out


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seed"), [("d435i", 1), ("d435i", 2), ("d435i", 3), ("euroc", 4)])
def test_cameras_are_found_on_the_imu(name: str, seed: int) -> None:
    room, made, rng = make_scene_layout("board", seed), load_profile(name), np.random.default_rng(seed)
    rig = made.rig()
    path = plan_motions(["board:"], room, SECONDS, seed).agents[0].path.with_axes(rig.T_body_cam0[:3, :3].T)
    imu = EmulatedDevice(made, None, (seed,), path.start_ns).imu_streams(path).to_batch()
    stamps = path.start_ns + np.arange(0.2, SECONDS - 0.2, 0.1) * 1e9
    poses = path.poses((stamps + SHIFT_S * 1e9).astype(np.int64)) @ rig.T_body_cam0
    views = _views(se3.inverse(room.target.T_world_target) @ poses, room.target.target, rig, rng)
    found = fit_camera_imu(stamps.astype(np.int64), views, room.target.target, rig, imu, rig.imu)
    xi = se3.log(se3.inverse(found.T_imu_cam0) @ rig.T_body_cam0)
    error = np.append(xi, SHIFT_S - found.shift_s)
    nees = error @ np.linalg.solve(found.covariance, error)
    reported = np.degrees(np.linalg.norm(xi[:3])), np.linalg.norm(xi[3:]) * 1e3, error[6] * 1e3, nees
    print(name, seed, "deg, mm, ms, NEES:", *(f"{x:.4f}" for x in reported))
    assert judge_camera_imu(found).passed, judge_camera_imu(found).reasons
    assert reported[0] < 0.1 and reported[1] < 2 and abs(reported[2]) < 0.2
    assert nees < 24.3  # chi-square of 7: 0.1 %
