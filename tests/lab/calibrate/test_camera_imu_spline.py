"""Splines of a trajectory, against scipy's and finite differences."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import BSpline

from share.geometry import se3
from share.lab.calibrate.camera_imu.spline import EXTRA_KNOTS, ORDER, Curve, blending

STEP = 0.05


@pytest.fixture
def curve(rng: np.random.Generator) -> Curve:
    """Twelve segments with rotations of up to a radian a knot."""
    turns = np.cumsum(rng.normal(0, 0.4, (12 + EXTRA_KNOTS, 3)), axis=0)
    return Curve(1_000, STEP, se3.so3_exp(turns), rng.normal(0, 1, (12 + EXTRA_KNOTS, 3)))


def test_positions_and_their_derivatives_equal_scipys(curve: Curve, rng: np.random.Generator) -> None:
    t = rng.uniform(0, curve.end_s, 40)
    knots = (np.arange(len(curve.p) + ORDER) - EXTRA_KNOTS) * STEP
    theirs = BSpline(knots, curve.p, EXTRA_KNOTS)
    at = curve.locate(1_000 + np.round(t * 1e9).astype(np.int64))
    for derivative in range(3):
        np.testing.assert_allclose(
            curve.position(at, derivative)[0], theirs(t, derivative), rtol=1e-5, atol=1e-5
        )


def test_blending_is_continuous_between_segments() -> None:
    ends = blending(np.array([0.0, 1.0]), 0)
    np.testing.assert_allclose(ends[1, 1:], ends[0, :-1], atol=1e-12)  # a segment on is a knot on
    np.testing.assert_allclose(ends[:, 0], 1, atol=1e-12)


def test_the_rate_is_the_derivative_of_the_rotation(curve: Curve) -> None:
    stamps = 1_000 + np.arange(3, 590, 7) * 1_000_000
    h = 1e-5
    low, high = (curve.rotation(curve.locate(stamps, s * h)).R for s in (-1, 1))
    by_differences = se3.so3_log(low.swapaxes(1, 2) @ high) / (2 * h)
    np.testing.assert_allclose(
        curve.rotation(curve.locate(stamps)).rate, by_differences, rtol=1e-5, atol=1e-5
    )


def test_derivatives_by_knots_equal_finite_differences(curve: Curve) -> None:
    at = curve.locate(1_000 + np.array([12, 130, 388, 401, 599]) * 1_000_000)
    here, h = curve.rotation(at), 1e-6
    for knot in range(ORDER):
        for axis in range(3):
            moved = []
            for sign in (-1, 1):
                R = np.repeat(curve.R[None], len(at.u), axis=0)
                rows = np.arange(len(at.u)), at.segment + knot
                R[rows] = R[rows] @ se3.so3_exp(sign * h * np.eye(3)[axis])
                one = [
                    replace(curve, R=R[k]).rotation(
                        replace(at, segment=at.segment[k : k + 1], u=at.u[k : k + 1])
                    )
                    for k in range(len(at.u))
                ]
                moved.append((np.concatenate([x.R for x in one]), np.concatenate([x.rate for x in one])))
            turned = se3.so3_log(moved[0][0].swapaxes(1, 2) @ moved[1][0]) / (2 * h)
            np.testing.assert_allclose(here.by_knots[:, knot, :, axis], turned, atol=1e-6)
            quicker = (moved[1][1] - moved[0][1]) / (2 * h)
            np.testing.assert_allclose(here.rate_by_knots[:, knot, :, axis], quicker, rtol=1e-5, atol=1e-5)
