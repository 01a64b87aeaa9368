"""No rig and no failure within a tracker ends its process; a failed step costs that step."""

from __future__ import annotations

import resource
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers import rig_fuzzer
from helpers.plain_walk import RIG
from helpers.recordings import make_euroc

from share.config import Config, InertialConfig
from share.errors import UsageError
from share.geometry import rig_check, se3
from share.geometry.camera import ImuBias, Rig
from share.metrics.frame_log import RunLog
from share.odometry import filter
from share.odometry.inertial_tracker import InertialTracker
from share.odometry.track_result import TrackResult
from share.protocol import agent_events as ev
from share.runtime import fault_guard, guarded_tracker, offline_tracking
from share.runtime.error_estimators import NoErrorEstimate
from share.runtime.fault_guard import FaultGuard
from share.runtime.frame_consumers import LocalTracking
from share.runtime.guarded_tracker import GuardedTracker
from share.runtime.imu_bias_store import ImuBiasStore
from share.runtime.source import open_source
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
            tracker.attempt("a keyframe", frame, lambda frame=frame: rig_fuzzer.make_keyframe(tracker, frame))
    return results


def _no_gain(*anything: object, **more: object) -> None:
    raise np.linalg.LinAlgError("innovation covariance is not positive definite")


@pytest.mark.long
def test_a_failed_update_costs_its_frame_and_odometry_relocalises(
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


def test_a_tracker_that_fails_twice_is_replaced(
    walk: rig_fuzzer.Walk, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Broken:
        """Has one pose, then fails, and cannot be reset."""

        rejected_imu_samples = 7

        def __init__(self) -> None:
            self.poses = [np.eye(4)]

        def track(self, frame: object) -> TrackResult:
            return TrackResult(TrackState.OK, self.poses.pop())

        def reset_after_failure(self, frame: object) -> None:
            raise ValueError

    made = [lambda *arguments: Broken(), guarded_tracker.make_tracker]
    monkeypatch.setattr(guarded_tracker, "make_tracker", lambda *arguments: made.pop(0)(*arguments))
    guard = FaultGuard(lambda text: None)
    tracker = GuardedTracker(RIG, Config(), guard)
    results = [tracker.track(frame) for frame in walk.frames[:5]]
    assert [result.state for result in results[:2]] == [TrackState.OK, TrackState.LOST]
    assert results[-1].state is TrackState.OK and guard.failure_count == 2
    assert tracker.rejected_imu_samples == 7  # by the first


def test_the_bias_outlives_a_replaced_tracker(walk: rig_fuzzer.Walk, monkeypatch: pytest.MonkeyPatch) -> None:
    learnt = ImuBias([0.01, 0.0, 0.0], [0.1, 0.2, 0.3], 1e-3, 1e-2)
    reported = iter([None, learnt, None])
    monkeypatch.setattr(InertialTracker, "bias", property(lambda self: next(reported)))
    tracker = GuardedTracker(RIG, Config(), FaultGuard(lambda text: None), learnt)
    assert tracker.bias is None  # a given bias is not an estimated one
    tracker.track(walk.frames[0])
    monkeypatch.setattr(InertialTracker, "make_keyframe", lambda self, frame: None)
    biases = []
    for frame in walk.frames[:3]:
        tracker.finish(frame, True)
        biases.append(tracker.bias)
    assert biases == [None, learnt, learnt]


def test_a_dropped_bias_stays_dropped_in_a_replaced_tracker(
    walk: rig_fuzzer.Walk, monkeypatch: pytest.MonkeyPatch
) -> None:
    known, given = ImuBias([0.01, 0.0, 0.0], [0.1, 0.2, 0.3], 1e-3, 1e-2), []
    make = guarded_tracker.make_tracker

    def recorded(rig: Rig, config: Config, bias: ImuBias | None) -> object:
        given.append(bias)
        return make(rig, config, bias)

    monkeypatch.setattr(guarded_tracker, "make_tracker", recorded)
    tracker = GuardedTracker(RIG, Config(), FaultGuard(lambda text: None), known)
    for dropped in (False, True, False):  # by the tracker that is replaced
        monkeypatch.setattr(tracker._tracker, "has_dropped_bias", dropped)
        tracker.attempt("a step before the first pose", walk.frames[0], _no_gain)
    assert given == [known, known, None, None]
    assert tracker.has_dropped_bias


@pytest.mark.parametrize("dropped", [False, True])
def test_a_bias_that_the_tracker_drops_is_told_to_its_store(
    walk: rig_fuzzer.Walk, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, dropped: bool
) -> None:
    """By `share track` and by agents."""
    told: list[bool] = []
    monkeypatch.setattr(GuardedTracker, "has_dropped_bias", property(lambda self: dropped))
    monkeypatch.setattr(ImuBiasStore, "note_dropped", lambda self: told.append(True))
    recording = open_source(str(make_euroc(tmp_path / "recording")))
    offline_tracking.track(recording, Config(), lambda result: None)
    assert any(told) == dropped
    told.clear()
    guard = FaultGuard(lambda text: None)
    local = LocalTracking(recording, Config(), guard, NoErrorEstimate(), RunLog(), lambda text: None)
    local.consume(walk.frames[0], 0, lambda event: None)
    assert any(told) == dropped


def test_a_visual_tracker_has_no_bias(walk: rig_fuzzer.Walk) -> None:
    tracker = GuardedTracker(RIG.without_imu(), Config(), FaultGuard(lambda text: None))
    assert tracker.track(walk.frames[0]).keyframe_ready
    tracker.finish(walk.frames[0], True)
    assert tracker.bias is None


def test_a_failed_keyframe_is_none(walk: rig_fuzzer.Walk, monkeypatch: pytest.MonkeyPatch) -> None:
    guard = FaultGuard(lambda text: None)
    tracker = GuardedTracker(RIG, Config(), guard)
    assert tracker.track(walk.frames[0]).keyframe_ready
    monkeypatch.setattr("share.odometry.landmarks.LandmarkMap.surfaces", _no_gain)
    kept = tracker.attempt("a keyframe", walk.frames[0], lambda: tracker.make_keyframe(walk.frames[0]))
    assert kept is None and guard.failure_count == 1
    assert tracker.track(walk.frames[1]).state is TrackState.LOST


@pytest.mark.parametrize("rig", [RIG, RIG.without_imu()], ids=["imu", "cameras"])
def test_after_a_failed_keyframe_the_next_motion_starts_at_the_last_published_one(
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
    np.testing.assert_allclose(again.T_previous_body[:3, 3], step[:3, 3], atol=1e-5)
    assert se3.rotation_angle(se3.inverse(step) @ again.T_previous_body) < 2e-3  # the tilt was learnt anew


def test_a_reset_discards_the_unfinished_keyframe(walk: rig_fuzzer.Walk) -> None:
    tracker, frame = InertialTracker(RIG, Config().inertial), walk.frames[0]
    tracker.track(frame)
    tracker.make_keyframe(frame)
    tracker.reset_after_failure(frame)
    assert tracker._keyframes._offered is None


# ---------------------------------------------------------------- rigs that nobody has


def test_no_rig_ends_a_tracker(walk: rig_fuzzer.Walk) -> None:
    for what, rig in rig_fuzzer.rigs(25, seed=35):
        states = rig_fuzzer.play(rig, walk)
        assert states["refused"] or sum(n for k, n in states.items() if k.isupper()) == len(walk.frames), what


def test_the_unchanged_rig_is_tracked_without_a_failure(walk: rig_fuzzer.Walk) -> None:
    assert rig_fuzzer.play(RIG, walk) == {"OK": len(walk.frames)}


def test_the_fuzzer_makes_accepted_and_refused_rigs() -> None:
    reported = [rig_check.rig_problem(rig) for _, rig in rig_fuzzer.rigs(200, seed=1)]
    count = sum(why is not None for why in reported)
    assert 60 < count < 190
    assert len({str(why)[:25] for why in reported}) > 10


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


def test_a_failure_is_counted_and_reported_once_with_its_place() -> None:
    said: list[str] = []
    guard = FaultGuard(said.append)
    for _ in range(3):
        with guard.step("handling Received"):
            raise ZeroDivisionError("by \x1b zero")
    assert guard.failure_count == 3
    [line] = said
    assert line.startswith("handling Received: ZeroDivisionError at test_guarded_tracker.py:")
    assert line.endswith("by ? zero; this step is skipped and the run goes on")


def test_a_share_error_passes() -> None:
    guard = FaultGuard(lambda text: None)
    with pytest.raises(UsageError), guard.step("handling Received"):
        raise UsageError("the name is taken")
    assert guard.failure_count == 0


def test_reported_failures_are_bounded() -> None:
    said: list[str] = []
    guard = FaultGuard(said.append)
    for k in range(100):
        with guard.step(f"step {k}"):
            raise ValueError
    assert (guard.failure_count, len(said)) == (100, 20)


def test_two_threads_do_not_limit_lines_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """An agent's tracker and its main thread share the guard."""
    inside, overlaps = threading.Lock(), []

    class Limiter:
        def admit_new(self, text: str, now_ns: int, kind: str) -> None:
            overlaps.append(not inside.acquire(blocking=False))
            time.sleep(0.05)
            if not overlaps[-1]:
                inside.release()

    monkeypatch.setattr(fault_guard, "LineLimiter", Limiter)
    guard = FaultGuard(lambda text: None)
    threads = [threading.Thread(target=guard.record, args=("a step", failure())) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (guard.failure_count, overlaps) == (2, [False, False])


def failure() -> Exception:
    try:
        raise ValueError("by chance")
    except ValueError as error:
        return error


# ---------------------------------------------------------------- frames that come too late


@pytest.mark.long
def test_a_frame_that_is_left_out_has_the_pose_that_the_imu_predicts() -> None:
    frames = list(rig_fuzzer.walk(24).frames)
    tracker = GuardedTracker(RIG, Config(), FaultGuard(print))
    assert tracker.predict(frames[0]) is None  # no pose yet
    last = [tracker.track(frame).T_odom_body for frame in frames[:19]][-1]
    late = replace(frames[22], imu=frames[19].imu.concatenate(*(one.imu for one in frames[20:23])))
    predicted, tracked = tracker.predict(late), tracker.track(late).T_odom_body
    assert last is not None and predicted is not None and tracked is not None
    error, moved = se3.inverse(tracked) @ predicted, se3.inverse(tracked) @ last
    assert np.linalg.norm(moved[:3, 3]) > 0.03  # in four frames
    assert np.linalg.norm(error[:3, 3]) < 0.2 * np.linalg.norm(moved[:3, 3])


@pytest.mark.long
def test_a_predicted_pose_counts_as_late_as_it_is(walk: rig_fuzzer.Walk) -> None:
    source: Any = SimpleNamespace(rig=RIG, serial=None, name="walk")
    posted: list[ev.AgentEvent] = []
    tracking = LocalTracking(source, Config(), FaultGuard(print), NoErrorEstimate(), RunLog(), print)
    late_ns = time.monotonic_ns() - 150_000_000
    tracking.predict(walk.frames[0], late_ns, posted.append)
    for frame in walk.frames[:5]:
        tracking.consume(frame, time.monotonic_ns(), posted.append)
    tracking.predict(walk.frames[5], late_ns, posted.append)
    frames = [event for event in posted if isinstance(event, ev.FrameTracked)]
    assert (frames[0].state, frames[0].T_odom_body) == (TrackState.INITIALISING, None)
    assert frames[-1].state is TrackState.OK and frames[-1].T_odom_body is not None
    assert all(one.track_ms >= 150 and not one.is_keyframe for one in (frames[0], frames[-1]))


def test_a_guard_that_cannot_tell_what_failed_goes_on():
    def tell(text):
        raise RuntimeError("can't start new thread")

    guard = FaultGuard(tell)
    for _ in range(2):
        with guard.step("a message"):
            raise KeyError("lost")
    assert guard.failure_count == 2
    assert "KeyError" in guard.trouble
