"""Runs of wrong IMU samples, of all lengths and sizes: poses stay, and their state and covariance say it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import rig_fuzzer
from helpers.plain_walk import RIG

from share.config import Config
from share.odometry.inertial_tracker import InertialTracker
from share.odometry.track_result import TrackResult
from share.types import Frame, ImuBatch, TrackState

pytestmark = pytest.mark.long

AT = 5  # the frame that they come in


@pytest.fixture(scope="module")
def walk() -> tuple[Frame, ...]:
    return rig_fuzzer.walk(12).frames


@pytest.fixture(scope="module")
def clean(walk: tuple[Frame, ...]) -> list[TrackResult]:
    return tracked(walk)[0]


def tracked(frames: tuple[Frame, ...]) -> tuple[list[TrackResult], InertialTracker]:
    tracker, results = InertialTracker(RIG, Config().inertial), []
    for frame in frames:
        results.append(tracker.track(frame))
        if results[-1].keyframe_ready:
            tracker.make_keyframe(frame)
            tracker.finish_keyframe()
    return results, tracker


def spoiled(walk: tuple[Frame, ...], first: int, count: int, axis: int, by: float) -> tuple[Frame, ...]:
    """`count` samples from number `first` of frame AT on have `by` added."""
    out, left = list(walk), count
    for k in range(AT, len(walk)):
        imu, here = walk[k].imu, first if k == AT else 0
        values = np.hstack([imu.gyro, imu.accel])
        part = values[here : here + left]
        part[:, axis] += by
        left -= len(part)
        out[k] = replace(walk[k], imu=ImuBatch(imu.stamps_ns, values[:, :3], values[:, 3:]))
    assert left == 0
    return tuple(out)


def apart_m(a: list[TrackResult], b: list[TrackResult]) -> list[float]:
    return [
        float(np.linalg.norm(x.T_odom_body[:3, 3] - y.T_odom_body[:3, 3])) for x, y in zip(a, b, strict=True)
    ]


@pytest.mark.parametrize(
    ("first", "count", "axis", "by"),
    [
        (3, 4, 1, 10.0),
        (3, 6, 0, -34.0),
        (10, 10, 2, 34.0),
        (3, 4, 3, 150.0),
        (5, 10, 5, -60.0),
        (11, 2, 1, 2.5),
    ],
)
def test_a_run_of_wrong_samples_is_rejected_and_reported(
    walk: tuple[Frame, ...], clean: list[TrackResult], first: int, count: int, axis: int, by: float
) -> None:
    results, tracker = tracked(spoiled(walk, first, count, axis, by))
    assert tracker.rejected_imu_samples == count
    assert max(apart_m(results, clean)) < 0.02
    assert results[AT].state is TrackState.VISION_ONLY
    assert results[-1].state is TrackState.OK
    assert np.trace(results[AT].cov) > np.trace(clean[AT].cov)


def test_a_wrong_sample_after_the_image_affects_the_next_frame_only(
    walk: tuple[Frame, ...], clean: list[TrackResult]
) -> None:
    last = len(walk[AT].imu) - 1
    assert walk[AT].imu.stamps_ns[last] > walk[AT].stamp_ns
    results, tracker = tracked(spoiled(walk, last, 1, 3, 80.0))
    assert tracker.rejected_imu_samples == 1
    is_rejected = [result.state is TrackState.VISION_ONLY for result in results]
    assert is_rejected == [k == AT + 1 for k in range(len(walk))]
    assert max(apart_m(results, clean)) < 0.02


def with_gap(walk: tuple[Frame, ...]) -> tuple[Frame, ...]:
    """Without the samples from 30 ms on before the fourth last of frame AT."""
    imu = walk[AT].imu
    last = imu.stamps_ns[-4]
    there = (imu.stamps_ns <= last - 30_000_000) | (imu.stamps_ns >= last)
    return (*walk[:AT], replace(walk[AT], imu=imu.take(there)), *walk[AT + 1 :])


@pytest.mark.parametrize(("axis", "by"), [(0, 34.0), (1, 5.0), (2, -20.0), (3, 150.0), (5, -60.0)])
@pytest.mark.parametrize("after", [0, 1, 3])  # right ones in the frame
def test_a_wrong_sample_after_a_gap_is_rejected(
    walk: tuple[Frame, ...], clean: list[TrackResult], after: int, axis: int, by: float
) -> None:
    frames = with_gap(walk)
    first = len(frames[AT].imu) - 4
    cut = replace(frames[AT], imu=frames[AT].imu.take(slice(0, first + 1 + after)))
    later = frames[AT].imu.take(slice(first + 1 + after, None)).concatenate(frames[AT + 1].imu)
    frames = (*frames[:AT], cut, replace(frames[AT + 1], imu=later), *frames[AT + 2 :])
    results, tracker = tracked(spoiled(frames, first, 1, axis, by))
    assert tracker.rejected_imu_samples == 1
    assert max(apart_m(results, clean)) < 0.02
    assert results[-1].state is TrackState.OK


@pytest.mark.parametrize(("axis", "by"), [(1, 30.0), (3, 150.0), (4, 20.0)])
def test_a_wrong_first_sample_is_rejected(walk: tuple[Frame, ...], axis: int, by: float) -> None:
    values = np.hstack([walk[0].imu.gyro, walk[0].imu.accel])
    values[0, axis] += by
    first = replace(walk[0], imu=ImuBatch(walk[0].imu.stamps_ns, values[:, :3], values[:, 3:]))
    without = replace(walk[0], imu=walk[0].imu.take(slice(1, None)))
    results, tracker = tracked((first, *walk[1:]))
    assert tracker.rejected_imu_samples == 1
    assert apart_m(results, tracked((without, *walk[1:]))[0]) == [0.0] * len(walk)


@pytest.mark.parametrize(("axis", "by"), [(1, 0.5), (4, 8.0)])
def test_images_correct_wrong_samples_too_small_to_reject(
    walk: tuple[Frame, ...], clean: list[TrackResult], axis: int, by: float
) -> None:
    results, tracker = tracked(spoiled(walk, 3, 10, axis, by))
    assert tracker.rejected_imu_samples == 0
    assert max(apart_m(results, clean)) < 0.02


def test_no_pose_is_published_in_the_dark_with_wrong_samples(walk: tuple[Frame, ...]) -> None:
    dark = tuple(
        replace(frame, image0=np.zeros_like(frame.image0), image1=np.zeros_like(frame.image1))
        if frame.index >= AT
        else frame
        for frame in walk
    )
    results, _ = tracked(spoiled(dark, 3, 10, 0, 30.0))
    assert results[AT].state is TrackState.LOST
    assert results[AT].T_odom_body is None


def test_no_sample_of_a_normal_walk_is_rejected(walk: tuple[Frame, ...], clean: list[TrackResult]) -> None:
    assert {result.state for result in clean} == {TrackState.OK}
    assert tracked(walk)[1].rejected_imu_samples == 0
