import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.place_sim import bodies, sights

from share.checks import MAX_POSITION_M
from share.geometry import se3
from share.mapping.recognition import verification
from share.mapping.recognition.verification import CameraView, Refusal, Verification, verify
from share.types import MAX_UV, View

T_C_Q = se3.exp(np.array([0.1, -0.15, 0.05, 0.3, 0.1, -0.2]))


def test_finds_the_pose_between_bodies() -> None:
    found = verify(*sights(0, T_C_Q))
    assert isinstance(found, Verification), found
    xi = se3.log(se3.inverse(bodies(T_C_Q)) @ found.T_c_q)
    assert np.linalg.norm(xi[:3]) < np.radians(0.5)
    assert np.linalg.norm(xi[3:]) < 0.02
    assert found.inliers > 200
    assert found.reason == f"{found.inliers} inliers of {found.matches} matches"


def test_covariance_of_the_body_pose_is_consistent(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("_FLOOR_DEG", 1e-6), ("_FLOOR_M", 1e-6), ("SIGMA_PX", 1.0)):
        monkeypatch.setattr(verification, name, value)
    nees = []
    for seed in range(40):
        found = verify(*sights(seed, T_C_Q))
        assert isinstance(found, Verification)
        xi = se3.log(se3.inverse(bodies(T_C_Q)) @ found.T_c_q)
        nees.append(xi @ np.linalg.solve(found.cov, xi))
    assert 4.0 < np.mean(nees) < 9.0


def test_the_reverse_query_has_the_inverse_pose() -> None:
    query, candidate = sights(1, T_C_Q)
    there, back = verify(query, candidate), verify(candidate, query)
    assert isinstance(there, Verification)
    assert isinstance(back, Verification)
    assert np.abs(se3.log(there.T_c_q @ back.T_c_q)).max() < 2e-3


def test_same_input_same_output() -> None:
    pair = sights(2, T_C_Q)
    first, second = verify(*pair, seed=7), verify(*pair, seed=7)
    assert isinstance(first, Verification)
    assert isinstance(second, Verification)
    assert first.T_c_q.tobytes() == second.T_c_q.tobytes()


def reason(query: CameraView, candidate: CameraView) -> str:
    found = verify(query, candidate)
    assert isinstance(found, Refusal), found
    return found.reason


def test_another_place_has_too_few_close_matches() -> None:
    assert reason(sights(3, T_C_Q)[0], sights(4, T_C_Q)[1]).endswith("close matches of 12 needed")


def test_descriptors_without_geometry_are_refused() -> None:
    query, candidate = sights(5, T_C_Q)
    order = np.random.default_rng(0).permutation(len(query.view))
    shuffled = View(query.view.uv[order], query.view.points[order], query.view.descriptors)
    why = reason(replace(query, view=shuffled), candidate)
    assert re.fullmatch(r"\d inliers of the (query|candidate)'s points of 8 needed", why)


def test_without_depth_on_one_side_it_is_refused() -> None:
    query, candidate = sights(6, T_C_Q)
    blind = View(query.view.uv, np.full_like(query.view.points, np.nan), query.view.descriptors)
    assert reason(replace(query, view=blind), candidate) == "0 matches with the query's depth of 8 needed"


def test_gravity_must_agree() -> None:
    query, candidate = sights(7, T_C_Q)
    tilted = replace(query, up=se3.so3_exp(np.array([0.2, 0, 0])) @ query.up)
    assert reason(tilted, candidate).startswith("gravity differs by 11.")
    assert isinstance(verify(replace(query, up=np.zeros(3)), candidate), Verification)


def test_scale_that_differs_between_the_directions_is_refused() -> None:
    """A view with doubled depths gives a doubled motion."""
    query, candidate = sights(8, T_C_Q)
    stretched = View(query.view.uv, query.view.points * 2, query.view.descriptors)
    refused = verify(replace(query, view=stretched), candidate)
    assert isinstance(refused, Refusal) and refused.reason.startswith("two poses fit")
    assert len(refused.possible_poses) == 2


@pytest.mark.parametrize("half", [0.05])
def test_inliers_in_one_corner_are_refused(half: float, monkeypatch: pytest.MonkeyPatch) -> None:
    query, candidate = sights(9, T_C_Q)
    near = np.abs(candidate.view.uv - candidate.view.uv.mean(0)).max(1) < half * 3
    # only what lies in the corner keeps its descriptor
    rng = np.random.default_rng(0)
    others = np.where(
        near[:, None], candidate.view.descriptors, rng.integers(0, 256, (len(near), 32), np.uint8)
    )
    corner = View(candidate.view.uv, candidate.view.points, others)
    limits = {
        "MIN_INLIERS": 8,
        "MIN_MATCHES": 10,
        "MIN_DIRECTION_INLIERS": 6,
        "_MIN_CONSENSUS": 6,
        "MIN_SPREAD": 0.15,
    }
    for name, value in limits.items():
        monkeypatch.setattr(verification, name, value)
    assert "inliers crowd in the" in reason(query, replace(candidate, view=corner))


def test_an_uncertain_pose_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verification, "MAX_SIGMA_DEG", 0.01)
    query, candidate = sights(10, T_C_Q)
    refused = verify(query, candidate)
    assert isinstance(refused, Refusal) and "pose uncertain by" in refused.reason
    (unsure,) = refused.possible_poses  # of the bodies
    assert np.abs(se3.log(se3.inverse(bodies(T_C_Q)) @ unsure)).max() < 0.02


def test_empty_views_are_refused() -> None:
    empty = View(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 32), np.uint8))
    query, candidate = sights(11, T_C_Q)
    assert reason(replace(query, view=empty), candidate) == "0 close matches of 12 needed"
    assert reason(query, replace(candidate, view=empty)) == "0 close matches of 12 needed"


@pytest.mark.parametrize("seed", range(40))
def test_hostile_numbers_do_not_raise(seed: int) -> None:
    """Values as large as the types admit, repeated, collinear or absurd, as a broken peer may send them."""
    rng = np.random.default_rng(seed)
    query, candidate = sights(12, T_C_Q)
    uv, points = query.view.uv.copy(), query.view.points.copy()
    some = rng.random(len(uv)) < 0.5 + 0.5 * (seed % 2)
    kind = seed % 5
    if kind == 0:
        uv[some], points[some] = MAX_UV, MAX_POSITION_M
    elif kind == 1:
        points[some, 2] = rng.choice([0.0, -1.0, 1e-30, MAX_POSITION_M], some.sum())
    elif kind == 2:
        uv[some], points[some] = uv[0], points[0]
    elif kind == 3:
        uv[some, 1], points[some, 1] = 0, 0
    else:
        points[some] = points[some][:, ::-1]
    broken = replace(
        query, view=View(uv, points, query.view.descriptors), up=rng.normal(0, 10.0 ** (seed % 9), 3)
    )
    for result in (
        verify(broken, candidate),
        verify(candidate, broken),
        verify(broken, broken),
    ):
        assert isinstance(result, Verification | Refusal)
