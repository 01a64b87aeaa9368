"""Front-end parts against images whose geometry is known exactly."""

import cv2
import numpy as np
import pytest
from helpers.frame_keyframe import frame_image
from helpers.plain_walk import CAMERA, T_CAM1_CAM0

from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.lab.emulate.motion import walk
from share.lab.emulate.plain.render import PlainRoomRenderer
from share.lab.emulate.plain.room import make_room
from share.types import Frame, KeyframeImage
from share.vision import corners, depth, optical_flow
from share.vision.orb import detect_orb, image_view


@pytest.fixture(scope="module")
def scene():
    """Return left image, its exact depth, right image, an image 8 cm and 3 degrees away, and that motion."""
    room = make_room(3)
    renderer = PlainRoomRenderer(room, CAMERA)
    T = se3.from_rt(walk.axis_rotation(1, np.array([0.1]))[0] @ walk.CAMERA_AXES, np.array([5.35, 1.5, 1.66]))
    near = T @ se3.exp(np.array([0.01, 0.05, 0.0, 0.05, 0.01, 0.06]))
    left, exact = renderer.render(T)
    right, _ = renderer.render(T @ se3.inverse(T_CAM1_CAM0))
    other, _ = renderer.render(near)
    return left, exact, right, other, se3.inverse(near) @ T


@pytest.mark.long
@pytest.mark.parametrize("detect", [corners.detect, corners.strongest])
def test_corners_fill_empty_regions(scene, detect):
    image = scene[0]
    first = detect(image, np.zeros((0, 2), np.float32), 100, 15)
    more = detect(image, first, 100, 15)
    gap = np.linalg.norm(more[:, None] - first[None], axis=2).min()
    assert len(first) == 100
    assert len(more) > 20
    assert gap > 12  # spacing, less what sub-pixel refinement moves


def test_a_bright_poster_does_not_take_all_corners():
    rng = np.random.default_rng(1)
    room = cv2.resize(rng.integers(80, 160, (80, 106), np.uint8), (640, 480))
    room[100:260, 100:260] = cv2.resize(rng.integers(0, 255, (20, 20), np.uint8), (160, 160))
    on_poster = [
        ((px > 95) & (px < 265)).all(axis=1).mean()
        for px in (f(room, np.zeros((0, 2), np.float32), 60, 15) for f in (corners.detect, corners.strongest))
    ]
    assert on_poster[0] < 0.35  # it touches a third of the cells
    assert on_poster[1] > 0.5


def test_corners_found_in_bands_are_those_of_the_whole_image():
    rng = np.random.default_rng(4)
    image = cv2.GaussianBlur(rng.integers(0, 255, (239, 320), np.uint8), (0, 0), 1.5)
    peaks = corners.CornerPeaks(image)
    peaks.find_half()
    px, strength = peaks.px_and_strength()
    whole = cv2.cornerMinEigenVal(image, 5)
    expected = (whole == cv2.dilate(whole, np.ones((9, 9), np.uint8))) & (whole > 4e-4)
    expected[:6] = expected[-6:] = expected[:, :6] = expected[:, -6:] = False
    assert len(px) > 100
    assert (px[:, ::-1] == np.argwhere(expected)).all()
    assert np.allclose(strength, whole[expected], rtol=1e-5)


def test_no_corners_on_a_blank_wall():
    blank = np.full((480, 640), 128, np.uint8)
    for detect in (corners.detect, corners.strongest):
        assert detect(blank, np.zeros((0, 2), np.float32), 100, 15).shape == (0, 2)
    assert detect_orb(blank, 100)[0].shape == (0, 2)


@pytest.mark.long
def test_tracked_points_are_subpixel_exact(scene):
    left, exact, _, other, T_other_left = scene
    px = corners.detect(left, np.zeros((0, 2), np.float32), 200, 15)
    uv = CAMERA.normalise(px.astype(float))
    z = exact[np.rint(px[:, 1]).astype(int), np.rint(px[:, 0]).astype(int)]
    points = np.concatenate([uv, np.ones((len(uv), 1))], axis=1) * z[:, None]
    want = CAMERA.project(se3.transform(T_other_left, points))
    found_px, found = optical_flow.track_points(left, other, px, px)
    error = np.linalg.norm(found_px - want, axis=1)[found]
    assert found.mean() > 0.7
    assert np.median(error) < 0.15
    alike = optical_flow.ncc(left, other, px, found_px)
    assert np.median(alike[found]) > 0.9
    assert np.median(optical_flow.ncc(left, other, px, px[::-1].copy())) < 0.5


