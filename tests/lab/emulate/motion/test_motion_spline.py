import numpy as np
import pytest
from helpers.motion_sim import driver, every, integrated, person

from share.geometry import se3
from share.lab.emulate.motion.spline import continuous_quaternions, spline_through
from share.lab.emulate.types import GRAVITY


@pytest.fixture
def path(rng):
    t = np.arange(0, 6, 0.01)
    p = np.stack([np.sin(t), np.cos(0.7 * t), 0.3 * np.sin(2 * t)], axis=1)
    phi = np.stack([2.5 * np.sin(0.9 * t), 1.5 * t, np.cos(t)], axis=1)  # passes angles beyond pi
    q = se3.quat_from_matrix(se3.so3_exp(phi))
    return spline_through(5_000_000_000, t, p, q * rng.choice([-1, 1], (len(t), 1)))


@pytest.mark.parametrize("motion", [person, driver])
def test_inertial_readings_integrate_to_the_path(motion):
    path = motion()
    found, truth = integrated(path, 200, 10.0), path.poses(every(path, 1, 10.0)[-1:])[0]
    assert np.linalg.norm(found[:3, 3] - truth[:3, 3]) < 1e-3
    assert np.degrees(se3.rotation_angle(found[:3, :3].T @ truth[:3, :3])) < 0.01


def test_derivatives_are_those_of_the_poses(path):
    h = 1_000_000
    stamps = np.arange(path.start_ns + 10**8, path.end_ns - 10**8, 50_000_001)
    before, here, after = (path.poses(stamps + d) for d in (-h, 0, h))
    rate, force = path.inertial(stamps)
    turned = se3.so3_log(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]) / 2e-3
    assert np.abs(rate - turned).max() < 1e-4
    acceleration = (before + after - 2 * here)[:, :3, 3] / 1e-6
    felt = np.einsum("nji,nj->ni", here[:, :3, :3], acceleration + np.array([0, 0, GRAVITY]))
    assert np.abs(force - felt).max() < 1e-3
    assert np.abs(path.velocity(stamps) - (after - before)[:, :3, 3] / 2e-3).max() < 1e-5


def test_poses_are_rotations_and_pass_through_the_knots(path):
    T = path.poses(np.arange(path.start_ns, path.end_ns, 7_000_001))
    assert np.allclose(T[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2), np.eye(3), atol=1e-12)
    knot = path.poses(np.array([path.start_ns + 3_000_000_000]))[0]
    assert np.allclose(knot[:3, 3], (np.sin(3), np.cos(2.1), 0.3 * np.sin(6)), atol=1e-9)


def test_placed_moves_the_poses_and_changes_no_reading(path):
    T = se3.from_rt(se3.so3_exp(np.array([0, 0, 2.2])), np.array([3.0, -1, 0.5]))
    stamps = every(path, 50)
    moved = path.transformed(T)
    assert np.allclose(moved.poses(stamps), T @ path.poses(stamps), atol=1e-12)
    for a, b in zip(moved.inertial(stamps), path.inertial(stamps), strict=True):
        assert np.allclose(a, b, atol=1e-9)
    with pytest.raises(ValueError, match="vertical"):
        path.transformed(se3.from_rt(se3.so3_exp(np.array([0.1, 0, 0])), np.zeros(3)))


def test_poses_outside_the_span_are_refused(path):
    with pytest.raises(ValueError, match="spans"):
        path.poses(np.array([path.start_ns - 1]))


def test_signs_of_quaternions_do_not_matter(rng):
    q = se3.quat_from_matrix(se3.so3_exp(np.linspace(0, 9, 100)[:, None] * np.array([0, 0.6, 0.8])))
    mixed = continuous_quaternions(3 * q * rng.choice([-1, 1], (100, 1)))
    assert (np.einsum("ni,ni->n", mixed[1:], mixed[:-1]) > 0.99).all()


def test_too_few_knots_are_refused():
    with pytest.raises(ValueError, match="at least 6"):
        spline_through(0, np.arange(5.0), np.zeros((5, 3)), np.ones((5, 4)))
