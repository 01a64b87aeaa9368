"""Published positions when the filter's tilt improves."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from share.geometry import se3
from share.odometry.tilt_realignment import TiltRealignment

BEGAN = np.array([1.0, 0.0, 0.0])


@dataclass
class State:
    """What a pivot looks at: the body has come from (1, 0, 0) to (5, 0, 0), keyframes on the way."""

    T: np.ndarray = field(default_factory=lambda: at(5.0))
    keyframe_ids: np.ndarray = field(default_factory=lambda: np.arange(5))
    keyframe_poses: np.ndarray = field(
        default_factory=lambda: np.stack([at(x) for x in (1.0, 2.0, 3.0, 4.0, 5.0)])
    )
    stamp_ns: int = 0

    def moved(self, T_new_old: np.ndarray, some: slice = slice(None)) -> State:
        """The body, and these keyframes."""
        poses = self.keyframe_poses.copy()
        poses[some] = T_new_old @ poses[some]
        return State(T_new_old @ self.T, self.keyframe_ids, poses)


def at(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def turned(phi: tuple[float, float, float], about: float = 1.0) -> np.ndarray:
    """About the place (about, 0, 0)."""
    R = np.eye(4)
    R[:3, :3] = se3.so3_exp(np.array(phi))
    return at(about) @ R @ at(-about)


@pytest.fixture
def pivot() -> TiltRealignment:
    out = TiltRealignment()
    first = State(T=at(1.0))
    out.start(first, BEGAN, new_segment=True)
    out.update(State())
    assert (out.published_pose(State().T) == State().T).all()
    return out


def test_the_position_stays_when_the_tilt_improves(pivot):
    learnt = State().moved(turned((0.0, 0.05, 0.0)))
    assert learnt.T[2, 3] < -0.15  # the filter has it elsewhere
    pivot.update(learnt)
    published = pivot.published_pose(learnt.T)
    assert published[:3, 3] == pytest.approx([5, 0, 0], abs=1e-9)
    assert (published[:3, :3] == learnt.T[:3, :3]).all()  # up is right at once


def test_the_filter_rotates_about_its_start_not_its_first_published_pose():
    pivot = TiltRealignment()
    pivot.start(State(), BEGAN, new_segment=True)  # 4 m from there
    learnt = State().moved(turned((0.0, 0.05, 0.0)))
    pivot.update(learnt)
    assert pivot.published_pose(learnt.T)[:3, 3] == pytest.approx([5, 0, 0], abs=1e-9)


def test_later_motion_continues_from_there(pivot):
    learnt = State().moved(turned((0.0, 0.05, 0.0)))
    pivot.update(learnt)
    step = se3.exp(np.array([0.0, 0.0, 0.1, 0.2, 0.1, 0.0]))
    on = State(learnt.T @ step, learnt.keyframe_ids, learnt.keyframe_poses)
    pivot.update(on)
    published = se3.inverse(pivot.published_pose(learnt.T)) @ pivot.published_pose(on.T)
    assert published == pytest.approx(step, abs=1e-9)


def test_other_corrections_are_published_as_they_are(pivot):
    for correction in (turned((0.0, 0.0, 0.02)), at(0.1)):
        mended = State().moved(correction)
        pivot.update(mended)
        assert (pivot.published_pose(mended.T) == mended.T).all()
        pivot.update(State())


def test_dropped_keyframes_do_not_count(pivot):
    learnt = State().moved(turned((0.0, 0.05, 0.0)))
    learnt.keyframe_ids = learnt.keyframe_ids + 100
    pivot.update(learnt)
    assert (pivot.offset == 0).all()


def test_the_offset_survives_a_loss_but_not_a_new_segment(pivot):
    learnt = State().moved(turned((0.0, 0.05, 0.0)))
    pivot.update(learnt)
    shift = pivot.offset
    assert np.linalg.norm(shift) > 0.1
    pivot.start(State(), BEGAN, new_segment=False)
    assert (pivot.offset == shift).all()
    pivot.start(State(), BEGAN, new_segment=True)
    assert (pivot.offset == 0).all()


def test_the_position_returns_to_the_filters_at_a_centimetre_a_second(pivot):
    learnt = State().moved(turned((0.0, 0.05, 0.0)))
    pivot.update(learnt)
    off_m = np.linalg.norm(pivot.offset)
    for frame in range(1, 31):
        learnt.stamp_ns = frame * 10**9 // 30
        pivot.update(learnt)
    assert np.linalg.norm(pivot.offset) == pytest.approx(off_m - 0.01, abs=1e-9)
    learnt.stamp_ns = 60 * 10**9
    pivot.update(learnt)
    assert (pivot.offset == 0).all()
