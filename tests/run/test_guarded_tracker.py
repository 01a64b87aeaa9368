"""No rig and no failure within a tracker ends the process that tracks."""

from __future__ import annotations

import resource
import time

import numpy as np
import pytest
from helpers import rig_fuzzer
from helpers.plain_walk import RIG

from share.config import Config, InertialConfig
from share.geometry import rig_check, se3
from share.geometry.camera import ImuBias, Rig
from share.odometry import filter
from share.odometry.inertial_tracker import InertialTracker
from share.odometry.track_result import TrackResult
from share.runtime.guarded_tracker import FaultGuard, GuardedTracker
from share.types import TrackState
from share.vision import corners


@pytest.fixture(scope="module")
def walk() -> rig_fuzzer.Walk:
    return rig_fuzzer.walk(8)


def played(walk: rig_fuzzer.Walk, tracker: GuardedTracker, fails: dict[int, pytest.MonkeyPatch]) -> list:
    results = []
    for frame in walk.frames:
        if (broken := fails.get(frame.index)) is not None:
            with broken.context() as patch:
                patch.setattr(filter, "_whitened_update", _no_gain)
                patch.setattr(corners, "count_fast", _no_gain)
                results.append(tracker.track(frame))
            continue
        results.append(tracker.track(frame))
        if results[-1].keyframe_ready:
            tracker.attempt("a keyframe", frame, lambda frame=frame: rig_fuzzer._keep(tracker, frame))
    return results


def _no_gain(*anything: object, **more: object) -> None:
    raise np.linalg.LinAlgError("innovation covariance is not positive definite")


