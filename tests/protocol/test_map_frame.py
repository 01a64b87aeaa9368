"""Where odometry lies in the map, and how sure that is."""

from __future__ import annotations

import numpy as np
import pytest

from share.geometry import se3
from share.protocol.localisation import BlendedMapFrame
from share.types import Correction


def placed(cov: np.ndarray, T_map_odom: np.ndarray) -> BlendedMapFrame:
    frame = BlendedMapFrame(0.5)
    frame.apply(Correction(T_map_odom, cov, "a", 1, 0), np.eye(4), 0)
    return frame


def test_a_turn_that_is_unsure_matters_more_far_from_the_origin_of_odometry() -> None:
    cov = np.diag([0, 0, 0.01**2, 0.03**2, 0, 0])
    frame = placed(cov, np.eye(4))
    at = [frame.sigma_cm(se3.from_rt(np.eye(3), np.array([0, y, 0]))) for y in (0.0, 4.0)]
    assert at == pytest.approx([3.0, 5.0])  # cm: 3, and with 4 m x 0.01 rad


def test_the_spread_is_that_of_bodies_drawn(rng) -> None:
    T_map_odom = se3.from_rt(se3.so3_exp(np.array([0.1, -0.2, 1.0])), np.array([1.0, 2, 0]))
    T_odom_body = se3.from_rt(se3.so3_exp(np.array([0.3, 0.1, -0.5])), np.array([3.0, -1, 0.5]))
    root = rng.normal(0, 0.003, (6, 6))
    drawn = T_map_odom @ se3.exp(rng.normal(size=(20_000, 6)) @ root.T) @ T_odom_body
    spread = np.sqrt(drawn[:, :3, 3].var(axis=0).sum())
    assert placed(root @ root.T, T_map_odom).sigma_cm(T_odom_body) == pytest.approx(100 * spread, rel=0.02)


def test_nothing_is_unsure_before_there_is_a_map() -> None:
    frame = BlendedMapFrame(0.5)
    assert frame.sigma_cm(np.eye(4)) == 0.0
    frame = placed(np.eye(6), np.eye(4))
    frame.reset()
    assert frame.sigma_cm(np.eye(4)) == 0.0