def stereo_by(method, scene):
    """Return which corners (N,) get a depth, and their errors of disparity, px."""
    left, exact, right, _, _ = scene
    rig = Rig(CAMERA, np.eye(4), cam1=CAMERA, T_cam1_cam0=T_CAM1_CAM0)
    px = corners.detect(left, np.zeros((0, 2), np.float32), 200, 15)
    z = method(left, right, rig, px, CAMERA.normalise(px.astype(float)))
    truth = exact[np.rint(px[:, 1]).astype(int), np.rint(px[:, 0]).astype(int)]
    known = ~np.isnan(z)
    return known, np.abs(385 * 0.05 * (1 / z - 1 / truth))[known]


@pytest.mark.long
def test_stereo_depth(scene):
    known, disparity_error = stereo_by(depth.from_stereo, scene)
    assert known.mean() > 0.8
    assert np.median(disparity_error) < 0.1  # px
    assert (disparity_error < 1).mean() > 0.95


@pytest.mark.long
def test_points_at_infinity_have_no_depth(scene):
    """And no warning: a covered lens shows both cameras the same."""
    left, *_ = scene
    rig = Rig(CAMERA, np.eye(4), cam1=CAMERA, T_cam1_cam0=T_CAM1_CAM0)
    px = corners.detect(left, np.zeros((0, 2), np.float32), 50, 15)
    assert np.isnan(depth.from_stereo(left, left, rig, px, CAMERA.normalise(px.astype(float)))).all()


@pytest.mark.long
def test_the_whole_epipolar_line_is_searched(scene):
    known, disparity_error = stereo_by(depth.search_depth, scene)
    assert known.mean() > 0.7
    assert (disparity_error < 1.5).mean() > 0.95


def test_repeated_texture_has_no_depth():
    stripes = np.tile(np.repeat(np.array([60, 190], np.uint8), 6), (480, 640))[:, :640]
    image = stripes + np.linspace(0, 20, 480).astype(np.uint8)[:, None]
    rig = Rig(CAMERA, np.eye(4), cam1=CAMERA, T_cam1_cam0=T_CAM1_CAM0)
    px = np.array([[300.0, 200.0], [400.0, 300.0]], np.float32)
    assert np.isnan(depth.search_depth(image, image, rig, px, CAMERA.normalise(px.astype(float)))).all()
    assert len(depth.search_depth(image, image, rig, px[:0], np.zeros((0, 2)))) == 0


def test_depth_of_an_unregistered_camera():
    """A slanted plane seen by a depth camera 2.5 cm aside with another focal length, as a Kinect's."""
    T_depth_cam0 = np.eye(4)
    T_depth_cam0[0, 3] = 0.025
    depth_camera = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
    rig = Rig(CAMERA, np.eye(4), depth=depth_camera, T_depth_cam0=T_depth_cam0)
    normal, offset = np.array([0.3, 0.1, 1.0]), 2.0  # n . p = offset, in the depth camera
    grid = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), axis=-1)
    rays = np.concatenate([depth_camera.normalise(grid), np.ones((480, 640, 1))], axis=2)
    image = (offset / (rays @ normal)).astype(np.float32)
    px = np.random.default_rng(0).uniform((150, 120), (490, 360), (300, 2))
    uv = CAMERA.normalise(px)
    z = depth.from_depth_camera(image, rig, uv)
    points = se3.transform(T_depth_cam0, np.concatenate([uv, np.ones((300, 1))], axis=1) * z[:, None])
    assert (~np.isnan(z)).all()
    assert np.abs(points @ normal - offset).max() < 1e-3
    assert np.abs(image[px[:, 1].astype(int), px[:, 0].astype(int)] - z).max() > 0.01  # not its own pixel


