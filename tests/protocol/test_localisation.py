"""How the pose follows corrections, the sigma of the agent's map position, and its expected drift."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.model_edge import EMPTY, MS, UP, S

from share.geometry import se3
from share.metrics.local_error import LocalError
from share.protocol.localisation import WALK_PER_LOCAL, DriftEstimator, MapFrame
from share.types import Correction, Keyframe


def placed(cov: np.ndarray, T_map_odom: np.ndarray) -> MapFrame:
    frame = MapFrame(0.5)
    frame.apply(Correction(T_map_odom, cov, "a", 1, 0), np.eye(4), 0)
    return frame


def test_rotation_uncertainty_grows_with_the_distance_from_the_origin() -> None:
    cov = np.diag([0, 0, 0.01**2, 0.03**2, 0, 0])
    frame = placed(cov, np.eye(4))
    at = [frame.sigma_cm(se3.from_rt(np.eye(3), np.array([0, y, 0]))) for y in (0.0, 4.0)]
    assert at == pytest.approx([3.0, 5.0])  # cm: 3, and with 4 m x 0.01 rad


def test_the_map_sigma_agrees_with_samples(rng) -> None:
    T_map_odom = se3.from_rt(se3.so3_exp(np.array([0.1, -0.2, 1.0])), np.array([1.0, 2, 0]))
    T_odom_body = se3.from_rt(se3.so3_exp(np.array([0.3, 0.1, -0.5])), np.array([3.0, -1, 0.5]))
    root = rng.normal(0, 0.003, (6, 6))
    drawn = T_map_odom @ se3.exp(rng.normal(size=(20_000, 6)) @ root.T) @ T_odom_body
    spread = np.sqrt(drawn[:, :3, 3].var(axis=0).sum())
    assert placed(root @ root.T, T_map_odom).sigma_cm(T_odom_body) == pytest.approx(100 * spread, rel=0.02)


def test_the_map_sigma_is_zero_before_a_correction() -> None:
    frame = MapFrame(0.5)
    assert frame.sigma_cm(np.eye(4)) == 0.0
    frame = placed(np.eye(6), np.eye(4))
    frame.reset()
    assert frame.sigma_cm(np.eye(4)) == 0.0


FRAME_NS = S // 15


def moved_to(xyz: tuple[float, float, float], yaw: float = 0.0) -> np.ndarray:
    return se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, yaw])), np.array(xyz, float))


def followed(frame: MapFrame, T_odom_body: np.ndarray, seconds: float, start_ns: int = 0) -> list[np.ndarray]:
    """T_map_body of each frame at 15 Hz, the body at rest."""
    out = []
    for k in range(1, int(15 * seconds) + 1):
        frame.advance(T_odom_body, start_ns + k * FRAME_NS)
        assert frame.T_map_odom is not None
        out.append(frame.T_map_odom @ T_odom_body)
    return out


def steps_m(poses: list[np.ndarray], ahead_m: float = 0.0) -> np.ndarray:
    """Steps of a point on the body's x axis, m."""
    points = np.array([(T @ (ahead_m, 0, 0, 1))[:3] for T in poses])
    return np.linalg.norm(np.diff(points, axis=0), axis=1)


def correct(
    frame: MapFrame, T_map_odom: np.ndarray, T_odom_body: np.ndarray, now_ns: int, map_id: str = "a"
) -> bool:
    return frame.apply(Correction(T_map_odom, np.eye(6) * 1e-6, map_id, 1, 0), T_odom_body, now_ns)


