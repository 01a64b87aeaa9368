"""One camera and an IMU; and a stereo rig whose second camera fails for a while."""

import dataclasses

import numpy as np
import pytest
from test_inertial_tracker import error_m, run, some, states, walk  # noqa: F401

from share.types import ImuBatch, TrackState, WaitReason

pytestmark = pytest.mark.long

OK, STARTING = TrackState.OK, TrackState.INITIALISING


def one_eyed(frame):
    return dataclasses.replace(frame, image1=None)


def alone(walk):  # noqa: F811
    """The walk as a rig without the second camera shows it."""
    frames, rig, truth = walk
    return [one_eyed(f) for f in frames], dataclasses.replace(rig, cam1=None, T_cam1_cam0=None), truth


def waiting(frame, count):
    """The same picture again and again, and an IMU at rest."""
    rng, out = np.random.default_rng(1), []
    for k in range(count):
        stamp = frame.stamp_ns + k * 66_000_000
        stamps = stamp + np.arange(-13, 1) * 5_000_000
        force = np.array([0.0, 0.0, 9.81]) + rng.normal(0, 0.02, (14, 3))
        imu = ImuBatch(stamps, rng.normal(0, 0.002, (14, 3)), force)
        out.append(dataclasses.replace(frame, stamp_ns=stamp, image1=None, imu=imu))
    return out


def scale_of(frames, results, truth):
    """Length of the published path over that of the true one."""
    published = [
        (f.stamp_ns, r.T_odom_body) for f, r in zip(frames, results, strict=True) if r.T_odom_body is not None
    ]
    at = {int(t): T[:3, 3] for t, T in zip(truth.stamps_ns, truth.T, strict=True)}
    estimated = np.array([T[:3, 3] for _, T in published])
    true = np.array([at[t] for t, _ in published])
    return np.linalg.norm(estimated - estimated.mean(axis=0)) / np.linalg.norm(true - true.mean(axis=0))


def test_scale_from_the_imu(walk):  # noqa: F811
    """No pose is published before the scale is known."""
    mono = alone(walk)
    results, candidates, _ = run(mono, mono[0])
    ready = states(results).index(OK)
    print(ready, scale_of(mono[0], results, mono[2]), error_m(mono, mono[0], results))
    assert set(states(results)[:ready]) == {STARTING}
    assert all(r.T_odom_body is None for r in results[:ready])
    assert {r.waiting_for for r in results[1:ready]} == {WaitReason.SCALE}
    assert 10 <= ready < 40
    assert set(states(results)[ready:]) == {OK}
    assert scale_of(mono[0], results, mono[2]) == pytest.approx(1, abs=0.08)
    assert error_m(mono, mono[0], results) < 0.03
    assert candidates[0].new_segment
    assert np.isfinite(candidates[-1].points[:, 2]).sum() > 20


def test_no_pose_at_rest_because_there_is_no_scale(walk):  # noqa: F811
    mono = alone(walk)
    results, candidates, _ = run(mono, waiting(walk[0][0], 90))
    assert set(states(results)) == {STARTING}
    assert candidates == []


def test_no_pose_of_a_single_camera_without_imu_samples(walk):  # noqa: F811
    mono = alone(walk)
    without_imu = [dataclasses.replace(f, imu=ImuBatch.empty()) for f in mono[0][:30]]
    results, _, _ = run(mono, without_imu)
    assert set(states(results)) == {STARTING}


def test_a_second_camera_that_fails_for_a_while(walk):  # noqa: F811
    frames = some(walk[0], one_eyed, 12, 32)
    results, _, _ = run(walk, frames)
    assert states(results)[3:] == [OK] * (len(frames) - 3)
    assert min(r.inlier_count for r in results[12:]) >= 25
    assert error_m(walk, frames, results) < 0.015


def test_a_second_camera_that_starts_late(walk):  # noqa: F811
    frames = some(walk[0], one_eyed, 0, 8)
    results, _, _ = run(walk, frames)
    assert set(states(results)[:8]) == {STARTING}
    assert states(results)[12:] == [OK] * (len(frames) - 12)
    assert error_m(walk, frames, results) < 0.01


def blinded(frame):
    return dataclasses.replace(frame, image1=np.full_like(frame.image1, 255))


def test_a_second_camera_that_is_blinded_for_a_while(walk):  # noqa: F811
    """It still sends images, in which nothing is found."""
    frames = some(walk[0], blinded, 12, 32)
    results, _, _ = run(walk, frames)
    assert states(results)[3:] == [OK] * (len(frames) - 3)
    assert min(r.inlier_count for r in results[12:]) >= 25
    assert error_m(walk, frames, results) < 0.015
