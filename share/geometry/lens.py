"""Lens models: from normalised coordinates (x/z, y/z) to those in the image plane, and back.

Radial-tangential: OpenCV's plumb-bob model k1 k2 p1 p2 [k3] (Brown 1966), Kalibr's `radtan` and EuRoC's
`radial-tangential`. Equidistant: k1 k2 k3 k4 of Kannala and Brandt (A generic camera model, PAMI 2006),
OpenCV's fisheye model. A ray beyond the angle up to which a model is monotonic gives NaN: it would fold back
into the image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from share.types import F64

RADTAN, EQUIDISTANT = "radtan", "equidistant"
COEFFICIENT_COUNTS = {RADTAN: (0, 4, 5), EQUIDISTANT: (4,)}
# Angle from the axis of a fisheye lens up to which normalised coordinates are used: they end at 90 degrees,
# and here a pixel is 15 times as large in them as on the axis.
MAX_FIELD_DEG = 75.0
_MIN_SQUARED_RADIUS = 1e-8  # below it the limits for a radius of 0 are used
_MAX_ITERATIONS, _ANGLE_TOLERANCE = 60, 1e-12  # of Newton's method; rad


@dataclass(frozen=True)
class Radtan:
    """limit: largest |uv| up to which the radial polynomial rises; inf for most lenses."""

    coefficients: tuple[float, ...]
    limit: float

    def distort(self, uv: F64) -> F64:
        """Normalised coordinates (..., 2) -> those in the image plane (..., 2)."""
        out = self._distort(uv)
        if self.limit < math.inf:
            out[(uv**2).sum(axis=-1) > self.limit**2] = np.nan
        return out

    def _distort(self, uv: F64) -> F64:
        k1, k2, p1, p2, k3 = self._padded_coefficients()
        x, y = uv[..., 0], uv[..., 1]
        r2 = x * x + y * y
        xy, radial = 2 * x * y, 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        out = np.empty(uv.shape)
        out[..., 0] = x * radial + p1 * xy + p2 * (r2 + 2 * x * x)
        out[..., 1] = y * radial + p1 * (r2 + 2 * y * y) + p2 * xy
        return out

    def jacobian(self, uv: F64) -> F64:
        """d(distorted)/d(uv), (..., 2, 2)."""
        k1, k2, p1, p2, k3 = self._padded_coefficients()
        x, y = uv[..., 0], uv[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))  # d(radial)/d(r2) * 2, so d/dx = slope * x
        J = np.empty((*uv.shape, 2))
        J[..., 0, 0] = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
        J[..., 1, 1] = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
        J[..., 0, 1] = J[..., 1, 0] = slope * x * y + 2 * p1 * x + 2 * p2 * y
        return J

    def undistort(self, distorted: F64, guess: F64 | None = None) -> F64:
        """The inverse of `distort`, to 1e-9 inside the image. guess: initial values, for fewer iterations."""
        uv = (distorted if guess is None else guess).copy()
        if self.limit < math.inf and guess is None:  # begin inside the limit
            r = np.hypot(uv[..., 0], uv[..., 1])[..., None]
            uv *= np.minimum(1, 0.9 * self.limit / np.maximum(r, 1e-12))
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # absurd coefficients
            converged = self._newton(distorted, uv, guess is not None)
            if self.limit < math.inf or not converged:  # beyond the limit, or not converged
                error = np.abs(distorted - self._distort(uv)).max(axis=-1)
                uv[~(((uv**2).sum(axis=-1) <= self.limit**2) & (error < 1e-6))] = np.nan
        return uv

    def _newton(self, distorted: F64, uv: F64, is_near: bool) -> bool:
        """Move uv (..., 2) in place until it maps to `distorted`. Return whether all converged. is_near:
        keep the first derivative."""
        for k in range(8):  # converges quadratically inside the image
            if k == 0 or not is_near:
                J = self.jacobian(uv)
                J = J / (J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0])[..., None, None]
            r = distorted - self._distort(uv)
            uv[..., 0] += J[..., 1, 1] * r[..., 0] - J[..., 0, 1] * r[..., 1]
            uv[..., 1] += J[..., 0, 0] * r[..., 1] - J[..., 1, 0] * r[..., 0]
            if np.nanmax(np.abs(r), initial=0.0) < 1e-6:  # the error after the step is about its square
                return True
        return False

    def distort_points(self, points: F64) -> F64:
        """Points (..., 3) in the camera frame -> image plane (..., 2); NaN behind the camera."""
        z = np.where(points[..., 2:] > 1e-6, points[..., 2:], np.nan)
        return self.distort(points[..., :2] / z)

    def point_jacobian(self, points: F64) -> F64:
        """d(distorted)/d(point), (..., 2, 3); NaN behind the camera."""
        z = np.where(points[..., 2] > 1e-6, points[..., 2], np.nan)
        uv = points[..., :2] / z[..., None]
        into = np.zeros((*points.shape[:-1], 2, 3))
        into[..., 0, 0] = into[..., 1, 1] = 1 / z
        into[..., :, 2] = -uv / z[..., None]
        return self.jacobian(uv) @ into

    def coefficient_jacobian(self, points: F64) -> F64:
        """d(distorted)/d(k1, k2, p1, p2, k3) at points (..., 3), (..., 2, 5), or without k3 (..., 2, 4)."""
        uv = points[..., :2] / points[..., 2:]
        x, y = uv[..., 0], uv[..., 1]
        r2 = x * x + y * y
        rows = [
            [x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3],
            [y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3],
        ]
        out = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
        return np.asarray(out[..., : max(len(self.coefficients), 4)])

    def directions(self, distorted: F64) -> F64:
        """Image plane (..., 2) -> unit vectors (..., 3) along the rays."""
        uv = self.undistort(distorted)
        ray = np.concatenate([uv, np.ones((*uv.shape[:-1], 1))], axis=-1)
        return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))

    def _padded_coefficients(self) -> tuple[float, float, float, float, float]:
        k1, k2, p1, p2, *k3 = self.coefficients
        return k1, k2, p1, p2, k3[0] if k3 else 0.0


@dataclass(frozen=True)
class Equidistant:
    """limit: angle from the axis, rad, at most pi, up to which the radius rises.

    Normalised coordinates end at `MAX_FIELD_DEG`; `distort_points` and `directions` do not.
    """

    coefficients: tuple[float, ...]
    limit: float

    @property
    def max_field_rad(self) -> float:
        """Angle from the axis up to which there are normalised coordinates."""
        return min(self.limit, math.radians(MAX_FIELD_DEG))

    def distort(self, uv: F64) -> F64:
        """Normalised coordinates (..., 2) -> those in the image plane (..., 2)."""
        r2 = (uv**2).sum(axis=-1)
        theta = np.arctan(np.sqrt(r2))
        scale = self._scale_of_radius(self._distorted_angle(theta), r2)
        scale[theta > self.max_field_rad] = np.nan
        return np.asarray(uv * scale[..., None])

    def jacobian(self, uv: F64) -> F64:
        """d(distorted)/d(uv), (..., 2, 2)."""
        r2 = (uv**2).sum(axis=-1)
        theta = np.arctan(np.sqrt(r2))
        scale = self._scale_of_radius(self._distorted_angle(theta), r2)
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = (self._angle_derivative(theta) / (1 + r2) - scale) / r2
        slope = np.where(r2 < _MIN_SQUARED_RADIUS, 2 * (self.coefficients[0] - 1 / 3), slope)
        out = slope[..., None, None] * uv[..., :, None] * uv[..., None, :]
        out[..., 0, 0] += scale
        out[..., 1, 1] += scale
        out[theta > self.max_field_rad] = np.nan
        return np.asarray(out)

    def undistort(self, distorted: F64, guess: F64 | None = None) -> F64:
        """The inverse of `distort`, to 1e-9. guess: not used."""
        radius = np.hypot(distorted[..., 0], distorted[..., 1])
        theta = self._solve_angle(radius, self.max_field_rad)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.where(radius**2 < _MIN_SQUARED_RADIUS, 1.0, np.tan(theta) / radius)
        return np.asarray(distorted * scale[..., None])

    def distort_points(self, points: F64) -> F64:
        """Points (..., 3) in the camera frame, also behind it, -> image plane (..., 2); NaN beyond
        `limit`."""
        theta, across = self._polar(points)
        return np.asarray(points[..., :2] * self._scale(points, theta, across)[..., None])

    def point_jacobian(self, points: F64) -> F64:
        """d(distorted)/d(point), (..., 2, 3)."""
        theta, across = self._polar(points)
        z, d2 = points[..., 2], (points**2).sum(axis=-1)
        scale, slope = self._scale(points, theta, across), self._angle_derivative(theta)
        near = across**2 < _MIN_SQUARED_RADIUS * d2
        with np.errstate(divide="ignore", invalid="ignore"):
            slope_term = np.where(near, 0.0, (slope * z / d2 - scale) / across**2)
        xy = points[..., :2]
        out = np.zeros((*points.shape[:-1], 2, 3))
        out[..., :2] = slope_term[..., None, None] * xy[..., :, None] * xy[..., None, :]
        out[..., 0, 0] += scale
        out[..., 1, 1] += scale
        out[..., 2] = -xy * (slope / d2)[..., None]
        return out

    def coefficient_jacobian(self, points: F64) -> F64:
        """d(distorted)/d(k1, k2, k3, k4) at points (..., 3), (..., 2, 4)."""
        theta, across = self._polar(points)
        with np.errstate(divide="ignore", invalid="ignore"):
            direction = np.where(across[..., None] > 0, points[..., :2] / across[..., None], 0.0)
        powers = theta[..., None] ** np.array([3, 5, 7, 9])
        return np.asarray(direction[..., :, None] * powers[..., None, :])

    def directions(self, distorted: F64) -> F64:
        """Image plane (..., 2) -> unit vectors (..., 3) along the rays; NaN beyond `limit`."""
        radius = np.hypot(distorted[..., 0], distorted[..., 1])
        theta = self._solve_angle(radius, self.limit)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.where(radius**2 < _MIN_SQUARED_RADIUS, 1.0, np.sin(theta) / radius)
        return np.concatenate([distorted * scale[..., None], np.cos(theta)[..., None]], axis=-1)

    def _distorted_angle(self, theta: F64) -> F64:
        k1, k2, k3, k4 = self.coefficients
        t2 = theta * theta
        return theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))

    def _angle_derivative(self, theta: F64) -> F64:
        k1, k2, k3, k4 = self.coefficients
        t2 = theta * theta
        return 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))

    def _scale_of_radius(self, distorted: F64, r2: F64) -> F64:
        with np.errstate(divide="ignore", invalid="ignore"):
            out = distorted / np.sqrt(r2)
        return np.where(r2 < _MIN_SQUARED_RADIUS, 1 + r2 * (self.coefficients[0] - 1 / 3), out)

    def _polar(self, points: F64) -> tuple[F64, F64]:
        """Return the angle from the axis (...), rad, NaN beyond `limit`, and the distance from it (...)."""
        across = np.hypot(points[..., 0], points[..., 1])
        theta = np.arctan2(across, points[..., 2])
        return np.where(theta > self.limit, np.nan, theta), across

    def _scale(self, points: F64, theta: F64, across: F64) -> F64:
        """Return the factor (...) of the coordinates across the axis."""
        ahead = (across < 1e-6 * np.abs(points[..., 2])) & (theta < 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(ahead, 1 / points[..., 2], self._distorted_angle(theta) / across)

    def _solve_angle(self, radius: F64, max_angle: float) -> F64:
        """Return the angle (...) rad from the axis at a radius (...) in the image plane; NaN beyond
        `max_angle`.

        Newton's method between 0 and `max_angle`, where the radius is monotonic; the interval is halved where
        a step would leave it or is more than half of the one before.
        """
        end = float(self._distorted_angle(np.asarray(max_angle)))
        radius_inside = np.where(radius <= end, radius, np.nan)
        low, high = np.zeros_like(radius_inside), np.full_like(radius_inside, max_angle)
        theta, moved = np.minimum(radius_inside, max_angle), np.full_like(radius_inside, 2 * max_angle)
        for _ in range(_MAX_ITERATIONS):
            error = self._distorted_angle(theta) - radius_inside
            low, high = np.where(error < 0, theta, low), np.where(error > 0, theta, high)
            with np.errstate(divide="ignore", invalid="ignore"):
                step = theta - error / self._angle_derivative(theta)
            fits = (step >= low) & (step <= high) & (np.abs(step - theta) <= moved / 2)
            step = np.where(fits, step, (low + high) / 2)
            moved, theta = np.abs(step - theta), np.where(np.isnan(radius_inside), np.nan, step)
            if np.nanmax(moved, initial=0.0) < _ANGLE_TOLERANCE:
                break
        return theta


@lru_cache(maxsize=64)
def lens_model(model: str, coefficients: tuple[float, ...]) -> Radtan | Equidistant:
    """Return the lens of a model of `COEFFICIENT_COUNTS`, with at least one coefficient."""
    if model == RADTAN:
        k1, k2, _, _, *k3 = coefficients
        return Radtan(coefficients, math.sqrt(_first_root([3 * k1, 5 * k2, *(7 * k for k in k3)])))
    k1, k2, k3_, k4 = coefficients
    return Equidistant(coefficients, min(math.sqrt(_first_root([3 * k1, 5 * k2, 7 * k3_, 9 * k4])), math.pi))


def _first_root(by_power: list[float]) -> float:
    """Return the least s > 0 with 1 + by_power[0] s + by_power[1] s^2 + ... = 0; inf without one."""
    while by_power and by_power[-1] == 0:
        by_power = by_power[:-1]
    if not by_power:
        return math.inf
    # 1 / s is a root of the reversed polynomial, whose leading coefficient of 1 keeps small ones harmless
    roots = np.roots([1.0, *by_power])
    real: NDArray[np.float64] = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(1 / real.max()) if len(real) else math.inf
