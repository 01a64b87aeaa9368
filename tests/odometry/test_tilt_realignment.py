"""Published poses when the filter's tilt improves."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from share.geometry import se3
from share.odometry.tilt_realignment import TiltRealignment


@dataclass
class State:
    """What a pivot looks at: the body has come from (1, 0, 0) to (5, 0, 0)."""

    T: np.ndarray = field(default_factory=lambda: at(5.0))
    T_origin: np.ndarray = field(default_factory=lambda: at(1.0))
    stamp_ns: int = 0

    def moved(self, T_new_old: np.ndarray) -> State:
        """The body, and where it began."""
        return State(T_new_old @ self.T, T_new_old @ self.T_origin)


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
    out.start(first, new_segment=True)
    out.update(State())
    assert (out.published_pose(State().T) == State().T).all()
    return out


def test_the_pose_stays_when_the_tilt_improves(pivot):
    learnt = State().moved(turned((0.0, 0.05, 0.0)))
    assert learnt.T[2, 3] < -0.15  # the filter has it elsewhere
    pivot.update(learnt)
    assert pivot.published_pose(learnt.T) == pytest.approx(State().T, abs=1e-9)


def test_the_filter_rotates_about_its_start_not_its_first_published_pose():
    pivot = TiltRealignment()
    pivot.start(State(), new_segment=True)  # 4 m from there
    learnt = State().moved(turned((0.0, 0.05, 0.0)))
    pivot.update(learnt)
    assert pivot.published_pose(learnt.T) == pytest.approx(State().T, abs=1e-9)


def test_later_motion_continues_from_there(pivot):
    learnt = State().moved(turned((0.0, 0.05, 0.0)))
    pivot.update(learnt)
    step = se3.exp(np.array([0.0, 0.0, 0.1, 0.2, 0.1, 0.0]))
    on = State(learnt.T @ step, learnt.T_origin)
    pivot.update(on)
    published = se3.inverse(pivot.published_pose(learnt.T)) @ pivot.published_pose(on.T)
    assert published == pytest.approx(step, abs=1e-9)


def test_the_whole_path_stays_where_it_was_published(pivot):
    """Small turns one after the other about different axes, while the body goes on."""
    state = State()
    for k in range(50):
        axis = np.array([np.sin(0.3 * k), np.cos(0.3 * k), 0.0])
        before = pivot.published_pose(state.T)
        state = state.moved(turned(tuple(0.001 * axis)))
        pivot.update(state)
        assert pivot.published_pose(state.T) == pytest.approx(before, abs=1e-5)


def test_corrections_of_the_body_alone_are_published_as_they_are(pivot):
    """Drift since the origin that the filter mends, tilt included."""
    for correction in (turned((0.0, 0.0, 0.02)), turned((0.02, 0.0, 0.0)), at(0.1)):
        mended = State(correction @ State().T)
        pivot.update(mended)
        assert pivot.published_pose(mended.T) == pytest.approx(mended.T, abs=1e-12)


def test_the_tilt_survives_a_loss_but_not_a_new_segment(pivot):
    learnt = State().moved(turned((0.0, 0.05, 0.0)))
    pivot.update(learnt)
    tilted = pivot.T_odom_filter
    assert se3.rotation_angle(tilted) == pytest.approx(0.05)
    pivot.start(State(), new_segment=False)
    assert (pivot.T_odom_filter == tilted).all()
    pivot.start(State(), new_segment=True)
    assert (pivot.T_odom_filter == np.eye(4)).all()


def test_odom_turns_upright_slowly_about_the_body(pivot):
    learnt = State().moved(turned((0.0, 0.05, 0.0)))
    pivot.update(learnt)
    for frame in range(1, 31):
        learnt.stamp_ns = frame * 10**9 // 30
        pivot.update(learnt)
    assert se3.rotation_angle(pivot.T_odom_filter) == pytest.approx(0.05 - np.radians(0.003), abs=1e-9)
    assert pivot.published_pose(learnt.T)[:3, 3] == pytest.approx([5, 0, 0], abs=1e-9)
    learnt.stamp_ns = 3600 * 10**9
    pivot.update(learnt)
    assert se3.rotation_angle(pivot.T_odom_filter) == pytest.approx(0.0, abs=1e-9)