@pytest.mark.parametrize(
    "way", [moved_to((0.04, 0, 0)), moved_to((0, 0, 0), 0.005), moved_to((0.2, 0, 0), 0.02)]
)
def test_a_correction_comes_without_visible_steps_and_arrives(way: np.ndarray) -> None:
    T_odom_body = moved_to((7.0, -3.0, 1.0), 0.7)
    frame = MapFrame(0.5)
    assert correct(frame, np.eye(4), T_odom_body, 0)
    assert not correct(frame, way, T_odom_body @ np.eye(4), 0)
    goal = way @ T_odom_body
    poses = [T_odom_body, *followed(frame, T_odom_body, 30.0)]
    is_long = np.linalg.norm((goal - T_odom_body)[:3, 3]) > 0.1
    assert max(steps_m(poses).max(), steps_m(poses, 3.0).max()) < (3e-3 if is_long else 1e-3)
    np.testing.assert_allclose(poses[-1], goal, atol=1e-6)


def test_a_turn_far_from_the_origin_counts_at_the_body() -> None:
    frame, T_odom_body = MapFrame(0.5), moved_to((50.0, 0, 0))
    correct(frame, np.eye(4), T_odom_body, 0)
    about_the_body = T_odom_body @ moved_to((0, 0, 0), 0.005) @ se3.inverse(T_odom_body)
    correct(frame, about_the_body, T_odom_body, 0)
    assert steps_m([T_odom_body, *followed(frame, T_odom_body, 5.0)]).max() < 1e-9  # it turns where it is


