import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from share.geometry import se3

vectors = st.lists(st.floats(-3, 3), min_size=6, max_size=6).map(np.array)


def numerical(f, x, eps=1e-6):
    """Central differences of f at x, last axis the derivative."""
    steps = np.eye(len(x)) * eps
    return np.stack([(f(x + d) - f(x - d)) / (2 * eps) for d in steps], axis=-1)


@given(vectors)
def test_exp_and_log_are_inverse(xi):
    T = se3.exp(xi)
    assert np.allclose(se3.exp(se3.log(T)), T, atol=1e-10)
    assert np.linalg.norm(se3.log(T)[:3]) <= np.pi + 1e-9


@pytest.mark.parametrize("size", [0, 1e-12, 1e-7, 1e-4, 1.0, np.pi - 1e-7, np.pi])
def test_log_is_exact_from_zero_to_a_half_turn(size):
    axis = np.array([1.0, -2.0, 0.5]) / np.linalg.norm([1, -2, 0.5])
    R = Rotation.from_rotvec(size * axis).as_matrix()
    assert np.allclose(np.abs(se3.so3_log(R)), np.abs(size * axis), atol=1e-8)
    assert np.allclose(se3.so3_exp(size * axis), R, atol=1e-12)


@given(vectors)
def test_quaternions_agree_with_scipy(xi):
    R = se3.so3_exp(xi[:3])
    q = se3.quat_from_matrix(R)
    assert q[3] >= 0
    assert np.abs(np.dot(q, Rotation.from_matrix(R).as_quat())) == pytest.approx(1, abs=1e-12)
    assert np.allclose(se3.matrix_from_quat(q), R, atol=1e-12)


def test_right_jacobian_against_differences():
    phi = np.array([0.3, -0.8, 1.1])
    R = se3.so3_exp(phi)
    J = numerical(lambda p: se3.so3_log(R.T @ se3.so3_exp(p)), phi)
    assert np.allclose(se3.so3_right_jacobian(phi), J, atol=1e-8)


def test_adjoint_moves_a_perturbation_to_the_other_side(rng):
    T, xi = se3.exp(rng.normal(size=6)), 0.5 * rng.normal(size=6)
    assert np.allclose(T @ se3.exp(xi), se3.exp(se3.adjoint(T) @ xi) @ T, atol=1e-12)


def test_batches_equal_single_calls(rng):
    xi = rng.normal(size=(5, 7, 6))
    T = se3.exp(xi)
    assert np.allclose(T[2, 3], se3.exp(xi[2, 3]))
    assert np.allclose(se3.inverse(T) @ T, np.eye(4), atol=1e-12)
    assert np.allclose(se3.log(T)[1, 1], se3.log(T[1, 1]))


@pytest.mark.long
def test_covariances_of_products_and_inverses_against_sampling(rng):
    A, B = se3.exp(rng.normal(size=6)), se3.exp(rng.normal(size=6))
    cov_a = np.diag([1, 2, 3, 4, 5, 6]) * 1e-6
    cov_b = np.diag([6, 5, 4, 3, 2, 1]) * 1e-6
    xa = rng.multivariate_normal(np.zeros(6), cov_a, 100_000)
    xb = rng.multivariate_normal(np.zeros(6), cov_b, 100_000)
    product = se3.log(se3.inverse(A @ B) @ (A @ se3.exp(xa)) @ (B @ se3.exp(xb)))
    inverse = se3.log(A @ se3.inverse(A @ se3.exp(xa)))
    assert np.allclose(np.cov(product.T), se3.compose_cov(B, cov_a, cov_b), atol=3e-7)
    assert np.allclose(np.cov(inverse.T), se3.inverse_cov(A, cov_a), atol=3e-7)


def test_orthonormal_removes_the_drift_of_a_rotation(rng):
    T = se3.exp(rng.normal(size=6))
    bent = T.copy()
    bent[:3, :3] += 1e-4 * rng.normal(size=(3, 3))
    mended = se3.orthonormal(bent)
    assert np.allclose(mended[:3, :3] @ mended[:3, :3].T, np.eye(3), atol=1e-14)
    assert np.allclose(mended, T, atol=1e-3)


def test_rotation_angle_equals_the_norm_of_the_logarithm() -> None:
    axis = np.array([0.6, -0.48, 0.64])
    for radians in (0.0, 1e-9, 1e-4, 0.5, 2.0, 3.0, np.pi - 1e-7, np.pi):
        assert abs(se3.rotation_angle(se3.so3_exp(radians * axis)) - radians) < 1e-8


def test_pairwise_distances_equal_single_calls(rng):
    poses, others = (se3.exp(rng.normal(0, 1, (n, 6))) for n in (5, 7))
    metres, radians = se3.pairwise_distances(poses, others)
    for i, T in enumerate(poses):
        for j, other in enumerate(others):
            between = se3.inverse(T) @ other
            assert metres[i, j] == pytest.approx(np.linalg.norm(between[:3, 3]), abs=1e-12)
            assert radians[i, j] == pytest.approx(float(se3.rotation_angle(between)), abs=1e-7)
    for gap in se3.pairwise_distances(poses, poses):
        assert np.diagonal(gap) == pytest.approx(0.0, abs=1e-7)


def test_position_sigma_uses_the_translation_block_only():
    cov = np.diag([100.0, 100.0, 100.0, 0.04, 0.05, 0.07])
    assert se3.position_sigma(cov) == pytest.approx(0.4)
    assert se3.position_sigma(-1e-20 * cov) == 0
    assert np.isnan(se3.position_sigma(cov * np.nan))
