"""What the last seconds were like."""

from __future__ import annotations

import math

import pytest

from share.odometry.error_model.history import FrameOutcome, RecentMotion
from share.odometry.error_model.inputs import RECENT_NAMES, recent_features
from share.types import TrackState

S = 1_000_000_000
FINE = FrameOutcome(0, True, TrackState.OK, 50, 50, 0.0)


def told(*frames: FrameOutcome, sigmas_cm=(1.0,), way_m=0.0, turn_rad=0.0) -> dict[str, float]:
    lately = RecentMotion(frames or (FINE,), way_m, turn_rad, sigmas_cm)
    return dict(zip(RECENT_NAMES, recent_features(lately).tolist(), strict=True))


def test_where_all_is_well_nothing_is_told():
    fine = told(FINE, sigmas_cm=(0.0,))
    believed = [fine.pop(f"{what} matches") for what in ("mean", "minimum")]
    assert set(fine.values()) == {0.0}
    assert believed == pytest.approx([math.log(51) / math.log(201)] * 2)


def test_how_sure_it_was_of_itself():
    now = told(sigmas_cm=(0.01, 100.0, 1.0))
    assert [now[f"{what} score"] for what in ("mean", "minimum", "maximum")] == pytest.approx([0.5, 0, 1])


def test_how_far_it_went_and_turned():
    moved = told(way_m=2.5, turn_rad=1.0)
    assert (moved["path"], moved["rotation"]) == pytest.approx((0.5, 0.2))


def test_a_surprise_between_keyframes_is_told():
    now = told(FINE, FINE._replace(median_nis=100.0), FINE, FINE)
    assert (now["mean NIS"], now["maximum NIS"]) == pytest.approx((0.25, 1))


def test_what_was_found_and_not_believed():
    now = told(
        FINE._replace(inlier_count=0),
        FINE._replace(inlier_count=25),
        FINE._replace(found_count=0, inlier_count=0),
        FINE,
    )
    assert now["rejected"] == pytest.approx((1 + 0.5) / 4)
    assert now["minimum matches"] == 0


def test_more_believed_than_found_is_not_less_than_none_refused():
    """The visual tracker takes up old points after it has the pose."""
    assert told(FINE._replace(inlier_count=80))["rejected"] == 0


def test_in_what_state_it_was():
    states = (TrackState.WEAK, TrackState.INERTIAL_ONLY, TrackState.LOST, TrackState.OK)
    now = told(*(FINE._replace(state=state) for state in states))
    assert (now["weak"], now["blind"], now["no IMU"]) == (0.25, 0.5, 0)


def test_without_an_imu_it_was_deaf():
    assert told(FINE, FINE._replace(has_imu=False))["no IMU"] == 0.5


def test_the_longest_time_without_a_frame():
    stamps = (0, S // 15, S, S + S // 15)
    now = told(*(FINE._replace(stamp_ns=stamp) for stamp in stamps))
    assert now["gap"] == pytest.approx(math.log1p(14 / 15 / 0.1) / math.log1p(50))
    assert told(FINE, FINE._replace(stamp_ns=5 * S))["gap"] == pytest.approx(1)
