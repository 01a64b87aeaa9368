"""The renderer against geometry: depth on the planes, and textures that stay where they are."""

import cv2
import numpy as np
import pytest
from helpers.plain_walk import CAMERA, MOTIONS, gray, poses

from share.geometry.camera import Camera
from share.geometry.se3 import from_rt, inverse, transform
from share.lab.emulate.plain.render import PlainRoomRenderer
from share.lab.emulate.plain.room import make_room

pytestmark = pytest.mark.long

SECONDS = np.arange(0, 20, 0.05)


@pytest.fixture(scope="module")
def room():
    return make_room(0)


@pytest.fixture(scope="module")
def renderer(room):
    return PlainRoomRenderer(room, CAMERA)


@pytest.fixture(scope="module")
def path():
    return poses("walker", SECONDS, 0)


def bilinear(image, px):
    columns = (px[i : i + 30000].astype(np.float32) for i in range(0, len(px), 30000))
    return np.concatenate([cv2.remap(image, c[:, :1], c[:, 1:], cv2.INTER_LINEAR)[:, 0] for c in columns])


def nearest(image, px):
    column, row = np.clip(np.rint(px).astype(int), 0, np.array(image.shape[::-1]) - 1).T
    return image[row, column]


def pixels(step):
    u, v = np.meshgrid(np.arange(5, 635, step), np.arange(5, 475, step))
    return np.column_stack([u.ravel(), v.ravel()]).astype(float)


def back_project(px, z, T_world_cam):
    rays = np.column_stack([CAMERA.normalise(px), np.ones(len(px))])
    return transform(T_world_cam, rays * z[:, None])


def test_a_wall_seen_straight_on_has_its_distance_everywhere(room, renderer):
    ahead = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])  # looks along +x
    _, depth = renderer.render(from_rt(ahead, np.array([3.0, 3.0, 2.6])))
    wall = np.isclose(depth, 6.0, atol=0.001)
    assert wall.mean() > 0.1
    points = back_project(pixels(1), nearest(depth, pixels(1)), from_rt(ahead, np.array([3.0, 3, 2.6])))
    assert points[:, 0].max() < room.size[0] + 0.001


def test_every_pixel_lies_on_a_face_and_nothing_stands_before_it(room, renderer, path):
    for T in path[::80]:
        _, depth = renderer.render(T)
        px = pixels(7)
        points = back_project(px, nearest(depth, px), T)
        shell = [np.abs(b[:, None] - points).min(axis=(0, 2)) for b in room.boxes]
        inside = [((points > b[0] - 1e-3) & (points < b[1] + 1e-3)).all(axis=1) for b in room.boxes]
        on_face = np.array([s < 1e-3 for s in shell]) & np.array(inside)
        assert on_face.any(axis=0).all()
        halfway = T[:3, 3] + (points - T[:3, 3]) * np.linspace(0.02, 0.999, 40)[:, None, None]
        for b in room.boxes[1:]:
            assert not ((halfway > b[0] + 2e-3) & (halfway < b[1] - 2e-3)).all(axis=2).any()


def test_one_view_predicts_another(renderer, path):
    for i, j in ((20, 24), (200, 206)):
        image_i, depth_i = (a.copy() for a in renderer.render(path[i]))
        image_j, depth_j = renderer.render(path[j])
        px = pixels(3)
        z = nearest(depth_i, px)
        in_j = transform(inverse(path[j]), back_project(px, z, path[i]))
        at = CAMERA.project(in_j)
        seen = CAMERA.is_inside(at, 2)
        seen[seen] &= np.abs(bilinear(depth_j, at[seen]) / in_j[seen, 2] - 1) < 0.01
        assert seen.mean() > 0.5
        difference = bilinear(image_j, at[seen]).astype(float) - bilinear(image_i, px[seen])
        assert np.median(np.abs(difference)) < 2.0
        assert np.percentile(np.abs(difference), 90) < 10.0


@pytest.mark.parametrize("who", MOTIONS)
def test_tracks_follow_the_exact_projection(renderer, who):
    path, errors = poses(who, SECONDS, 0), []
    for k in range(10, 390, 47):
        depth, depth_b = (renderer.render(path[i])[1] for i in (k, k + 1))
        a, b = (gray(path[i], 0, i) for i in (k, k + 1))
        p = cv2.goodFeaturesToTrack(a, 200, 0.005, 15)
        q, found, _ = cv2.calcOpticalFlowPyrLK(a, b, p, None, winSize=(21, 21), maxLevel=3)
        p, q = p[:, 0].astype(float), q[:, 0]
        z = 1 / bilinear(1 / depth, p)  # inverse depth is affine on a plane
        in_b = transform(inverse(path[k + 1]), back_project(p, z, path[k]))
        at = CAMERA.project(in_b)
        good = (found[:, 0] > 0) & CAMERA.is_inside(at, 5) & (np.abs(z / nearest(depth, p) - 1) < 0.01)
        good &= np.abs(nearest(depth_b, at) / in_b[:, 2] - 1) < 0.02
        assert good.sum() > 100
        errors.extend(np.linalg.norm(q - at, axis=1)[good])
    assert np.median(errors) < 0.1
    assert np.percentile(errors, 90) < 0.35


def test_corner_statistics_are_near_those_of_a_real_image():
    """A real EuRoC image: about 750 FAST corners, in 80 % of 8 x 8 cells."""
    corners, cells = [], []
    for who in MOTIONS:
        for k, T in enumerate(poses(who, SECONDS[::50], 0)):
            image = gray(T, 0, k)
            found = cv2.FastFeatureDetector_create(20).detect(image)
            corners.append(len(found))
            cells.append(len({(int(c.pt[0]) // 80, int(c.pt[1]) // 60) for c in found}) / 64)
            assert 60 < image.mean() < 190
    assert 500 < np.median(corners) < 1200
    assert min(corners) > 200
    assert np.mean(cells) > 0.7


def test_a_lens_or_too_many_faces_are_refused(room):
    with pytest.raises(ValueError, match="distortion"):
        PlainRoomRenderer(room, Camera(64, 48, 40, 40, 31.5, 23.5, (0.1, 0, 0, 0)))
