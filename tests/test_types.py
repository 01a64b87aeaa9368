"""Checked values: a pose is a rigid transform."""

from __future__ import annotations

import numpy as np
import pytest

from share.checks import MAX_POSITION_M, checked_pose
from share.geometry import se3

T = se3.exp(np.array([0.3, -0.2, 0.9, 4.0, -5.0, 6.0]))


def changed(at: tuple[int, int], value: float) -> np.ndarray:
    out = T.copy()
    out[at] = value
    return out


@pytest.mark.parametrize("seed", range(20))
def test_rotation_tolerance_is_a_thousandth(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for scale in (1e-4, 3e-4, 1e-3, 1e-2, 1.0):
        near = T.copy()
        near[:3, :3] += scale * rng.uniform(-1, 1, (3, 3))
        R = near[:3, :3]
        good = np.abs(R @ R.T - np.eye(3)).max() <= 1e-3 and np.linalg.det(R) > 0
        if good:
            assert (checked_pose("T", near) == near).all()
        else:
            with pytest.raises(ValueError, match="T: is not a rigid transform"):
                checked_pose("T", near)


@pytest.mark.parametrize("value", [2.0, 1e200, -1e308])
def test_too_large_matrices_are_refused(value: float) -> None:
    for at in np.ndindex(3, 3):
        with pytest.raises(ValueError, match="rigid"):
            checked_pose("T", changed(at, value))


def test_reflections_and_wrong_last_rows_are_refused() -> None:
    for bad in (T @ np.diag([1, 1, -1, 1.0]), *(changed((3, k), 1e-6 + (k == 3)) for k in range(4))):
        with pytest.raises(ValueError, match="rigid"):
            checked_pose("T", bad)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_non_finite_matrices_are_refused(value: float) -> None:
    for at in np.ndindex(4, 4):
        with pytest.raises(ValueError, match="not finite"):
            checked_pose("T", changed(at, value))
    assert checked_pose("T", changed((0, 3), MAX_POSITION_M)).flags.writeable is False


@pytest.mark.parametrize("value", [1.001 * MAX_POSITION_M, -1e300, 1.7e308])
def test_too_far_poses_are_refused(value: float) -> None:
    for row in range(3):
        with pytest.raises(ValueError, match="m away"):
            checked_pose("T", changed((row, 3), value))
