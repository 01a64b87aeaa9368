"""Images of calibration boards: corners where geometry says, and the camera found from them."""

import cv2
import numpy as np
import pytest
from helpers.rendered import needs_opengl
from scipy.spatial.distance import pdist

from share.geometry import se3
from share.lab.calibrate.target import AprilGrid
from share.lab.emulate.motion.board import board_path
from share.lab.emulate.motion.spec import BoardSpec
from share.lab.emulate.render.gl import GlRenderer
from share.lab.emulate.types import SceneInstant
from share.lab.emulate.world.build import build_room
from share.lab.emulate.world.scenes import make_scene_layout
from share.sensors.profile import load_profile

pytestmark = [pytest.mark.long, needs_opengl]
FRAMES = 10
CLEAR_M = 0.009  # around a corner there is nothing but the corner


@pytest.fixture(scope="module", params=[("board", "d435i", "euroc"), ("charuco-board", "d435i")])
def shots(request):
    """By profile: the camera, the target, gray images and where all corners are in them (F, K, 2) px."""
    scene, *profiles = request.param
    room = make_scene_layout(scene, 1)
    renderer, made = GlRenderer(build_room(room)), {}
    for name in profiles:
        rig = load_profile(name).rig()
        path = board_path(room, BoardSpec(), 40.0, np.random.default_rng((1, 5)))
        t = path.start_ns + np.linspace(3e9, 39e9, FRAMES).astype(np.int64)
        T_world_cam = path.with_axes(rig.T_body_cam0[:3, :3].T).poses(t) @ rig.T_body_cam0
        points = se3.transform(room.target.T_world_target, room.target.target.corners)
        images = [renderer.radiance(rig.cam0, [SceneInstant(T)]) for T in T_world_cam]
        images = [np.rint(image * min(1, 230 / np.percentile(image, 98))).clip(0, 255) for image in images]
        true = [rig.cam0.project(se3.transform(se3.inverse(T), points)) for T in T_world_cam]
        made[name] = rig.cam0, room.target.target, [i.astype(np.uint8) for i in images], true
    return made


def found(camera, target, image, true):
    """Ids and refined places of the corners that OpenCV finds well inside the image."""
    ids = april_ids(image) if isinstance(target, AprilGrid) else charuco_ids(target, image)
    ids = ids[camera.is_inside(true[ids], 12)]
    scale = pdist(true).min() / pdist(target.corners).min()  # px a metre, where the board is farthest
    reach = int(np.clip(CLEAR_M * scale, 2, 5))
    start = true[ids] + np.random.default_rng(1).uniform(
        -0.3, 0.3, (len(ids), 2)
    )  # not from the truth itself
    start = np.ascontiguousarray(start[:, None], np.float32)
    refined = cv2.cornerSubPix(image, start, (reach, reach), (-1, -1), (3, 100, 1e-4))
    return ids, refined.reshape(-1, 2)


def april_ids(image):
    options = cv2.aruco.DetectorParameters()
    options.markerBorderBits = 2
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    _, numbers, _ = cv2.aruco.ArucoDetector(family, options).detectMarkers(image)
    return (4 * np.ravel(numbers)[:, None] + np.arange(4)).ravel()


def charuco_ids(target, image):
    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
    size = (target.squares_x, target.squares_y)
    board = cv2.aruco.CharucoBoard(size, target.square, target.marker, family)
    return np.ravel(cv2.aruco.CharucoDetector(board).detectBoard(image)[1]).astype(int)


def test_corners_are_where_geometry_says_and_give_the_camera_back(shots):
    for camera, target, images, true in shots.values():
        check(camera, target, images, true)


def check(camera, target, images, true):
    seen = [found(camera, target, image, t) for image, t in zip(images, true, strict=True)]
    errors = np.concatenate([px - t[ids] for (ids, px), t in zip(seen, true, strict=True)])
    assert len(errors) > 0.6 * FRAMES * len(true[0])
    length = np.linalg.norm(errors, axis=1)
    good = length < 0.5  # what a detector takes for a corner now and then is none
    assert good.mean() > 0.98
    assert np.sqrt((errors[good] ** 2).mean()) < 0.05
    assert np.abs(errors[good].mean(axis=0)).max() < 0.01
    K, distortion = calibrated(camera, target, seen, true)
    np.testing.assert_allclose((K[0, 0], K[1, 1]), (camera.fx, camera.fy), rtol=1e-3)
    np.testing.assert_allclose((K[0, 2], K[1, 2]), (camera.cx, camera.cy), atol=0.25)
    np.testing.assert_allclose(distortion[:2], camera.distortion[:2] or (0, 0), atol=0.004)


def calibrated(camera, target, seen, true):
    """Intrinsics and distortion of OpenCV's calibration from these corners."""
    used = [
        (ids, px, np.linalg.norm(px - t[ids], axis=1) < 0.5) for (ids, px), t in zip(seen, true, strict=True)
    ]
    points = [target.corners[ids[ok]].astype(np.float32) for ids, _, ok in used]
    places = [px[ok].astype(np.float32) for _, px, ok in used]
    size, flags = (camera.width, camera.height), cv2.CALIB_FIX_K3
    _, K, distortion, _, _ = cv2.calibrateCamera(points, places, size, None, None, flags=flags)
    return K, np.ravel(distortion)
