"""Preintegration, derivatives, normal equations and clock offset, each against something simpler."""

import numpy as np
import pytest
from helpers.mocap_sim import BODY, NOISE, START_NS, TILT, G, Motion, record_imu, record_mocap

from share.errors import CalibrationMismatchError
from share.geometry import se3
from share.lab.mocap import factors
from share.lab.mocap.factors import preintegrate
from share.lab.mocap.initialisation import initial_rotation
from share.lab.mocap.offset import find_offset
from share.lab.mocap.problem import normal_equations
from share.lab.mocap.state import NODE_SIZE, SHARED_SIZE, MocapImuState
from share.types import F64, I64, ImuBatch

MS = 1_000_000
MOTION = Motion()
IMU = record_imu(MOTION, 3, None)
NODES = START_NS + np.arange(500, 900, 40) * MS + 1_234_567  # between samples
NO_BREAK = np.zeros(len(NODES) - 1, bool)


def start_state(rng: np.random.Generator) -> MocapImuState:
    """A state near the truth."""
    t = (NODES - START_NS) * 1e-9
    T, n = MOTION.pose(t), len(NODES)
    v = (MOTION.pose(t + 1e-4) - MOTION.pose(t - 1e-4))[:, :3, 3] / 2e-4
    exact = MocapImuState(
        NODES, T[:, :3, :3], T[:, :3, 3], v, np.zeros((n, 3)), np.zeros((n, 3)), TILT, BODY, int(NODES[5])
    )
    return exact.updated(
        rng.normal(0, 0.01, (n, NODE_SIZE)), rng.normal(0, 0.01, SHARED_SIZE) * ([1] * 8 + [0, 0])
    )


def observations_at(state: MocapImuState) -> factors.MocapObservations:
    stamps = NODES[:-1] + 13 * MS
    T = MOTION.pose((stamps - START_NS) * 1e-9) @ BODY
    return factors.mocap_observations(state, IMU, G, stamps, T, np.ones(6))


def test_preintegration_leads_from_one_pose_to_the_next() -> None:
    start: I64 = START_NS + np.array([100, 503, 711]) * MS + 17
    end = start + np.array([400, 1000, 2]) * MS
    zero = np.zeros((3, 3))
    inc = preintegrate(IMU, start, end, zero, zero)
    a, b = (MOTION.pose((t - START_NS) * 1e-9) for t in (start, end))
    v = (MOTION.pose((start - START_NS) * 1e-9 + 1e-4) - MOTION.pose((start - START_NS) * 1e-9 - 1e-4)) / 2e-4
    t = inc.dt[:, None]
    p = a[:, :3, 3] + v[:, :3, 3] * t - np.array([0, 0, G / 2]) * t**2
    p += np.einsum("nij,nj->ni", a[:, :3, :3], inc.dp)
    assert np.abs(p - b[:, :3, 3]).max() < 1e-4
    assert np.degrees(se3.rotation_angle(b[:, :3, :3].swapaxes(1, 2) @ a[:, :3, :3] @ inc.dR)).max() < 3e-3
    np.testing.assert_allclose(inc.rate_end, MOTION.inertial((end - START_NS) * 1e-9)[0], atol=1e-3)


@pytest.mark.long
def test_the_covariance_of_preintegration_is_the_sample_covariance() -> None:
    rng = np.random.default_rng(5)
    start, end = np.full(400, START_NS + 3 * MS), np.full(400, START_NS + 103 * MS)
    zero, spread = np.zeros((400, 3)), []
    exact = preintegrate(IMU, start[:1], end[:1], zero[:1], zero[:1], NOISE)
    part = slice(0, 30)
    for _ in range(400):
        noisy = ImuBatch(
            IMU.stamps_ns[part],
            IMU.gyro[part] + rng.normal(0, NOISE.gyro_density * np.sqrt(200), (30, 3)),
            IMU.accel[part] + rng.normal(0, NOISE.accel_density * np.sqrt(200), (30, 3)),
        )
        inc = preintegrate(noisy, start[:1], end[:1], zero[:1], zero[:1])
        turn = se3.so3_log(exact.dR.swapaxes(1, 2) @ inc.dR)
        spread.append(np.concatenate([turn, inc.dp - exact.dp, inc.dv - exact.dv], axis=1)[0])
    ratio = np.std(spread, axis=0) / np.sqrt(np.diag(exact.cov[0]))
    np.testing.assert_allclose(ratio, 1, atol=0.15)


