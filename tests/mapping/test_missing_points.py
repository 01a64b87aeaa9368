from dataclasses import replace

import numpy as np
import pytest
from helpers.place_sim import bodies, sights
from numpy.typing import NDArray

from share.geometry import se3
from share.mapping.missing_points import (
    MissingPoints,
    MissingRegions,
    missing_points,
    missing_regions,
    vanished_regions,
)
from share.mapping.recognition.verification import CameraView
from share.types import View

T_C_Q = se3.exp(np.array([0.02, -0.03, 0.01, 0.1, 0.05, -0.1]))


def test_no_point_is_missing_in_views_of_the_same() -> None:
    seen = missing_points(*sights(0, T_C_Q), bodies(T_C_Q))
    assert seen.visible > 300
    assert seen.missing_share < 0.1


def changed(camera_view: CameraView, where: NDArray[np.bool_]) -> CameraView:
    """The same view, with something else at the keypoints where (N,)."""
    view = camera_view.view
    other = np.random.default_rng(0).integers(0, 256, view.descriptors.shape, np.uint8)
    return replace(
        camera_view, view=View(view.uv, view.points, np.where(where[:, None], other, view.descriptors))
    )


def test_removed_points_are_missing_and_form_a_missing_region() -> None:
    """A third of the candidate's image shows something else."""
    query, candidate = sights(1, T_C_Q, n=1500)
    u = candidate.view.uv[:, 0]
    bare = changed(candidate, u < np.quantile(u, 1 / 3))
    assert missing_points(query, bare, bodies(T_C_Q)).missing_share == pytest.approx(1 / 3, abs=0.1)
    assert missing_regions(query, bare, bodies(T_C_Q)).missing_share == pytest.approx(
        1 / 3 - 0.05, abs=0.05
    )  # not at its edge


def test_scattered_missing_points_form_no_region() -> None:
    """Half of the points, as detectors miss them."""
    query, candidate = sights(1, T_C_Q, n=1500)
    some = changed(candidate, np.random.default_rng(1).random(len(candidate.view)) < 0.5)
    assert missing_points(query, some, bodies(T_C_Q)).missing_share > 0.45
    assert missing_regions(query, some, bodies(T_C_Q)).missing_share < 0.01
    assert missing_regions(query, candidate, bodies(T_C_Q)).missing_share == 0


def test_at_a_wrong_pose_nearly_all_points_are_missing() -> None:
    aside = bodies(T_C_Q) @ se3.exp(np.array([0.1, 0.1, 0, 0.3, 0, 0]))
    assert missing_points(*sights(2, T_C_Q), aside).missing_share > 0.9


def test_occluded_points_are_not_missing() -> None:
    """The candidate is in front of a wall at 1 m; points behind it are not expected."""
    query, candidate = sights(3, T_C_Q, depth_share=1.0)
    view = candidate.view
    wall = View(view.uv, view.points / view.points[:, 2:], np.zeros_like(view.descriptors))
    seen = missing_points(query, replace(candidate, view=wall), bodies(T_C_Q))
    full = missing_points(query, candidate, bodies(T_C_Q))
    assert seen.visible < 0.6 * full.visible


def test_an_empty_view_has_no_missing_points() -> None:
    query, candidate = sights(4, T_C_Q)
    empty = View(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 32), np.uint8))
    assert missing_points(query, replace(candidate, view=empty), np.eye(4)) == MissingPoints(0, 0)
    assert missing_regions(query, replace(candidate, view=empty), np.eye(4)) == MissingRegions(0, 0, 0)
    assert MissingPoints(0, 0).missing_share == MissingRegions(0, 0, 0).missing_share == 0.0


def test_what_is_gone_is_of_the_old_view_only() -> None:
    """One side of the old view shows what the new one does not; what is new there does not count."""
    query, candidate = sights(5, T_C_Q)
    where = candidate.view.uv[:, 0] > 0.1
    old = changed(candidate, where)
    gone = vanished_regions(old, query, se3.inverse(bodies(T_C_Q)))
    both = missing_regions(query, old, bodies(T_C_Q))
    assert gone.missing_share > 0.05
    assert gone.missing < both.missing
    assert vanished_regions(candidate, query, se3.inverse(bodies(T_C_Q))).missing == 0
