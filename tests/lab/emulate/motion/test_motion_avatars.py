import numpy as np
import pytest
from helpers.motion_sim import driver, every, person

from share.geometry import se3
from share.lab.emulate.motion.avatars import Avatar, avatar_shapes, body_height
from share.lab.emulate.motion.spline import spline_through

MOTIONS = {"person": person, "robot": driver, "drone": driver}


@pytest.mark.parametrize(("look", "motion"), MOTIONS.items())
def test_every_part_has_a_pose(look, motion):
    path = motion()
    T = Avatar(look, path).part_poses(every(path, 10))
    assert T.shape == (len(every(path, 10)), len(avatar_shapes(look, path, (1,))), 4, 4)
    assert np.allclose(T[..., :3, :3] @ np.swapaxes(T[..., :3, :3], -1, -2), np.eye(3), atol=1e-6)


def test_feet_stay_on_the_floor_and_swing_in_turn():
    path = person(0, 1.4)
    stamps = every(path, 50)
    T = Avatar("person", path).part_poses(stamps)
    feet = T[:, -2:, :3, 3]
    soles = feet[..., 2] - 0.039 * body_height("person", path)
    assert soles.min() > -0.02 and soles.min(axis=1).max() < 0.08
    speed = np.linalg.norm(np.diff(feet[..., :2], axis=0), axis=2) * 50
    walking = np.linalg.norm(path.velocity(stamps)[1:, :2], axis=1) > 1.0
    assert np.median(speed[walking].min(axis=1)) < 0.45  # one foot nearly stands
    assert np.median(speed[walking].max(axis=1)) > 1.8  # while the other swings


def test_the_head_is_where_the_headset_is_and_limbs_hang_together():
    path = person()
    stamps = every(path, 10)
    T, body = Avatar("person", path).part_poses(stamps), path.poses(stamps)
    assert np.allclose(np.linalg.norm(T[:, 0, :3, 3] - body[:, :3, 3], axis=1), 0.10, atol=1e-9)
    assert np.allclose(T[:, 0, :3, 0], body[:, :3, 2], atol=1e-9)
    thigh, shin = T[:, 6:8, :3, 3], T[:, 8:10, :3, 3]
    assert np.allclose(np.linalg.norm(thigh - shin, axis=2), 0.245 * body_height("person", path), atol=1e-9)
    off = T[:, 0, :2, 3] - T[:, 1, :2, 3]
    assert np.linalg.norm(off, axis=1).max() < 0.45  # the head is over the hips


def test_parts_do_not_depend_on_the_axes_of_the_body():
    t = np.arange(0, 10, 0.02)
    own = person()
    T = own.poses(own.start_ns + np.round(t * 1e9).astype(np.int64))
    mount = se3.from_rt(se3.so3_exp(np.array([0.3, -2.0, 1.1])), np.zeros(3))
    turned = T @ se3.inverse(mount)
    a, b = (
        spline_through(own.start_ns, t, S[:, :3, 3], se3.quat_from_matrix(S[:, :3, :3])) for S in (T, turned)
    )
    stamps = every(a, 5)
    same = Avatar("person", b, mount).part_poses(stamps)
    assert np.allclose(Avatar("person", a).part_poses(stamps), same, atol=1e-5)


def test_a_robot_stands_on_the_floor_and_a_drone_flies():
    path = driver()
    stamps = every(path, 10)
    base, drone = (Avatar(look, path).part_poses(stamps)[:, 0] for look in ("robot", "drone"))
    body = path.poses(stamps)
    assert np.allclose(base[:, 2, 3], 0) and np.allclose(base[:, 2, 2], 1)
    assert np.allclose(base[:, :2, 3], body[:, :2, 3]) and np.allclose(drone[:, :3, 3], body[:, :3, 3])
    assert drone[:, 2, 2].min() > 0.99


def test_the_body_depends_on_the_seed_alone():
    one, same, other = (avatar_shapes("person", person(), (k,))[1] for k in (1, 1, 2))
    assert np.array_equal(one.mesh.uv, same.mesh.uv) and one.materials == same.materials
    assert one.materials != other.materials
