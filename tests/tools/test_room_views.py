"""Views of a room from free places."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.experiments import experiment
from helpers.smallroom import small_room

from share.lab.emulate.world.occupancy import Occupancy

views = experiment("room_views")


def test_views_are_upright_in_the_open_and_seeded() -> None:
    occupancy = Occupancy.from_layout(small_room())
    T = views.standing_views(occupancy, 1, 40)
    assert (occupancy.clearance(T[:, :3, 3]) > 0.25).all()
    assert T[:, 2, 0] == pytest.approx(0)  # the horizon is level
    assert np.linalg.det(T[:, :3, :3]) == pytest.approx(1)
    assert (T[3::4, 2, 3] == 0.35).all() and (np.delete(T, np.s_[3::4], 0)[:, 2, 3] >= 1.5).all()
    assert np.array_equal(T, views.standing_views(occupancy, 1, 40))
    assert not np.array_equal(T, views.standing_views(occupancy, 2, 40))


def test_a_level_camera_has_the_given_yaw_and_pitch() -> None:
    T = views.level_camera_pose((1, 2, 3), np.pi / 2, 0.3)
    assert T[:3, 2] == pytest.approx([0, np.cos(0.3), np.sin(0.3)])
    assert T[:3, 0] == pytest.approx([1, 0, 0]) and T[2, 1] < 0  # right, and down


def test_a_full_room_is_refused() -> None:
    with pytest.raises(ValueError, match=r"no free place for a body 1\.9 m tall"):
        views.standing_views(Occupancy(np.ones((20, 20, 40), bool), 0.1), 1, 1)
