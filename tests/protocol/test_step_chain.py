"""Poses relative to earlier keyframes have to agree with the steps that an agent sent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.hellos import hello_of

from share.earlier_poses import EarlierPoses
from share.geometry import se3
from share.protocol.keyframe_intake import OdometryBase, StepChain, sanitise
from share.types import F64, Keyframe, View

CAMERA = hello_of("ann", 1).rig.cam0
STEP = se3.exp(np.array([0.0, 0.05, 0.1, 0.2, 0.0, 0.05]))
COV = 1e-6 * np.eye(6)


def chain(n: int, first: int = 0) -> StepChain:
    """Of keyframes first .. first + n - 1."""
    out = StepChain.start(first)
    for k in range(first + 1, first + n):
        out = out.extended(k, STEP, COV)
    return out


def power(n: int) -> F64:
    return np.linalg.matrix_power(STEP, n)


def earlier(poses: dict[int, F64]) -> EarlierPoses:
    """Relative to these keyframes."""
    T = np.array(list(poses.values())).reshape(-1, 4, 4)
    return EarlierPoses(np.array(list(poses), np.int64), T, np.tile(COV, (len(poses), 1, 1)))


def test_poses_that_agree_with_the_steps_are_kept() -> None:
    said = earlier({k: power(9 - k) @ se3.exp(np.full(6, 0.001)) for k in (2, 5, 8)})
    agreed, problem = chain(10).agreeing(said)
    assert agreed is said and problem is None


@pytest.mark.parametrize(
    ("xi", "is_kept"),
    [
        ([0, 0, 0, 0.004, 0, 0], True),
        ([0, 0, 0, 0, 0.02, 0], False),
        ([0.003, 0, 0, 0, 0, 0], True),
        ([0, 0, 0.01, 0, 0, 0], False),
        ([0, np.pi, 0, 0, 0, 0], False),
        ([0, 0, 0, 0, 0, 9e3], False),
    ],
)
def test_a_pose_that_contradicts_the_steps_is_left_out_and_said(xi: list[float], is_kept: bool) -> None:
    said = earlier({3: power(6), 6: power(3) @ se3.exp(np.array(xi, float))})
    agreed, problem = chain(10).agreeing(said)
    assert agreed.ids.tolist() == ([3, 6] if is_kept else [3])
    assert (problem is None) is is_kept
    assert problem is None or "relative to keyframe 6 is " in problem


def test_poses_that_cannot_be_checked_are_left_out() -> None:
    """Relative to itself, to later ones, to those that the chain forgot or never had."""
    said = earlier({k: np.eye(4) for k in (-1, 0, 4, 149, 150, 2**31)} | {140: power(9)})
    agreed, problem = chain(150).agreeing(said)
    assert agreed.ids.tolist() == [140] and problem is None
    assert len(chain(200).ids) == 64


def test_a_pose_is_no_surer_than_half_a_step() -> None:
    """Also one that says it is certain; what agents send is not changed."""
    said = earlier({3: power(6), 6: power(3)})
    for sure, expected in ((0.0, 0.5), (0.2, 0.5), (0.6, 0.6), (3.0, 3.0)):
        claimed = replace(said, cov=(sure * np.tile(COV, (2, 1, 1))).astype(np.float32))
        agreed, problem = chain(10).agreeing(claimed)
        assert problem is None and (agreed is claimed) is (sure > 0.5)
        np.testing.assert_allclose(agreed.cov.diagonal(axis1=1, axis2=2), expected * 1e-6, rtol=1e-5)


def test_of_vague_steps_no_pose_is_sure() -> None:
    """Old steps do not count."""
    steps = chain(100)
    for k in range(100, 104):
        steps = steps.extended(k, STEP, 1e4 * COV)
    agreed, _ = steps.agreeing(earlier({101: power(2), 97: power(6)}))
    np.testing.assert_allclose(agreed.cov[:, 0, 0], [0.5e-2, 0.5 * (4e-2 + 2e-6) / 6], rtol=1e-4)


def test_a_chain_of_badly_rounded_steps_stays_rigid() -> None:
    """A step may be out of true by 1e-3; thousands of them must not add up."""
    stretched = STEP.copy()
    stretched[:3, :3] *= 1 + 4e-4
    out = StepChain.start(0)
    for k in range(3000):
        out = out.extended(k + 1, stretched, COV)
    R = out.T_first_body[-1, :3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)


def sent(k: int, spans: EarlierPoses, starts: bool = False) -> Keyframe:
    T = power(k)
    reference, T_ref = (-1, T) if starts or not k else (k - 1, STEP)
    return Keyframe(
        k, reference, 10**8 * k, T_ref, COV, T, np.zeros(3), 0.0, View.empty(), k - 1, earlier=spans
    )


def test_the_edge_remembers_the_steps_of_a_run_and_begins_anew_with_a_segment() -> None:
    base: OdometryBase | None = None
    for k in range(6):
        keyframe, problem = sanitise(sent(k, earlier({}), starts=k == 3), base, CAMERA)
        assert problem is None
        base = OdometryBase.from_keyframe(keyframe, base)
    assert base is not None
    spans = earlier({2: power(4), 3: power(3), 4: power(2) @ se3.exp(np.array([0, 0, 0, 0, 0.5, 0]))})
    got, problem = sanitise(sent(6, spans), base, CAMERA)
    assert got.earlier.ids.tolist() == [3]
    assert problem is not None and problem.startswith("keyframe 6: its pose relative to keyframe 4 is 0.5 m")
    untouched = sent(6, earlier({3: power(3)}))
    assert sanitise(untouched, base, CAMERA) == (untouched, None)
    assert replace(untouched).earlier is untouched.earlier