@pytest.mark.parametrize("shared", [False, True])
def test_derivatives_equal_finite_differences(rng: np.random.Generator, shared: bool) -> None:
    """Each column against a central difference, for both kinds of measurement."""
    state, step = start_state(rng), 1e-5
    n = len(NODES)

    def residuals(at: MocapImuState) -> tuple[F64, F64]:
        return factors.imu_chain(at, IMU, NOISE, G, NO_BREAK).raw, observations_at(at).residual

    chain, seen = factors.imu_chain(state, IMU, NOISE, G, NO_BREAK), observations_at(state)
    whiten = np.linalg.inv(np.linalg.cholesky(chain.cov))
    for k in range(SHARED_SIZE if shared else NODE_SIZE):
        nodes, common = np.zeros((n, NODE_SIZE)), np.zeros(SHARED_SIZE)
        if shared:
            common[k] = step
        else:
            nodes[::2, k] = step  # every other node: before in one interval, after in the next
        plus, minus = residuals(state.updated(nodes, common)), residuals(state.updated(-nodes, -common))
        by_imu, by_mocap = ((a - b) / (2 * step) for a, b in zip(plus, minus, strict=True))
        if shared:
            np.testing.assert_allclose(seen.jacobian_shared[:, :, k], by_mocap, atol=2e-3)
            continue
        even = np.arange(n - 1) % 2 == 0
        column = np.where(even[:, None], chain.jacobian_before[:, :9, k], chain.jacobian_after[:, :9, k])
        if k < 9:  # biases also enter through their walk, below the ninth row
            unwhitened = np.linalg.solve(whiten, column[..., None])[..., 0]
            np.testing.assert_allclose(unwhitened, by_imu, atol=1e-4)
        np.testing.assert_allclose(
            np.where(even[:, None], seen.jacobian_node[:, :, k], 0), by_mocap, atol=1e-4
        )


def test_normal_equations_are_those_of_all_residuals_stacked(rng: np.random.Generator) -> None:
    state = start_state(rng)
    chain, seen = factors.imu_chain(state, IMU, NOISE, G, NO_BREAK), observations_at(state)
    n, weight = len(NODES), rng.uniform(0.2, 1, len(seen.node))
    prior, deviation = rng.uniform(1, 2, SHARED_SIZE), rng.normal(size=SHARED_SIZE)
    system = normal_equations(chain, seen, weight, prior, deviation, n)
    J = np.zeros((len(chain.residual) * 15 + len(weight) * 6, n * NODE_SIZE + SHARED_SIZE))
    by_chain, by_mocap = np.split(J, [len(chain.residual) * 15])
    for i, (before, after) in enumerate(zip(chain.jacobian_before, chain.jacobian_after, strict=True)):
        by_chain[i * 15 : i * 15 + 15, i * NODE_SIZE : (i + 2) * NODE_SIZE] = np.hstack([before, after])
    for k, node in enumerate(seen.node):
        rows = by_mocap[6 * k : 6 * k + 6]
        rows[:, node * NODE_SIZE : (node + 1) * NODE_SIZE] = seen.jacobian_node[k]
        rows[:, -SHARED_SIZE:] = seen.jacobian_shared[k]
    weights = np.concatenate([np.ones(len(by_chain)), np.repeat(weight, 6)])
    H = J.T @ (J * weights[:, None])
    g = -J.T @ (np.concatenate([chain.residual.ravel(), seen.residual.ravel()]) * weights)
    H[-SHARED_SIZE:, -SHARED_SIZE:] += np.diag(prior)
    g[-SHARED_SIZE:] -= prior * deviation
    band = np.arange(n - 1)
    nodes, border = H[:-SHARED_SIZE, :-SHARED_SIZE].reshape(n, NODE_SIZE, n, NODE_SIZE), H[:, -SHARED_SIZE:]
    for found, expected in (
        (system.blocks[:, 0], nodes[np.arange(n), :, np.arange(n)]),
        (system.blocks[:-1, 1], nodes[band, :, band + 1]),
        (np.append(system.edge, system.corner), border),
        (np.append(system.g_nodes, system.g_border), g),
    ):
        error = np.abs(found.ravel() - expected.ravel())
        assert error.max() < 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize("offset_s", [0.0, 0.21, -7.3, 1e6])
def test_the_clock_offset_is_found(offset_s: float) -> None:
    offset_ns = round(offset_s * 1e9)
    motion = Motion(2)
    imu, mocap = record_imu(motion, 40), record_mocap(motion, 25, offset_ns)
    assert find_offset(imu, mocap, None).offset_ns == pytest.approx(offset_ns, abs=5 * MS)


def test_an_offset_beyond_the_search_range_is_not_found() -> None:
    motion = Motion(2)
    imu, mocap = record_imu(motion, 40), record_mocap(motion, 25, 7_000 * MS)
    with pytest.raises(CalibrationMismatchError, match="match at no time offset"):
        find_offset(imu, mocap, 0.5)


def test_the_initial_mounting_is_within_a_degree() -> None:
    R, bias = initial_rotation(record_imu(MOTION, 20), record_mocap(MOTION, 20))
    assert np.degrees(se3.rotation_angle(R.T @ BODY[:3, :3])) < 1
    assert np.abs(bias).max() < 0.1
