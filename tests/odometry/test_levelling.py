"""A state that began without IMU learns which way is up when samples come, and its poses go on."""

import dataclasses

import numpy as np
import pytest
from helpers.imu_world import GRAVITY, rig

from share.config import Config, InertialConfig
from share.geometry import se3
from share.metrics.ate import ate
from share.odometry import filter, initialisation
from share.odometry.inertial_tracker import InertialTracker
from share.odometry.initialisation import state_from_camera, tilt_sigma, unknown_bias
from share.odometry.levelling import level
from share.odometry.state import add_features, add_keyframe, move
from share.recordings.trajectory import Trajectory
from share.runtime.pipeline import read_frames
from share.runtime.source import open_source
from share.sensors.sequencer import SequencerCounters
from share.types import ImuBatch, TrackState

CONFIG = InertialConfig()


def begun(tilt):
    """A state that has gone a little way from where it began, with two keyframes and some features; and
    samples of a body at rest that is tilted by `tilt` (3,) rad against what the camera says."""
    s = state_from_camera(0, rig(), unknown_bias(CONFIG))
    for k in range(2):
        add_keyframe(s, k, np.zeros(3))
        add_features(s, np.arange(5) + 5 * k, np.full(5, k), np.zeros((5, 2)), np.ones(5), np.full(5, 0.1))
        s.T = se3.exp(np.array([0.02, -0.03, 0.4, 0.5, -0.2, 0.1])) @ s.T
    s.v = np.array([0.1, 0.2, -0.3])
    s.stamp_ns = 500_000_000
    stamps = s.stamp_ns + np.arange(-20, 1) * 5_000_000
    force = s.T[:3, :3].T @ se3.so3_exp(tilt).T @ np.array([0.0, 0.0, GRAVITY])
    return s, ImuBatch(stamps, np.zeros((21, 3)), np.tile(force, (21, 1)))


@pytest.mark.parametrize("tilt", [(0.3, -0.2, 0.0), (0.0, 1.2, 0.0), (np.pi, 0.0, 0.0), (0.0, 0.0, 0.0)])
def test_all_that_was_estimated_turns_together(tilt):
    s, imu = begun(np.array(tilt))
    before, v = [s.T, *s.keyframe_poses], s.T[:3, :3].T @ s.v
    relative = filter.relative_pose_cov(s, 0, 1)
    T_new_old = level(s, imu, unknown_bias(CONFIG), GRAVITY)
    up = s.T[:3, :3] @ imu.accel[0] / GRAVITY
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose([s.T, *s.keyframe_poses], T_new_old @ before, atol=1e-6)
    np.testing.assert_allclose(s.T[:3, :3].T @ s.v, v, atol=1e-6)
    assert np.degrees(tilt_sigma(s)) > 5
    assert np.linalg.eigvalsh(s.cov)[0] > -1e-12
    np.testing.assert_allclose(filter.relative_pose_cov(s, 0, 1), relative, atol=1e-8)


@pytest.mark.parametrize("fault", ["few", "old", "gap", "weightless"])
def test_nothing_changes_while_samples_do_not_show_up(fault):
    s, imu = begun(np.array([0.3, 0.0, 0.0]))
    if fault == "few":
        imu = imu.take(slice(-5, None))
    elif fault == "old":
        s.stamp_ns += 200_000_000
    elif fault == "gap":
        imu = imu.take(slice(-15, None))
        imu = dataclasses.replace(imu, stamps_ns=imu.stamps_ns - np.where(np.arange(15) < 10, 10**9, 0))
    else:
        imu = dataclasses.replace(imu, accel=0.01 * imu.accel)
    before, cov = s.T.copy(), s.cov.copy()
    assert level(s, imu, unknown_bias(CONFIG), GRAVITY) is None
    assert (before == s.T).all() and (s.cov == cov).all()


@pytest.fixture(scope="module")
def walk(plain_session):
    """Frames, whose IMU is dead in the first twelve, rig and truth."""
    source = open_source(f"{plain_session}/ar1")
    frames = read_frames(source, Config(), SequencerCounters())
    mute = [dataclasses.replace(f, imu=ImuBatch.empty()) if k < 12 else f for k, f in enumerate(frames)]
    return mute, source.rig, source.truth()


def take_for_up(monkeypatch, turn):
    """The camera takes for up what is turned by `turn` (3,) rad, as with a pitched head."""

    def state_of_pitched_camera(*arguments):
        state = state_from_camera(*arguments)
        move(state, se3.exp(np.r_[turn, np.zeros(3)]) @ state.T)
        return state

    monkeypatch.setattr(initialisation, "state_from_camera", state_of_pitched_camera)


def error_m(frames, results, truth):
    at, poses = zip(
        *((f.stamp_ns, r.T_odom_body) for f, r in zip(frames, results, strict=True) if r.state.has_pose),
        strict=True,
    )
    return ate(Trajectory(np.array(at), np.array(poses)), truth).rmse


@pytest.mark.long
@pytest.mark.parametrize("pitch_deg", [8.0, 30.0])
def test_an_imu_that_comes_alive_late_does_not_ruin_the_poses(walk, pitch_deg, monkeypatch):
    """Of a head so much more pitched than this one, the camera would take that direction for up."""
    frames, rig, truth = walk
    take_for_up(monkeypatch, np.radians([0.6 * pitch_deg, 0.8 * pitch_deg, 0.0]))
    tracker, results, keyframes = InertialTracker(rig, CONFIG), [], []
    for frame in frames:
        results.append(tracker.track(frame))
        if results[-1].keyframe_ready:
            keyframes.append(tracker.make_keyframe(frame))
    states = [r.state for r in results]
    assert states[10:12] == [TrackState.VISION_ONLY] * 2
    assert states[13:] == [TrackState.OK] * len(frames[13:])
    assert error_m(frames, results, truth) < 0.01
    true_up = truth.T[np.argmin(np.abs(truth.stamps_ns - tracker.state.stamp_ns))][2, :3]
    assert np.degrees(np.arccos(tracker.state.T[2, :3] @ true_up)) < 2
    assert not keyframes[0].up.any() and keyframes[-1].up @ true_up > 0.99
    assert not any(k.new_segment for k in keyframes[1:])


@pytest.mark.long
def test_a_state_that_relocalises_where_up_is_unknown_is_levelled_too(walk, monkeypatch):
    """The IMU comes alive during the loss; the map's odom is still the camera's."""
    frames, rig, truth = walk
    take_for_up(monkeypatch, np.radians([0.0, 20.0, 0.0]))
    tracker, results = InertialTracker(rig, CONFIG), []
    for k, frame in enumerate(frames):
        results.append(tracker.track(frame))
        if results[-1].keyframe_ready:
            tracker.make_keyframe(frame)
        tracker.finish_keyframe()
        if k == 11:
            tracker._declare_lost(frame)
    assert all(r.state.has_pose for r in results[14:])
    assert not any(r.new_segment for r in results[11:])
    assert error_m(frames, results, truth) < 0.02
