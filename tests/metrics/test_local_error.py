"""The local error of odometry."""

from __future__ import annotations

import numpy as np
import pytest

from share.geometry import se3
from share.metrics.local_error import LocalError

MS = 1_000_000
STAMPS = np.arange(0, 20_000, 50) * MS


def walk() -> np.ndarray:
    s = np.arange(len(STAMPS)) * 0.05
    t = np.column_stack([2 * np.cos(s), 2 * np.sin(s), 0.1 * np.sin(5 * s)])
    return se3.from_rt(se3.so3_exp(np.column_stack([0 * s, 0 * s, s])), t)


def reported(poses: np.ndarray, **also: bool) -> list[float | None]:
    error = LocalError((STAMPS, walk()))
    return [error.update(int(stamp), T, **also) for stamp, T in zip(STAMPS, poses, strict=True)]


def test_constant_transform_is_no_error() -> None:
    moved = se3.exp(np.array([0.0, 0.0, 1.0, 3.0, -2.0, 0.5])) @ walk()
    out = reported(moved)
    assert out[:50] == [None] * 50  # half the window
    assert max(error for error in out[50:] if error is not None) < 1e-9


def test_error_equals_the_noise() -> None:
    poses = walk()
    poses[:, :3, 3] += np.random.default_rng(0).normal(0, 0.01, (len(poses), 3))
    late = [error for error in reported(poses)[150:] if error is not None]
    assert np.mean(late) == pytest.approx(np.sqrt(3), rel=0.05)


def test_jump_counts_while_it_is_in_the_window() -> None:
    poses = walk()
    poses[200:, 0, 3] += 0.05
    out = np.array(reported(poses)[60:], float)
    assert (out[:140] < 1e-6).all()
    assert 1.0 < out[140:240].max() < 2.5
    assert (out[242:] < 1e-6).all()


def test_no_error_without_truth_or_pose() -> None:
    error = LocalError((STAMPS, walk()))
    poses = walk()
    for stamp, T in zip(STAMPS[:150], poses[:150], strict=True):
        last = error.update(int(stamp), T)
    assert last is not None
    assert error.update(int(STAMPS[150]), None) is None
    assert error.update(10**15, poses[0]) is None
    assert error.update(int(STAMPS[151]), poses[151], new_segment=True) is None
