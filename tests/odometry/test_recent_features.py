"""Features of the error model about the tracking of the last seconds."""

from __future__ import annotations

import math

import pytest

from share.odometry.error_model.history import FrameOutcome, RecentMotion
from share.odometry.error_model.inputs import RECENT_NAMES, recent_features
from share.types import TrackState

S = 1_000_000_000
FINE = FrameOutcome(0, True, TrackState.OK, 50, 50, 0.0)


def features(*frames: FrameOutcome, sigmas_cm=(1.0,), path_m=0.0, rotation_rad=0.0) -> dict[str, float]:
    motion = RecentMotion(frames or (FINE,), path_m, rotation_rad, sigmas_cm)
    return dict(zip(RECENT_NAMES, recent_features(motion).tolist(), strict=True))


def test_features_are_zero_in_normal_tracking():
    fine = features(FINE, sigmas_cm=(0.0,))
    matches = [fine.pop(f"{what} matches") for what in ("mean", "minimum")]
    assert set(fine.values()) == {0.0}
    assert matches == pytest.approx([math.log(51) / math.log(201)] * 2)


def test_scores():
    now = features(sigmas_cm=(0.01, 100.0, 1.0))
    assert [now[f"{what} score"] for what in ("mean", "minimum", "maximum")] == pytest.approx([0.5, 0, 1])


def test_path_and_rotation():
    moved = features(path_m=2.5, rotation_rad=1.0)
    assert (moved["path"], moved["rotation"]) == pytest.approx((0.5, 0.2))


def test_a_high_nis_between_keyframes():
    now = features(FINE, FINE._replace(median_nis=100.0), FINE, FINE)
    assert (now["mean NIS"], now["maximum NIS"]) == pytest.approx((0.25, 1))


def test_share_of_rejected_features():
    now = features(
        FINE._replace(inlier_count=0),
        FINE._replace(inlier_count=25),
        FINE._replace(found_count=0, inlier_count=0),
        FINE,
    )
    assert now["rejected"] == pytest.approx((1 + 0.5) / 4)
    assert now["minimum matches"] == 0


def test_more_inliers_than_found_features_reject_none():
    """The visual tracker takes up old points after it has the pose."""
    assert features(FINE._replace(inlier_count=80))["rejected"] == 0


def test_shares_of_states():
    states = (TrackState.WEAK, TrackState.INERTIAL_ONLY, TrackState.LOST, TrackState.OK)
    now = features(*(FINE._replace(state=state) for state in states))
    assert (now["weak"], now["blind"], now["no IMU"]) == (0.25, 0.5, 0)


def test_share_of_frames_without_imu():
    assert features(FINE, FINE._replace(has_imu=False))["no IMU"] == 0.5


def test_the_longest_time_without_a_frame():
    stamps = (0, S // 15, S, S + S // 15)
    now = features(*(FINE._replace(stamp_ns=stamp) for stamp in stamps))
    assert now["gap"] == pytest.approx(math.log1p(14 / 15 / 0.1) / math.log1p(50))
    assert features(FINE, FINE._replace(stamp_ns=5 * S))["gap"] == pytest.approx(1)
