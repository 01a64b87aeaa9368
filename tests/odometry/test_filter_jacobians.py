"""Every derivative of the filter against numerical differences."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from helpers.imu_world import GRAVITY, NOISE, Path, imu_of, rig

from share.geometry import se3
from share.odometry import dormant_features, feature_matching, filter
from share.odometry import state as filter_state
from share.odometry.imu_propagation import integrate
from share.odometry.state import CORE_SIZE, TIMESHIFT, initial_state

RIG = rig()
STEP = 1e-6


@pytest.fixture
def state():
    """Two keyframes, five features each, everything correlated with everything."""
    rng, path = np.random.default_rng(3), Path(2)
    T = path.poses(np.array([0.0, 0.3, 0.7]))
    s = initial_state(
        0,
        T[0],
        path.velocity(np.array([0.7]))[0],
        np.full(3, 0.01),
        np.full(3, -0.05),
        RIG.T_body_cam0,
        np.full(CORE_SIZE, 0.1),
    )
    for k in range(2):
        s.T = T[k]
        filter_state.add_keyframe(s, 10 + k, np.array([0.1, 0.2, -0.3]))
        filter_state.add_features(
            s,
            np.arange(5) + 5 * k,
            np.full(5, k),
            rng.uniform(-0.4, 0.4, (5, 2)),
            rng.uniform(0.2, 0.8, 5),
            np.full(5, 0.05),
        )
    s.T = T[2]
    A = rng.normal(size=(s.size, s.size)) * 0.01
    s.cov = A @ A.T + np.diag(np.full(s.size, 1e-4))
    return s


def moved(state, error):
    out = copy.deepcopy(state)
    filter.correct_means(out, error)
    return out


def basis(state, k):
    e = np.zeros(state.size)
    e[k] = STEP
    return e


def looked(state, T):
    """Where features show in an image."""
    return feature_matching.predict(state, np.arange(10), T).uv


@pytest.mark.parametrize("right", [False, True])
def test_measurement_jacobians(state, right):
    T = RIG.T_cam1_cam0 if right else None
    which = np.arange(10)
    rate = np.array([0.3, -0.2, 0.5])
    seen = feature_matching.predict(state, which, T)
    rows = filter.feature_measurements(state, which, seen, np.zeros((10, 2)), np.ones(10), np.zeros(10), rate)
    H = np.zeros((20, state.size))
    H[:, :CORE_SIZE] = rows.H_core.reshape(20, CORE_SIZE)
    for i in range(10):
        H[2 * i : 2 * i + 2, state.keyframe_columns(rows.anchor[i])] = rows.H_anchor[i]
        H[2 * i : 2 * i + 2, state.features_start + i] = rows.H_rho[i]
    for k in range(state.size):
        if k == TIMESHIFT:
            continue
        up, down = (looked(moved(state, s * basis(state, k)), T) for s in (1, -1))
        assert np.allclose(H[:, k], ((up - down) / (2 * STEP)).ravel(), atol=1e-6, rtol=1e-6)
    later, sooner = copy.deepcopy(state), copy.deepcopy(state)
    V = filter_state.twist(state, rate)
    later.T, sooner.T = se3.exp(V * STEP) @ state.T, se3.exp(-V * STEP) @ state.T
    up, down = (looked(s, T) for s in (later, sooner))
    assert np.allclose(H[:, TIMESHIFT], ((up - down) / (2 * STEP)).ravel(), atol=1e-6, rtol=1e-6)
    HP, S = filter.innovation_covariance(state, rows)
    assert np.allclose(HP, H @ state.cov, atol=1e-14)
    assert np.allclose(S, H @ state.cov @ H.T + np.eye(20), atol=1e-14)


def test_correlated_noise_is_shared_by_both_cameras(state):
    which, rate = np.arange(10), np.zeros(3)
    sigma, lasting = np.full(10, 0.5), np.full(10, 0.3)
    left, right = (
        filter.feature_measurements(
            state, which, feature_matching.predict(state, which, T), np.zeros((10, 2)), sigma, lasting, rate
        )
        for T in (None, RIG.T_cam1_cam0)
    )
    right = right.take(np.arange(3, 7))
    rows = left.concatenate(right)
    rows = rows.take(np.argsort(rows.anchor, kind="stable"))
    alone, together = (
        filter.innovation_covariance(state, r)[1]
        for r in (replace(rows, correlated_sigma=0 * rows.correlated_sigma), rows)
    )
    same = (rows.feature[:, None] == rows.feature)[:, None, :, None] * np.eye(2)[:, None, :]
    shared = filter.CORRELATION_INFLATION * 0.3**2 * same.reshape(alone.shape)
    assert np.allclose(together - alone, shared, atol=1e-14)


def test_nis_of_features_outside_the_state_is_that_in_it(state):
    """As a dormant feature is gated before it is reactivated."""
    grown, rng, rate = copy.deepcopy(state), np.random.default_rng(8), np.array([0.2, 0.1, -0.3])
    sigma = np.array([0.01, 0.02, 0.05])
    ids, anchor = np.arange(100, 103), np.array([1, 0, 1])
    filter_state.add_features(grown, ids, anchor, rng.uniform(-0.2, 0.2, (3, 2)), np.full(3, 0.3), sigma)
    which = np.arange(10, 13)
    seen = feature_matching.predict(grown, which)
    uv = seen.uv + rng.normal(0, 0.01, (3, 2))
    rows = filter.feature_measurements(grown, which, seen, uv, np.full(3, 1e-3), np.full(3, 2e-3), rate)
    _, S = filter.innovation_covariance(grown, rows, double_precision=True)
    assert np.allclose(dormant_features.nis(state, rows, sigma), filter.nis(rows, S), rtol=1e-9)


def numeric_cov(state, motion):
    """Return the covariance (6, 6) of a motion of a state, on the right, by differences."""
    J = np.zeros((6, state.size))
    for k in range(state.size):
        up, down = (motion(moved(state, sign * basis(state, k))) for sign in (1, -1))
        J[:, k] = se3.log(se3.inverse(motion(state)) @ up) - se3.log(se3.inverse(motion(state)) @ down)
    J /= 2 * STEP
    return J @ state.cov @ J.T


def test_covariance_of_a_relative_pose(state):
    expected = numeric_cov(state, lambda s: se3.inverse(s.keyframe_poses[0]) @ s.keyframe_poses[1])
    assert np.allclose(filter.relative_pose_cov(state, 0, 1), expected, atol=1e-9, rtol=1e-5)


def test_covariance_of_the_motion_since_the_origin(state):
    expected = numeric_cov(state, lambda s: se3.inverse(s.T_origin) @ s.T)
    assert np.allclose(filter.motion_cov_since_origin(state), expected, atol=1e-9, rtol=1e-5)


def test_a_state_that_is_moved_is_as_uncertain_about_its_body_as_before():
    """As after a relocalisation: at another place, with another heading."""
    rng = np.random.default_rng(3)
    s = initial_state(
        0, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), RIG.T_body_cam0, np.ones(CORE_SIZE)
    )
    A = rng.normal(size=(CORE_SIZE, CORE_SIZE)) * 0.01
    s.cov[:CORE_SIZE, :CORE_SIZE] = A @ A.T
    filter_state.set_origin(s)
    there = copy.deepcopy(s)
    filter_state.move(there, se3.exp(np.array([0.02, -0.01, 2.5, 3.0, -4.0, 1.0])))
    on_the_right = [
        se3.adjoint(se3.inverse(x.T)) @ x.cov[:6, :6] @ se3.adjoint(se3.inverse(x.T)).T for x in (s, there)
    ]
    assert np.allclose(*on_the_right, atol=1e-15)
    with_bias = [x.T[:3, :3].T @ x.cov[:3, 12:15] for x in (s, there)]  # tilt and accelerometer bias
    assert np.allclose(*with_bias, atol=1e-15)
    assert np.allclose(*(x.T[:3, :3].T @ x.cov[6:9, 12:15] for x in (s, there)), atol=1e-15)
    assert (there.T_origin == there.T).all()
    assert np.abs(filter.motion_cov_since_origin(there)).max() < 1e-9


def test_twist_is_the_derivative_of_the_pose():
    path, t = Path(4), np.array([1.0])
    s = initial_state(
        0, path.poses(t)[0], path.velocity(t)[0], np.zeros(3), np.zeros(3), np.eye(4), np.ones(CORE_SIZE)
    )
    rate = path.inertial(t)[0][0]
    moved = path.poses(t + 1e-4)[0] @ se3.inverse(path.poses(t - 1e-4)[0])
    assert np.allclose(filter_state.twist(s, rate), se3.log(moved) / 2e-4, atol=1e-5)


def test_integration_follows_the_path():
    path = Path(5)
    imu, _, _ = imu_of(path, np.arange(0, 2.005, 0.005), bg=np.full(3, 0.02), ba=np.full(3, 0.1))
    t0, t1 = np.array([0.1037]), np.array([1.9012])
    start, end = path.poses(t0)[0], path.poses(t1)[0]
    out = integrate(
        start,
        path.velocity(t0)[0],
        np.full(3, 0.02),
        np.full(3, 0.1),
        imu,
        103_700_000,
        1_901_200_000,
        NOISE,
        GRAVITY,
    )
    assert np.linalg.norm(out.T[:3, 3] - end[:3, 3]) < 2e-4
    assert se3.rotation_angle(se3.inverse(out.T) @ end) < 5e-5
    assert np.allclose(out.v, path.velocity(t1)[0], atol=3e-4)


@pytest.mark.parametrize(("dt", "close"), [(0.005, 2e-5), (0.0005, 1e-6)])
def test_transition(dt, close):
    """Pose, velocity and biases over 0.1 s. The derivative is that of the motion itself, not of its steps."""
    path = Path(6)
    imu, _, _ = imu_of(path, np.arange(0, 0.205, dt))
    t = np.array([0.05])
    s = initial_state(
        50_000_000,
        path.poses(t)[0],
        path.velocity(t)[0],
        np.full(3, 0.01),
        np.full(3, -0.05),
        RIG.T_body_cam0,
        np.ones(CORE_SIZE),
    )

    def after(error):
        x = moved(s, error)
        m = integrate(x.T, x.v, x.bg, x.ba, imu, x.stamp_ns, 150_000_000, NOISE, GRAVITY)
        x.T, x.v = m.T, m.v
        return x, m

    mean, motion = after(np.zeros(s.size))
    for k in range(15):
        (up, _), (down, _) = after(basis(s, k)), after(-basis(s, k))
        turn = se3.log(up.T @ se3.inverse(down.T)) / (2 * STEP)
        nu = (up.v - down.v) / (2 * STEP) - np.cross(turn[:3], mean.v)
        numeric = np.concatenate([turn, nu, (up.bg - down.bg) / (2 * STEP), (up.ba - down.ba) / (2 * STEP)])
        assert np.allclose(motion.transition[:, k], numeric, atol=close), k


@pytest.mark.long
def test_noise_covariance_against_many_runs():
    path, rng = Path(7), np.random.default_rng(8)
    t = np.arange(0, 0.505, 0.005)
    clean, _, _ = imu_of(path, t)
    at = np.array([0.0])
    args = (np.zeros(3), np.zeros(3))
    T, v = path.poses(at)[0], path.velocity(at)[0]
    mean = integrate(T, v, *args, clean, 0, 500_000_000, NOISE, GRAVITY)
    errors = []
    for _ in range(800):
        noisy = copy.copy(clean)
        object.__setattr__(
            noisy, "gyro", clean.gyro + rng.normal(0, NOISE.gyro_density * np.sqrt(200), clean.gyro.shape)
        )
        object.__setattr__(
            noisy, "accel", clean.accel + rng.normal(0, NOISE.accel_density * np.sqrt(200), clean.accel.shape)
        )
        m = integrate(T, v, *args, noisy, 0, 500_000_000, NOISE, GRAVITY)
        xi = se3.log(m.T @ se3.inverse(mean.T))
        errors.append(np.concatenate([xi, m.v - mean.v - np.cross(xi[:3], mean.v)]))
    sampled = np.cov(np.array(errors).T)
    ratio = np.linalg.eigvals(np.linalg.solve(mean.noise_cov[:9, :9], sampled)).real
    assert ratio.min() > 0.75
    assert ratio.max() < 1.3
