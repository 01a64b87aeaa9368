"""Drift of odometry beside others."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.hellos import rig_of

from share.geometry import se3
from share.lab.evaluate.views_of_others import DriftBesideOthers, drift_beside_others

MS = 1_000_000
STAMPS = np.arange(0, 20_000, 50) * MS
STILL = np.tile(np.eye(4), (len(STAMPS), 1, 1))  # its camera looks along z


def at(x: float, y: float, z: float) -> np.ndarray:
    return np.tile(se3.from_rt(np.eye(3), np.array([x, y, z])), (len(STAMPS), 1, 1))


def drifting(mm_s: np.ndarray) -> np.ndarray:
    T = STILL.copy()
    T[:, 0, 3] = np.cumsum(mm_s) * 0.05e-3
    return T


def test_drift_is_that_of_seconds_with_and_without_another_in_view() -> None:
    comes = np.where((STAMPS > 10_000 * MS)[:, None, None], at(0, 0, 2), at(0, 0, -2))
    moves = drifting(np.where(STAMPS > 10_000 * MS, 30.0, 10.0))
    found = drift_beside_others(rig_of(), (STAMPS, moves), (STAMPS, STILL), [(STAMPS, comes)])
    assert found.with_cm == pytest.approx(3.0, abs=0.15)
    assert found.without_cm == pytest.approx(1.0, abs=0.05)
    assert found.share_with == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("where", [(0, 0, -2), (0, 0, 9), (3, 0, 2), (0, 2, 2), (0, 0, 0.1)])
def test_who_is_behind_far_or_beside_is_not_in_view(where: tuple[float, float, float]) -> None:
    found = drift_beside_others(rig_of(), (STAMPS, STILL), (STAMPS, STILL), [(STAMPS, at(*where))])
    assert found.n_with == 0 and found.n_without > 300


def test_alone_nobody_is_in_view() -> None:
    found = drift_beside_others(rig_of(), (STAMPS, drifting(np.full(len(STAMPS), 5.0))), (STAMPS, STILL), [])
    assert found.n_with == 0 and found.without_cm == pytest.approx(0.5, abs=0.01)


def test_sums_of_agents() -> None:
    total = DriftBesideOthers(0.01**2 * 4, 4, 0.0, 0) + DriftBesideOthers(0.02**2 * 4, 4, 0.01**2, 1)
    assert total.with_cm == pytest.approx(100 * np.sqrt((0.01**2 + 0.02**2) / 2))
    assert total.without_cm == pytest.approx(1.0)
    assert np.isnan(DriftBesideOthers().share_with)
