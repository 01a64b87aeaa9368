"""Checked values: a pose is a rigid transform; poses relative to earlier keyframes."""

from __future__ import annotations

import numpy as np
import pytest

from share.checks import MAX_ID, MAX_ODOM_M, MAX_POSITION_M, checked_cov, checked_pose
from share.earlier_poses import MAX_EARLIER, EarlierPoses
from share.geometry import se3
from share.types import Keyframe, View

COV = np.eye(6)
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


def earlier(ids: list[int], pose: np.ndarray = T, cov: np.ndarray = COV) -> EarlierPoses:
    n = len(ids)
    return EarlierPoses(np.array(ids, np.int64), np.tile(pose, (n, 1, 1)), np.tile(cov, (n, 1, 1)))


def keyframe(id_: int, relative_to: EarlierPoses) -> Keyframe:
    return Keyframe(id_, id_ - 1, 0, T, np.eye(6), T, np.zeros(3), 0.0, View.empty(), earlier=relative_to)


def test_poses_relative_to_earlier_keyframes_are_few_and_of_one_length() -> None:
    assert len(earlier(list(range(MAX_EARLIER)))) == MAX_EARLIER
    with pytest.raises(ValueError, match=f"earlier: {MAX_EARLIER + 1} keyframes, at most {MAX_EARLIER}"):
        earlier(list(range(MAX_EARLIER + 1)))
    two = earlier([1, 2])
    with pytest.raises(ValueError, match="T_earlier_body: shape"):
        EarlierPoses(two.ids, two.T_earlier_body[:1], two.cov)
    with pytest.raises(ValueError, match=r"earlier\.cov: shape"):
        EarlierPoses(two.ids, two.T_earlier_body, two.cov[:1])


def test_poses_relative_to_earlier_keyframes_are_poses_and_their_covariances_covariances() -> None:
    for bad in (changed((0, 0), 2.0), changed((0, 3), 1.01 * MAX_ODOM_M), changed((1, 1), np.nan)):
        with pytest.raises(ValueError, match="T_earlier_body"):
            earlier([1, 2], bad)
    for cov in (-np.eye(6), np.full((6, 6), np.nan), np.triu(np.ones((6, 6)))):
        with pytest.raises(ValueError, match=r"earlier\.cov"):
            earlier([1, 2], cov=cov)


def test_a_keyframe_occurs_once_among_the_earlier_ones() -> None:
    with pytest.raises(ValueError, match="occurs twice"):
        EarlierPoses(np.array([3, 3]), np.array([np.eye(4)] * 2), np.array([np.eye(6)] * 2))


def test_a_row_of_them_keeps_its_pose_under_another_id() -> None:
    poses = se3.exp(0.1 * np.arange(18.0).reshape(3, 6))
    known = EarlierPoses(np.array([70, 80, 90]), poses, np.array([np.eye(6) * k for k in (1, 2, 3)]))
    taken = known.take([2, 0], [5, 4])
    assert taken.ids.tolist() == [5, 4]
    np.testing.assert_array_equal(taken.T_earlier_body, known.T_earlier_body[[2, 0]])
    np.testing.assert_array_equal(taken.cov[:, 0, 0], [3, 1])
    assert len(known.take([], [])) == len(EarlierPoses.empty()) == 0
    assert not taken.T_earlier_body.flags.writeable


@pytest.mark.parametrize("ids", [[-1, 3], [3, 9], [9], [MAX_ID]])
def test_a_keyframe_is_relative_to_keyframes_before_it(ids: list[int]) -> None:
    with pytest.raises(ValueError, match=r"earlier: ids must lie in 0 \.\. 8"):
        keyframe(9, earlier(ids))
    assert keyframe(9, earlier([0, 8])).earlier.ids.tolist() == [0, 8]


@pytest.mark.parametrize(
    ("size", "sign", "reason"),
    [(1.7e308, -1, "exceeds"), (2e12, 1, "exceeds"), (1, -1, "symmetric")],
)
def test_a_covariance_of_any_size_is_refused_in_words_alone(size, sign, reason, recwarn):
    """numpy's warnings would go to the log of an edge."""
    cov = np.eye(6)
    cov[0, 1], cov[1, 0] = size, sign * size
    with pytest.raises(ValueError, match=reason):
        checked_cov("cov", cov)
    assert not recwarn.list
