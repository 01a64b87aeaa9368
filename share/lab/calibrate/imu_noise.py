"""White noise, bias instability and bias random walk of a sensor at rest, from its Allan variance.

    sigma^2(tau) = c / tau^2 + N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3        (IEEE Std 952-1997, annex C)

c is 3 Q^2 where digits are coarse, and negative where a sensor's filter, or an interpolating driver, has
smoothed the samples; both fall as 1 / tau^2. The fit is generalised least squares with the variances'
covariance under the model itself (`share.lab.calibrate.allan`), no other term below zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from share.errors import DataError
from share.lab.calibrate.allan import AllanCurve, variance_covariance
from share.types import F64

COEFFICIENTS = ("quantisation", "density", "instability", "walk")  # c, N, B, K
FLICKER_FACTOR = 2 * np.log(2) / np.pi
_MIN_AVERAGE = 8  # samples: below, filters and interpolation add more than c / tau^2
_MIN_POINTS = 8
_ITERATIONS = 6  # of reweighting; converged after four
_SIGNIFICANT_SIGMAS = 2.5  # a square this many sigmas from 0 is significant
_BOUND_SIGMAS = 1.645  # one-sided 95 %
_JITTER = 1e-12  # of the variances, so that a model without noise can be factored


class NoiseEstimate(NamedTuple):
    """A value and its standard error. If it is not significant, it is below `bound` with 95 %
    confidence, and no more is known."""

    value: float
    sigma: float
    significant: bool
    bound: float

    @property
    def conservative(self) -> float:
        """The value, or the bound if it is not significant."""
        return self.value if self.significant else self.bound

    @property
    def text(self) -> str:
        """Text for readers."""
        return f"{self.value:.3g} ± {self.sigma:.1g}" if self.significant else f"< {self.bound:.2g}"


@dataclass(frozen=True, eq=False)
class AxisNoise:
    """Noise of one axis in its unit u: density u/sqrt(Hz); instability u; walk u/s/sqrt(Hz); quantisation u
    s.

    squares (4,): c, N^2, B^2, K^2 as fitted, with standard errors (4,). low, high (T,): 95 % interval of the
    true deviation at each averaging time of the curve. modelled (T,): the fit, NaN for averages of fewer
    samples than are fitted.
    """

    density: NoiseEstimate
    instability: NoiseEstimate
    walk: NoiseEstimate
    quantisation: NoiseEstimate
    squares: F64
    errors: F64
    low: F64
    high: F64
    modelled: F64


def fit_noise(curve: AllanCurve, model_error: float = 0.02) -> tuple[AxisNoise, ...]:
    """Fit each axis. model_error: relative error of the model's variance, since no real sensor follows it
    exactly.

    Raises DataError for a curve that is too short to fit.
    """
    first = int(np.searchsorted(curve.sizes, _MIN_AVERAGE))
    if len(curve.sizes) - first < _MIN_POINTS:
        raise DataError("Allan deviation: the recording is too short to estimate noise; record longer")
    covariance = variance_covariance(curve.sizes, curve.segment_lengths, curve.rate_hz)
    return tuple(
        _fit_axis(curve.taus, column**2, covariance, first, model_error) for column in curve.deviation.T
    )


def _fit_axis(taus: F64, variance: F64, covariance: F64, first: int, model_error: float) -> AxisNoise:
    A = np.stack([taus**-2, 1 / taus, np.full(len(taus), FLICKER_FACTOR), taus / 3], axis=1)
    if not variance[first:].all():
        raise DataError("Allan deviation: an axis has constant samples; does the sensor work?")
    weights = _NoiseWeights(A[first:], covariance[:, :, first:, first:], model_error)
    squares = _fit_squares(weights, variance[first:])
    errors = weights.sigmas(squares)
    estimates = [
        _estimate_from_square(squares[k], errors[k], weights.bound_margin(squares, k)) for k in range(4)
    ]
    low, high = _confidence_interval(np.sqrt(variance), A, squares, covariance)
    return AxisNoise(
        density=estimates[1],
        instability=estimates[2],
        walk=estimates[3],
        quantisation=_scaled(estimates[0], 1 / np.sqrt(3)),
        squares=squares,
        errors=errors,
        low=low,
        high=high,
        modelled=np.where(np.arange(len(taus)) < first, np.nan, np.sqrt(np.maximum(A @ squares, 0))),
    )


def combine_axes(axes: Sequence[AxisNoise], name: str) -> NoiseEstimate:
    """Return density, instability or walk of axes taken as equal: the root mean of their squares."""
    k = COEFFICIENTS.index(name)
    squares = np.array([max(axis.squares[k], 0.0) for axis in axes])
    bounds = np.array([getattr(axis, name).bound ** 2 for axis in axes])
    sigma = np.linalg.norm([axis.errors[k] for axis in axes]) / len(axes)
    return _estimate_from_square(
        squares.mean(), float(sigma), float(np.linalg.norm(bounds - squares)) / len(axes)
    )


class _NoiseWeights(NamedTuple):
    """A (T, 4): Allan variance per unit of each square. covariance (3, 3, T, T): of `variance_covariance`."""

    A: F64
    covariance: F64
    model_error: float

    def cholesky(self, squares: F64, model: F64) -> F64:
        """Return the Cholesky factor (T, T) of the variances' covariance, scaled to the variances `model`."""
        parts = _noise_squares(squares)
        ratio = model / (self.A[:, 1:] @ parts)
        C = np.einsum("a,b,abij->ij", parts, parts, self.covariance) * np.outer(ratio, ratio)
        C += np.diag((self.model_error * model) ** 2 + _JITTER * np.diag(C))
        return np.asarray(np.linalg.cholesky(C), np.float64)

    def sigmas(self, squares: F64) -> F64:
        """Return standard errors (4,), if the truth were `squares`."""
        from scipy.linalg import solve_triangular

        model = np.maximum(self.A @ squares, 1e-3 * (self.A[:, 1:] @ _noise_squares(squares)))
        B = solve_triangular(self.cholesky(squares, model), self.A, lower=True)
        unit = np.linalg.norm(B, axis=0)
        return np.asarray(np.sqrt(np.diag(np.linalg.inv((B / unit).T @ (B / unit)))) / unit, np.float64)

    def bound_margin(self, squares: F64, k: int) -> float:
        """Return the distance from square k to its bound: the truth that gives as little as was estimated
        in 5 % of recordings."""
        assumed = squares.copy()
        for _ in range(_ITERATIONS):
            assumed[k] = max(squares[k], 0.0) + _BOUND_SIGMAS * self.sigmas(assumed)[k]
        return float(assumed[k] - max(squares[k], 0.0))


