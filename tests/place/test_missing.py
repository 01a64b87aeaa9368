from dataclasses import replace

import numpy as np
import pytest
from place_sim import bodies, sights

from share.geometry import se3
from share.place.missing import Missing, missing
from share.types import View

T_C_Q = se3.exp(np.array([0.02, -0.03, 0.01, 0.1, 0.05, -0.1]))


def test_nothing_is_missing_where_both_see_the_same() -> None:
    seen = missing(*sights(0, T_C_Q), bodies(T_C_Q))
    assert seen.visible > 300
    assert seen.share < 0.1


def test_what_was_taken_away_is_missing() -> None:
    """A third of the candidate's image shows something else."""
    query, candidate = sights(1, T_C_Q)
    view = candidate.view
    left = view.uv[:, 0] < np.quantile(view.uv[:, 0], 1 / 3)
    other = np.random.default_rng(0).integers(0, 256, view.descriptors.shape, np.uint8)
    changed = View(view.uv, view.points, np.where(left[:, None], other, view.descriptors))
    seen = missing(query, replace(candidate, view=changed), bodies(T_C_Q))
    assert seen.share == pytest.approx(1 / 3, abs=0.1)


def test_a_wrong_pose_misses_nearly_all() -> None:
    aside = bodies(T_C_Q) @ se3.exp(np.array([0.1, 0.1, 0, 0.3, 0, 0]))
    assert missing(*sights(2, T_C_Q), aside).share > 0.9


def test_what_is_hidden_is_not_missing() -> None:
    """The candidate stands before a wall 1 m away; what is behind it cannot be expected."""
    query, candidate = sights(3, T_C_Q, depth_share=1.0)
    view = candidate.view
    wall = View(view.uv, view.points / view.points[:, 2:], np.zeros_like(view.descriptors))
    seen = missing(query, replace(candidate, view=wall), bodies(T_C_Q))
    full = missing(query, candidate, bodies(T_C_Q))
    assert seen.visible < 0.6 * full.visible


def test_an_empty_view_says_nothing() -> None:
    query, candidate = sights(4, T_C_Q)
    empty = View(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 32), np.uint8))
    assert missing(query, replace(candidate, view=empty), np.eye(4)) == Missing(0, 0)
    assert Missing(0, 0).share == 0.0