def test_a_newer_correction_never_makes_a_step() -> None:
    frame, T_odom_body = MapFrame(0.5), moved_to((2.0, 1.0, 0))
    correct(frame, np.eye(4), T_odom_body, 0)
    poses = [T_odom_body]
    for k in range(12):  # before the last one has arrived
        correct(frame, moved_to((0.05 * (-1) ** k, 0.02, 0)), T_odom_body, k * S // 3)
        poses += followed(frame, T_odom_body, 1 / 3, k * S // 3)
    assert steps_m(poses).max() < 1.01e-3


def test_the_time_to_settle_is_measured_from_the_first_of_several_corrections() -> None:
    frame, T_odom_body = MapFrame(0.5), np.eye(4)
    correct(frame, np.eye(4), T_odom_body, 0)
    assert frame.advance(T_odom_body, FRAME_NS) is None
    correct(frame, moved_to((0.01, 0, 0)), T_odom_body, S)
    settled = [s for k in range(1, 60) if (s := frame.advance(T_odom_body, S + k * FRAME_NS)) is not None]
    assert len(settled) == 1
    assert 0.5 < settled[0] < 2.5


def test_a_correction_that_is_taken_back_leaves_no_time_running() -> None:
    frame, T_odom_body = MapFrame(0.5), np.eye(4)
    correct(frame, np.eye(4), T_odom_body, 0)
    correct(frame, moved_to((0.05, 0, 0)), T_odom_body, S)
    correct(frame, np.eye(4), T_odom_body, S)
    correct(frame, moved_to((0.002, 0, 0)), T_odom_body, 60 * S)
    settled = [
        s for k in range(1, 30) if (s := frame.advance(T_odom_body, 60 * S + k * FRAME_NS)) is not None
    ]
    assert len(settled) == 1 and settled[0] < 2.0


def test_another_map_or_a_long_way_makes_the_pose_jump() -> None:
    frame, T_odom_body = MapFrame(0.5), np.eye(4)
    assert correct(frame, np.eye(4), T_odom_body, 0)
    assert correct(frame, moved_to((0.02, 0, 0)), T_odom_body, 1, "b")
    np.testing.assert_array_equal(frame.T_map_odom, moved_to((0.02, 0, 0)))
    assert not correct(frame, moved_to((0.9, 0, 0)), T_odom_body, 2, "b")
    assert correct(frame, moved_to((1.5, 0, 0)), T_odom_body, 3, "b")
    np.testing.assert_array_equal(frame.T_map_odom, moved_to((1.5, 0, 0)))


COV = np.diag([1e-6, 1e-6, 1e-6, 4e-6, 4e-6, 4e-6])
AHEAD = se3.from_rt(se3.so3_exp(np.array([0, 0, 0.2])), np.array([0.3, 0, 0]))


def sent(drift: DriftEstimator, count: int, first: int = 0) -> None:
    """Add keyframes, ten a second, the first without a reference."""
    for k in range(first, first + count):
        keyframe = Keyframe(k, k - 1, k * 100 * MS, AHEAD, COV, np.eye(4), UP, 0.01, EMPTY)
        drift.add_keyframe(keyframe, k * 100 * MS)


def test_drift_is_the_covariance_of_the_motion_since_the_correction() -> None:
    drift = DriftEstimator()
    assert drift.expected_cm(None, 0) is None
    sent(drift, 20)
    drift.correct(7)
    cov = np.zeros((6, 6))
    for _ in range(12):
        cov = se3.compose_cov(AHEAD, cov, COV)
    expected = 100 * np.sqrt(np.trace(cov[3:, 3:]))
    assert drift.expected_cm(None, 2 * S) == pytest.approx(expected, rel=1e-12)
    drift.correct(3)  # an old one changes nothing
    assert drift.expected_cm(None, 2 * S) == pytest.approx(expected, rel=1e-12)
    drift.correct(19)
    assert drift.expected_cm(None, 2 * S) == 0.0


def test_old_motions_are_merged_not_dropped() -> None:
    drift, cov = DriftEstimator(), np.zeros((6, 6))
    sent(drift, 500)
    for _ in range(499):
        cov = se3.compose_cov(AHEAD, cov, COV)
    assert drift.expected_cm(None, 50 * S) == pytest.approx(100 * np.sqrt(np.trace(cov[3:, 3:])), rel=1e-9)


def test_an_error_estimate_grows_as_a_random_walk() -> None:
    drift = DriftEstimator()
    sent(drift, 11)
    drift.correct(10)  # at 1 s
    expected = [drift.expected_cm(2.0, round((1 + age) * S)) for age in (0, 0.05, 1.25, 5, 20)]
    assert expected == pytest.approx(WALK_PER_LOCAL * np.array([0.0, 0.2, 1.0, 2.0, 4.0]))


def test_the_drift_of_a_random_walk_follows_from_its_local_error() -> None:
    """Walks over paths that turn, drift of 0.5 to 20 s."""
    rng = np.random.default_rng(0)
    stamps = np.arange(0, 40 * S, S // 20)
    ratios = []
    for _ in range(20):
        turns = np.cumsum(np.cumsum(rng.normal(0, 0.02, (len(stamps), 2)), axis=0), axis=0)
        heading = np.stack([np.cos(turns[:, 0]), np.sin(turns[:, 0]), 0.3 * np.sin(turns[:, 1])], axis=1)
        true = np.cumsum(0.05 * heading, axis=0)
        errors = np.cumsum(rng.normal(0, 2e-4, (len(stamps), 3)), axis=0)
        truth, seen = (np.tile(np.eye(4), (len(stamps), 1, 1)) for _ in range(2))
        truth[:, :3, 3], seen[:, :3, 3] = true, true + errors
        measured = LocalError((stamps, truth))
        local_cm = [measured.update(int(stamp), T) for stamp, T in zip(stamps, seen, strict=True)]
        squares = [cm**2 for cm in local_cm if cm is not None]
        for frames in (10, 40, 200, 400):
            drift_cm = 100 * np.linalg.norm(errors[frames:] - errors[:-frames], axis=1)
            walk = np.sqrt(np.mean(squares) * frames / 100)
            ratios.append(np.sqrt(np.mean(drift_cm**2)) / walk)
    assert np.median(ratios) == pytest.approx(WALK_PER_LOCAL, rel=0.1)


def test_a_new_segment_has_no_drift() -> None:
    drift = DriftEstimator()
    sent(drift, 20)
    fresh = Keyframe(20, -1, 2 * S, np.eye(4), COV, np.eye(4), UP, 0.01, EMPTY)
    drift.add_keyframe(fresh, 2 * S)
    assert drift.expected_cm(None, 2 * S) == 0.0
    assert drift.expected_cm(1.0, 3 * S) == pytest.approx(WALK_PER_LOCAL * np.sqrt(0.2))
