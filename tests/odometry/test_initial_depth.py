"""Depths of new features where the second camera shows nothing."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.imu_world import rig

from share.odometry import initial_depth
from share.odometry.initial_depth import initial_depths
from share.odometry.state import CORE_SIZE, FilterState, add_features, add_keyframe, initial_state
from share.types import Frame

COUNT = 20
IMAGE = np.random.default_rng(2).integers(0, 255, (480, 640), np.uint8)
PX = np.random.default_rng(3).uniform(100, 380, (COUNT, 2)).astype(np.float32)


def state(features: int) -> FilterState:
    """At rest, with features 2 m away."""
    zero = np.zeros(3)
    out = initial_state(0, np.eye(4), zero, zero, zero, rig().T_body_cam0, np.full(CORE_SIZE, 1e-3))
    add_keyframe(out, 0, zero)
    n = features
    rays = rig().cam0.normalise(PX[:n].astype(float))
    add_features(out, np.arange(n), np.zeros(n, int), rays, np.full(n, 0.5), np.full(n, 0.01))
    return out


def depths(features: int) -> initial_depth.DepthPrior:
    frame = Frame(0, 0, IMAGE, IMAGE)
    ray = rig().cam0.normalise(PX.astype(float))
    return initial_depths(frame, rig(), state(features), PX, ray, PX[:features])


@pytest.mark.parametrize(
    ("measured", "features", "expected"), [(0, 12, COUNT), (1, 12, COUNT), (2, 12, 2), (0, 5, 0)]
)
def test_where_hardly_any_depth_is_measured_it_is_that_of_neighbours(
    monkeypatch: pytest.MonkeyPatch, measured: int, features: int, expected: int
) -> None:
    found = np.where(np.arange(COUNT) < measured, 4.0, np.nan)
    monkeypatch.setattr(initial_depth, "_stereo_depth", lambda *arguments: found)
    prior = depths(features)
    assert np.isfinite(prior.rho).sum() == expected
    if expected == COUNT:
        np.testing.assert_allclose(prior.rho, 0.5, rtol=0.01)
        assert (prior.sigma >= 0.2).all()
