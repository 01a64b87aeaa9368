"""Fisheye images: projected points, also to the sides and behind, and their depth."""

import numpy as np
import pytest
from helpers.rendered import checker as checkered
from helpers.rendered import furnished, looking, needs_opengl, plain
from test_gl_geometry import corners_of_walls, saddles

from share.geometry.camera import Camera
from share.geometry.se3 import inverse, transform
from share.lab.emulate.render.gl import GlRenderer
from share.lab.emulate.render.lens import fisheye_faces
from share.lab.emulate.sensor.imager import vignetting_gain
from share.lab.emulate.types import SceneInstant

pytestmark = [pytest.mark.long, needs_opengl]
LENS = (0.00348, 0.000715, -0.00205, 0.000203)
FISHEYE = Camera(512, 512, 190.98, 190.97, 254.93, 256.90, LENS, "equidistant")
WIDE = Camera(400, 300, 120.0, 120.0, 199.5, 149.5)  # no lens: what the fisheye's middle has to agree with


def test_corners_are_where_they_project_on_every_face():
    renderer, errors, angles = GlRenderer(plain(checkered())), [], []
    for k in range(3):
        T = looking(0.4 + 2.1 * k, 0.15 * (k % 3 - 1), (1.6 + 0.1 * k, 1.5, 1.4))
        image = renderer.radiance(FISHEYE, [SceneInstant(T)])
        points = transform(inverse(T), corners_of_walls(FISHEYE, T))
        px = FISHEYE.project_wide(points)
        seen = FISHEYE.is_inside(np.nan_to_num(px, nan=-1.0), 9)
        found = saddles(image, px[seen])
        ok = ~np.isnan(found[:, 0])
        errors.append((found - px[seen])[ok])
        angles.append(np.degrees(np.arctan2(np.hypot(*points[seen, :2].T), points[seen, 2]))[ok])
    error, angle = np.concatenate(errors), np.concatenate(angles)
    assert len(error) > 60 and (angle > 90).sum() > 5
    for part in (angle < 45, angle > 45):
        assert np.sqrt((error[part] ** 2).sum(1).mean()) < 0.1
    assert np.abs(error.mean(axis=0)).max() < 0.02


def test_depth_is_that_of_a_camera_without_a_lens():
    renderer, T = GlRenderer(furnished(30)), looking(0.3, 0.2)
    depth = renderer.depth(FISHEYE, SceneInstant(T))
    x, y = np.meshgrid(np.arange(5, 395, 7), np.arange(5, 295, 7))
    flat = renderer.depth(WIDE, SceneInstant(T))[y, x].ravel()
    rays = WIDE.directions(np.column_stack([x.ravel(), y.ravel()]).astype(float))
    px = np.rint(FISHEYE.project_wide(rays)).astype(int)
    assert np.median(np.abs(depth[px[:, 1], px[:, 0]] / flat - 1)) < 0.01  # to the nearest pixel
    behind = (
        FISHEYE.directions(np.stack(np.meshgrid(np.arange(0.0, 512, 4), np.arange(0.0, 512, 4)), -1))[..., 2]
        < 0
    )
    assert behind.any() and not depth[::4, ::4][behind].any()


def test_every_pixel_is_of_one_face():
    shown = np.sum([face.pixel_mask for face in fisheye_faces(FISHEYE)], axis=0)
    assert (shown == 1).all()
    narrow = Camera(512, 512, 190.0, 190.0, 255.0, 255.0, (-0.3, 0.0, 0.0, 0.0), "equidistant")
    assert (
        np.sum([face.pixel_mask for face in fisheye_faces(narrow)], axis=0) == 0
    ).any()  # beyond what the lens shows


def test_vignetting_at_the_corners_is_as_configured():
    light = vignetting_gain(FISHEYE, 0.5)
    assert light[257, 255] > 0.999 and abs(light.min() - 0.5) < 0.01