def test_an_update_that_fails_costs_its_frame_and_odometry_finds_itself_again(
    walk: rig_fuzzer.Walk, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    guard = FaultGuard(said.append)
    results = played(walk, GuardedTracker(RIG, Config(), guard), {4: monkeypatch})
    assert [result.state for result in results[:4]] == [TrackState.OK] * 4
    assert (results[4].state, results[4].T_odom_body) == (TrackState.LOST, None)
    assert results[-1].state is TrackState.OK
    assert not any(result.new_segment for result in results[1:])  # its places were kept: the same odom
    far = np.linalg.norm(results[-1].T_odom_body[:3, 3] - results[3].T_odom_body[:3, 3])
    assert far < 0.2
    assert guard.failure_count == 1
    assert len(said) == 1 and "LinAlgError" in said[0]


def test_one_that_fails_twice_begins_anew(walk: rig_fuzzer.Walk) -> None:
    guard = FaultGuard(lambda text: None)
    tracker = GuardedTracker(RIG, Config(), guard)

    class Broken:
        rejected_imu_samples = 7

        def track(self, frame: object) -> TrackResult:
            raise FloatingPointError

        def reset_after_failure(self, frame: object) -> None:
            raise ValueError

    tracker._tracker = Broken()  # type: ignore[assignment]
    tracker._had_pose = True
    results = [tracker.track(frame) for frame in walk.frames[:4]]
    assert [result.state for result in results[:1]] == [TrackState.LOST]
    assert results[-1].state is TrackState.OK and guard.failure_count == 2
    assert tracker.rejected_imu_samples == 7  # by the first


def test_what_a_lost_tracker_had_learnt_of_the_bias_is_not_lost(
    walk: rig_fuzzer.Walk, monkeypatch: pytest.MonkeyPatch
) -> None:
    learnt = ImuBias([0.01, 0.0, 0.0], [0.1, 0.2, 0.3], 1e-3, 1e-2)
    told = iter([None, learnt, None])
    monkeypatch.setattr(InertialTracker, "bias", property(lambda self: next(told)))
    tracker = GuardedTracker(RIG, Config(), FaultGuard(lambda text: None), learnt)
    assert tracker.bias is None  # what it was told is not what it has learnt
    tracker.track(walk.frames[0])
    monkeypatch.setattr(InertialTracker, "make_keyframe", lambda self, frame: None)
    biases = []
    for frame in walk.frames[:3]:
        tracker.finish(frame, True)
        biases.append(tracker.bias)
    assert biases == [None, learnt, learnt]


def test_one_of_cameras_alone_knows_no_bias(walk: rig_fuzzer.Walk) -> None:
    tracker = GuardedTracker(RIG.without_imu(), Config(), FaultGuard(lambda text: None))
    assert tracker.track(walk.frames[0]).keyframe_ready
    tracker.finish(walk.frames[0], True)
    assert tracker.bias is None


def test_a_keyframe_that_fails_is_none(walk: rig_fuzzer.Walk, monkeypatch: pytest.MonkeyPatch) -> None:
    guard = FaultGuard(lambda text: None)
    tracker = GuardedTracker(RIG, Config(), guard)
    assert tracker.track(walk.frames[0]).keyframe_ready
    monkeypatch.setattr("share.odometry.keyframes.ViewBuilder.finish", _no_gain)
    kept = tracker.attempt("a keyframe", walk.frames[0], lambda: tracker.make_keyframe(walk.frames[0]))
    assert kept is None and guard.failure_count == 1
    assert tracker.track(walk.frames[1]).state is TrackState.LOST


@pytest.mark.parametrize("rig", [RIG, RIG.without_imu()], ids=["imu", "cameras"])
def test_after_a_keyframe_that_failed_the_next_step_is_from_the_last_that_others_have(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("share.odometry.visual_tracker.KEYFRAME_M", 1e-4)
    config = Config(inertial=InertialConfig(keyframe_m=1e-4))
    tracker = GuardedTracker(rig, config, FaultGuard(lambda text: None))
    frames = iter(rig_fuzzer.walk(16).frames)
    frame = next(frames)
    assert tracker.track(frame).keyframe_ready
    first = tracker.make_keyframe(frame)
    while not tracker.track(frame := next(frames)).keyframe_ready:
        pass

    def fails_once_made() -> None:
        tracker.make_keyframe(frame)
        _no_gain()

    assert tracker.attempt("a keyframe", frame, fails_once_made) is None
    while not tracker.track(frame := next(frames)).keyframe_ready:
        pass
    again = tracker.make_keyframe(frame)
    step = se3.inverse(first.T_odom_body) @ again.T_odom_body
    assert not again.new_segment and np.linalg.norm(step[:3, 3]) > 1e-3
    np.testing.assert_allclose(again.T_previous_body, step, atol=1e-4)


def test_giving_up_leaves_nothing_of_a_keyframe_for_the_next_beginning(walk: rig_fuzzer.Walk) -> None:
    tracker, frame = InertialTracker(RIG, Config().inertial, Config().tracker), walk.frames[0]
    tracker.track(frame)
    tracker.make_keyframe(frame)
    tracker.reset_after_failure(frame)
    assert tracker._keyframes._offered is None


# ---------------------------------------------------------------- rigs that nobody has


def test_no_rig_ends_a_tracker(walk: rig_fuzzer.Walk) -> None:
    for what, rig in rig_fuzzer.rigs(25, seed=35):
        states = rig_fuzzer.play(rig, walk)
        assert states["refused"] or sum(n for k, n in states.items() if k.isupper()) == len(walk.frames), what


def test_the_rig_of_the_walk_is_tracked_without_a_failure(walk: rig_fuzzer.Walk) -> None:
    assert rig_fuzzer.play(RIG, walk) == {"OK": len(walk.frames)}


def test_the_fuzzer_makes_rigs_that_are_refused_for_many_reasons_and_such_that_are_not() -> None:
    told = [rig_check.rig_problem(rig) for _, rig in rig_fuzzer.rigs(200, seed=1)]
    count = sum(why is not None for why in told)
    assert 60 < count < 190
    assert len({str(why)[:25] for why in told}) > 10


@pytest.mark.slow
def test_many_rigs_over_two_seconds() -> None:
    walk = rig_fuzzer.walk(30)
    for n, (what, rig) in enumerate(rig_fuzzer.rigs(400, seed=3535)):
        began = time.process_time()
        rig_fuzzer.play(rig, walk)
        assert time.process_time() - began < 60, what
        if n == 50:
            held = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - held < 200_000  # kB