def _fit_squares(weights: _NoiseWeights, variance: F64) -> F64:
    """Return the squares (4,). The first weights are those of the measured curve, as if it were white."""
    from scipy.linalg import solve_triangular
    from scipy.optimize import nnls

    signed_design = np.insert(weights.A, 1, -weights.A[:, 0], axis=1)  # c may have either sign
    model, squares = variance, np.zeros(4)
    for _ in range(_ITERATIONS):
        L = weights.cholesky(squares, model)
        B = solve_triangular(L, signed_design, lower=True)
        unit = np.linalg.norm(B, axis=0)
        solution = nnls(B / unit, solve_triangular(L, variance, lower=True))[0] / unit
        squares = np.concatenate([[solution[0] - solution[1]], solution[2:]])
        model = np.maximum(weights.A @ squares, 1e-3 * variance)
    return squares


def _noise_squares(squares: F64) -> F64:
    """Return N^2, B^2, K^2, which determine the variances' scatter; white noise where c is the only term."""
    return squares[1:] if squares[1:].any() else np.array([1.0, 0.0, 0.0])


def _confidence_interval(deviation: F64, A: F64, squares: F64, covariance: F64) -> tuple[F64, F64]:
    """Return the 95 % interval (T,) each of the measured deviation, by the chi-square distribution of its
    equivalent degrees of freedom (NIST SP 1065, 5.3)."""
    from scipy.special import gammaincinv

    parts = _noise_squares(squares)
    freedom = 2 * (A[:, 1:] @ parts) ** 2 / np.einsum("a,b,abii->i", parts, parts, covariance)
    low, high = (deviation * np.sqrt(freedom / 2 / gammaincinv(freedom / 2, p)) for p in (0.975, 0.025))
    return low, high


def _estimate_from_square(square: float, sigma: float, margin: float) -> NoiseEstimate:
    """Return the root of a fitted square with its first-order error. margin: from the square to its bound."""
    value, bound = float(np.sqrt(max(square, 0.0))), float(np.sqrt(max(square, 0.0) + margin))
    is_significant = bool(square > _SIGNIFICANT_SIGMAS * sigma)
    return NoiseEstimate(
        value, float(sigma) / (2 * value) if is_significant else bound - value, is_significant, bound
    )


def _scaled(figure: NoiseEstimate, factor: float) -> NoiseEstimate:
    return NoiseEstimate(
        figure.value * factor, figure.sigma * factor, figure.significant, figure.bound * factor
    )
