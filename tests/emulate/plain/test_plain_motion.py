import functools

import numpy as np
import pytest

from share.emulate.plain.motion import STYLES, move
from share.emulate.plain.render import Renderer
from share.emulate.plain.room import make_room
from share.geometry.camera import Camera
from share.geometry.se3 import angle, inverse, transform

HZ = 20.0
room_of = functools.cache(make_room)
CAMERA = Camera(640, 480, 385.0, 385.0, 319.5, 239.5)
LIMITS = {"walker": (0.85, 65.0), "stroller": (0.75, 65.0), "robot": (0.36, 40.0)}  # m/s, degrees/s


@pytest.mark.parametrize("style", list(STYLES))
@pytest.mark.parametrize("seed", range(3))
def test_paths_are_smooth_and_touch_nothing(style, seed):
    boxes = room_of(seed).boxes
    T = move(STYLES[style], boxes[0, 1], np.arange(0, 60, 1 / HZ), (seed, 2))
    p = T[:, :3, 3]
    velocity = np.diff(p, axis=0) * HZ
    speed, turn = np.linalg.norm(velocity, axis=1), np.degrees(angle(inverse(T[:-1]) @ T[1:])) * HZ
    fastest, quickest = LIMITS[style]
    assert speed.max() < fastest and turn.max() < quickest
    assert speed[:8].max() < 0.02  # stands at first
    assert speed[40:].mean() > 0.8 * STYLES[style].speed
    assert np.abs(np.diff(velocity, axis=0)).max() * HZ < 4.0  # m/s^2: no jump
    assert (p > 0.3).all() and (p < boxes[0, 1] - 0.3).all()
    for lo, hi in boxes[1:]:
        assert np.linalg.norm(np.maximum(0, np.maximum(lo - p, p - hi)), axis=1).min() > 0.3


def test_a_robot_is_planar_and_people_are_not():
    size, seconds = np.array([9.0, 6.0, 3.0]), np.arange(0, 20, 1 / HZ)
    robot, person = (move(STYLES[name], size, seconds, (1, 2)) for name in ("robot", "walker"))
    assert np.ptp(robot[:, 2, 3]) < 1e-12
    assert np.allclose(robot[:, 2, 0], 0, atol=1e-12)  # the camera's x axis stays level
    assert 0.02 < np.ptp(person[:, 2, 3]) < 0.08
    assert (person[:, 2, 1] < -0.9).all()  # the head stays upright: image down is world down


def test_same_seed_same_path_and_a_longer_run_goes_on_elsewhere():
    size = np.array([9.0, 6.0, 3.0])
    seconds = np.arange(0, 40, 1 / HZ)
    one = move(STYLES["walker"], size, seconds, (1, 2))
    assert np.array_equal(one, move(STYLES["walker"], size, seconds, (1, 2)))
    assert not np.allclose(one, move(STYLES["walker"], size, seconds, (2, 2)))


def test_all_see_the_same_wall_at_the_start():
    room = room_of(0)
    first = {name: move(style, room.size, np.array([0.0, 1.0]), (0, 2))[0] for name, style in STYLES.items()}
    _, depth = Renderer(room, CAMERA).render(first["robot"])
    u, v = np.meshgrid(np.arange(0, 640, 10), np.arange(0, 480, 10))
    rays = np.column_stack([CAMERA.normalise(np.column_stack([u.ravel(), v.ravel()])), np.ones(u.size)])
    points = transform(first["robot"], rays * depth[::10, ::10].reshape(-1, 1))
    for name in ("walker", "stroller"):
        in_view = transform(inverse(first[name]), points)
        seen = CAMERA.inside(CAMERA.project(in_view))
        between = np.arccos(
            np.sum(_unit(points - first["robot"][:3, 3]) * _unit(points - first[name][:3, 3]), axis=1)
        )
        assert (seen & (np.degrees(between) < 30)).mean() > 0.3


def _unit(v):
    return v / np.linalg.norm(v, axis=1, keepdims=True)