def test_no_depth_in_mid_air():
    """Beside an object's edge, and in a hole, there is no depth; elsewhere there is."""
    image = np.full((480, 640), 3.0, np.float32)
    image[:, :320] = 1.0
    image[100:140, 500:540] = 0.0
    rig = Rig(CAMERA, np.eye(4), depth=CAMERA, T_depth_cam0=np.eye(4))
    px = np.array([[320, 200], [200, 200], [520, 120], [450, 300]], float)
    z = depth.from_depth_camera(image, rig, CAMERA.normalise(px))
    assert np.isnan(z[[0, 2]]).all()
    assert z[[1, 3]] == pytest.approx([1.0, 3.0])


def test_no_points_are_no_error():
    """A blank wall, or every corner taken."""
    none, px = np.zeros((0, 2)), np.zeros((0, 2), np.float32)
    image, far = np.full((480, 640), 128, np.uint8), np.full((480, 640), 3.0, np.float32)
    rgbd = Rig(CAMERA, np.eye(4), depth=CAMERA, T_depth_cam0=np.eye(4))
    stereo = Rig(CAMERA, np.eye(4), cam1=CAMERA, T_cam1_cam0=T_CAM1_CAM0)
    assert depth.from_depth_camera(far, rgbd, none).shape == (0,)
    assert depth.from_stereo(image, image, stereo, px, none).shape == (0,)
    assert optical_flow.track_points(image, image, px, px)[0].shape == (0, 2)
    for frame, rig in ((Frame(0, 0, image, depth=far), rgbd), (Frame(0, 0, image, image), stereo)):
        surfaces = frame_image(frame, rig)
        assert len(surfaces.uv) == 0
        assert len(image_view(image, CAMERA, surfaces, 300)) == 0


@pytest.mark.long
def test_an_image_view_is_spread_and_has_the_depth_of_the_surfaces_near(scene):
    left, exact, right, _, _ = scene
    rig = Rig(CAMERA, np.eye(4), cam1=CAMERA, T_cam1_cam0=T_CAM1_CAM0)
    surfaces = frame_image(Frame(0, 0, left, right), rig)
    view = image_view(left, CAMERA, surfaces, 300)
    assert 250 < len(view) <= 300
    px = CAMERA.distort(view.uv.astype(float))
    cells = np.unique((px // 80).astype(int), axis=0)
    assert len(cells) > 30  # of 48
    known = ~np.isnan(view.points[:, 0])
    assert known.mean() > 0.7
    assert np.allclose(view.points[known, :2] / view.points[known, 2:], view.uv[known], atol=1e-5)
    at = np.rint(px[known]).astype(int)
    off = np.abs(view.points[known, 2] / exact[at[:, 1], at[:, 0]] - 1)
    assert np.median(off) < 0.05
    again = image_view(left, CAMERA, surfaces, 300)
    assert (again.descriptors == view.descriptors).all()
    unknown = image_view(left, CAMERA, KeyframeImage.empty(), 300)
    assert (unknown.descriptors == view.descriptors).all() and np.isnan(unknown.points).all()


def test_an_orb_feature_lies_on_the_plane_of_the_surface_near_it():
    """A slanted one: the depth is where the feature's own ray meets it. Too far from it, or where the plane
    is behind or far away, depth is unknown."""
    rng = np.random.default_rng(0)
    image = cv2.resize(rng.integers(0, 255, (60, 80), np.uint8), (640, 480))
    plane = np.array([0.2, -0.1, 0.5])
    at = np.array([[320.0, 240.0]])
    one = KeyframeImage(np.zeros(0, np.uint8), CAMERA.normalise(at), plane[None], [0.01])
    view = image_view(image, CAMERA, one, 600)
    known = ~np.isnan(view.points[:, 0])
    far_px = np.linalg.norm(CAMERA.distort(view.uv.astype(float)) - at, axis=1)
    assert known.sum() > 5 and (known == (far_px < 60)).all()
    np.testing.assert_allclose(view.points[known] @ plane, 1, atol=1e-5)
    for hidden in ([0.0, 0.0, -0.5], [0.0, 0.0, 0.02]):
        behind = KeyframeImage(np.zeros(0, np.uint8), CAMERA.normalise(at), [hidden], [0.01])
        assert np.isnan(image_view(image, CAMERA, behind, 600).points).all()
