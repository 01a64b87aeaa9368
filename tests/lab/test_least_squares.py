"""Levenberg-Marquardt, systems in arrow form against dense ones, and covariances."""

from dataclasses import replace

import numpy as np
import pytest

from share.lab.least_squares import (
    ArrowFactor,
    ArrowSystem,
    enclosing_covariance,
    huber,
    jackknife,
    minimise,
)
from share.types import F64

NODES, SIZE, BORDER = 7, 3, 4


def made_system(rng: np.random.Generator, width: int) -> tuple[ArrowSystem, F64, F64]:
    """An arrow system whose nodes are coupled to `width` - 1 others, and the same as dense H and g."""
    n = NODES * SIZE
    J = rng.normal(size=(400, n + BORDER))
    for row, first in enumerate(rng.integers(0, NODES - width + 1, 400)):
        J[row, : first * SIZE] = J[row, (first + width) * SIZE : n] = 0
    H, g = J.T @ J, rng.normal(size=n + BORDER)
    blocks = np.zeros((NODES, width, SIZE, SIZE))
    for i in range(NODES):
        for ahead in range(min(width, NODES - i)):
            rows, columns = slice(i * SIZE, (i + 1) * SIZE), slice((i + ahead) * SIZE, (i + ahead + 1) * SIZE)
            blocks[i, ahead] = H[rows, columns]
    edge = H[:n, n:].reshape(NODES, SIZE, BORDER)
    return ArrowSystem(blocks, edge, H[n:, n:], g[:n].reshape(NODES, SIZE), g[n:]), H, g


@pytest.mark.parametrize("width", [1, 2, 4])
@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_an_arrow_system_has_the_solution_of_the_dense_one(
    rng: np.random.Generator, width: int, damping: float
) -> None:
    system, H, g = made_system(rng, width)
    H = H + damping * np.diag(np.diag(H))
    nodes, border = system.solve(damping)
    np.testing.assert_allclose(np.append(nodes, border), np.linalg.solve(H, g), rtol=1e-9)
    factor = ArrowFactor(system, damping)
    np.testing.assert_allclose(factor.border_covariance, np.linalg.inv(H)[-BORDER:, -BORDER:], rtol=1e-9)
    both = np.stack([g, 2 * g], axis=1)
    nodes, border = factor.solve(both[:-BORDER].reshape(NODES, SIZE, 2), both[-BORDER:])
    np.testing.assert_allclose(np.append(nodes[..., 1], border[:, 1]), np.linalg.solve(H, 2 * g), rtol=1e-9)


def test_covariances_of_the_nodes_of_a_chain_are_those_of_the_dense_system(rng: np.random.Generator) -> None:
    system, H, _ = made_system(rng, 2)
    inverse = np.linalg.inv(H)
    for i, block in enumerate(system.node_covariances()):
        rows = slice(i * SIZE, (i + 1) * SIZE)
        np.testing.assert_allclose(block, inverse[rows, rows], rtol=1e-8)


def test_an_unknown_that_is_not_observable_is_an_error(rng: np.random.Generator) -> None:
    system, _, _ = made_system(rng, 1)
    blocks = system.blocks.copy()
    blocks[3] = 0
    with pytest.raises(np.linalg.LinAlgError):
        replace(system, blocks=blocks).solve(0.0)


def rosenbrock(x: F64) -> tuple[tuple[F64, F64], float]:
    """Residuals and derivatives of a curved valley, least at (1, 1)."""
    r = np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])
    return (r, np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])), float(r @ r)


def valley_step(x: F64, linearised: tuple[F64, F64], damping: float) -> F64 | None:
    r, J = linearised
    H = J.T @ J
    trial: F64 = x - np.linalg.solve(H + damping * np.diag(np.diag(H)), J.T @ r)
    return trial if trial[0] > -2 else None  # a state may be invalid


def test_a_minimum_is_found_from_afar_and_from_an_invalid_trial() -> None:
    found = minimise(np.array([-1.9, 2.0]), rosenbrock, valley_step, 100, 1e-12)
    assert found.converged
    np.testing.assert_allclose(found.state, 1, atol=1e-6)


def test_too_few_steps_do_not_converge_and_initial_values_must_fit() -> None:
    assert not minimise(np.array([-1.9, 2.0]), rosenbrock, valley_step, 2, 1e-12).converged
    with pytest.raises(ValueError, match="initial values"):
        minimise(np.array([np.nan, 0.0]), rosenbrock, valley_step, 2, 1e-12)


def test_hubers_loss_is_quadratic_up_to_its_limit_and_linear_beyond() -> None:
    cost, root = huber(np.array([0.5, 3.0]), 1.0)
    assert cost == pytest.approx(0.5**2 / 2 + 3 - 0.5)
    np.testing.assert_allclose(root**2, [1, 1 / 3])
    assert huber(np.array([np.nan, 1.0]), 1.0)[0] == np.inf


def test_the_jackknife_of_a_mean_is_its_squared_standard_error(rng: np.random.Generator) -> None:
    x = rng.normal(3, 2, (40, 2))
    mean = x.mean(axis=0)
    H = np.tile(np.eye(2), (40, 1, 1))
    np.testing.assert_allclose(jackknife(H, x - mean), np.cov(x.T) / 40, rtol=1e-12)


def test_the_larger_of_two_is_in_no_direction_below_either(rng: np.random.Generator) -> None:
    A, B = rng.normal(size=(2, 5, 5))
    one, other = A @ A.T, B[:, :3] @ B[:, :3].T  # the second knows three directions only
    both = enclosing_covariance(one, other)
    for less in (one, other):
        assert np.linalg.eigvalsh(both - less).min() > -1e-9 * np.trace(both)
    assert np.trace(both) < np.trace(one + other)


def test_of_two_on_the_same_axes_it_is_the_larger_of_each() -> None:
    np.testing.assert_allclose(
        enclosing_covariance(np.diag([1.0, 4.0]), np.diag([9.0, 1.0])), np.diag([9.0, 4.0]), atol=1e-12
    )
