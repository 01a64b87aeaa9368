"""A recorded session before a board gives back how its cameras are mounted and its time offset."""

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from share.files.yaml_file import read_yaml
from share.geometry import se3
from share.lab.calibrate.target import T_WORLD_TARGET, TARGET, target_from_section
from share.lab.emulate.motion.motion_plan import plan_motions
from share.lab.emulate.recipe import SessionRecipe
from share.lab.emulate.render.context import missing_reason
from share.lab.emulate.sensor.effects import parse_effects
from share.lab.emulate.session import make_session
from share.lab.emulate.world.scenes import make_scene_layout
from share.runtime.source import open_source

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(missing_reason() is not None, reason=f"cannot draw: {missing_reason()}"),
]
SCENE, MOTION, SECONDS, OFFSET_MS = "charuco-board", "board:", 6.0, 5.0


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    recipe = SessionRecipe(
        scene=SCENE,
        motions=(MOTION,),
        seconds=SECONDS,
        profiles={"": "d435i:640x480@15"},
        effects=parse_effects([f"time_offset_ms={OFFSET_MS}"]),
    )
    return make_session(recipe, tmp_path_factory.mktemp("board") / "session")


def test_extrinsics_and_time_offset_are_what_the_session_says(session):
    section = read_yaml(session / "session.yaml").section(TARGET)
    target, T_world_target = target_from_section(section), section.pose(T_WORLD_TARGET)
    source = open_source(str(session / "board1"))
    rig = source.rig
    path = plan_motions([MOTION], make_scene_layout(SCENE, 0), SECONDS, 0).agents[0].path
    seen = {stream: detections(source, stream, target) for stream in ("cam0", "cam1")}
    true = {"cam0": rig.T_body_cam0, "cam1": rig.T_body_cam0 @ se3.inverse(rig.T_cam1_cam0)}

    def residuals(x):
        out = []
        for k, (stream, found) in enumerate(seen.items()):
            stamps = np.array([stamp for stamp, _, _ in found])
            times = np.clip(stamps + np.rint(x[0] * 1e6).astype(np.int64), path.start_ns, path.end_ns)
            T = path.poses(times) @ true[stream] @ se3.exp(x[1 + 6 * k : 7 + 6 * k])
            for T_world_cam, (_, ids, px) in zip(T, found, strict=True):
                points = se3.transform(se3.inverse(T_world_cam) @ T_world_target, target.corners[ids])
                out.append((getattr(rig, stream).project(points) - px).ravel())
        return np.concatenate(out)

    start = np.r_[1.0, np.zeros(12)]  # not 0: steps are relative, and stamps are whole nanoseconds
    x = least_squares(
        residuals, start, loss="soft_l1", f_scale=0.15, x_scale=np.r_[1, np.full(12, 1e-3)], diff_step=1e-4
    ).x
    assert x[0] == pytest.approx(OFFSET_MS, abs=0.05)
    for error in (x[1:7], x[7:13]):
        assert np.degrees(np.linalg.norm(error[:3])) < 0.02
        assert np.linalg.norm(error[3:]) < 0.0005


def detections(source, stream, target):
    """(stamp, ids, px) of each image with ten corners or more."""
    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
    size = (target.squares_x, target.squares_y)
    detector = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard(size, target.square, target.marker, family))
    out = []
    for measurement in source.measurements():
        if measurement.stream == stream:
            corners, ids, _, _ = detector.detectBoard(measurement.payload.load())
            if ids is not None and len(ids) >= 10:
                out.append((measurement.stamp_ns, np.ravel(ids).astype(int), np.reshape(corners, (-1, 2))))
    assert len(out) > 0.6 * SECONDS * 15
    return out
