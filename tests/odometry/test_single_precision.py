"""Updates in single precision give the poses of double precision."""

import numpy as np
import pytest
from helpers.imu_simulation import Run, Setup, run

from share.geometry import se3
from share.odometry import filter

MOST = 1e-6  # rad and m, between the two


def apart(one: Run, other: Run) -> float:
    """The most between poses, rad or m."""
    a, b = (se3.exp(each.pose_errors) for each in (one, other))
    return float(np.abs(se3.log(se3.inverse(a) @ b)).max())


@pytest.mark.parametrize(("seconds", "features"), [(1.0, 20), pytest.param(60.0, 60, marks=pytest.mark.slow)])
@pytest.mark.parametrize("mono", [False, True])
def test_poses_agree_with_double_precision(seconds, features, mono, monkeypatch):
    setup = Setup(seconds=seconds, features=features, mono=mono)
    short = run(0, setup)
    assert not filter.needs_double_precision(short.state)
    monkeypatch.setattr(filter, "needs_double_precision", lambda state: True)
    assert 0 < apart(short, run(0, setup)) < MOST
