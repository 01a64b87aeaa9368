"""The tracker with IMU on three seconds of an emulated D435i with exact truth, and under faults."""

import dataclasses
import itertools

import numpy as np
import pytest

from share.config import Config, InertialConfig
from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.geometry.interpolation import interpolate
from share.metrics.ate import ate
from share.odometry import filter, initialisation
from share.odometry.health import DivergenceMonitor
from share.odometry.inertial_tracker import InertialTracker
from share.protocol.agent_ledger import KeyframeChain
from share.recordings.trajectory import Trajectory
from share.runtime.pipeline import read_frames
from share.runtime.source import open_source
from share.sensors.measurement import IMU
from share.sensors.sequencer import SequencerCounters
from share.types import ImuBatch, TrackState, WaitReason
from share.vision.depth import from_stereo
from share.vision.keyframe_images import decompress

pytestmark = pytest.mark.long

OK, BLIND, WITHOUT_IMU, LOST = (
    TrackState.OK,
    TrackState.INERTIAL_ONLY,
    TrackState.VISION_ONLY,
    TrackState.LOST,
)
STARTING = TrackState.INITIALISING


@pytest.fixture(scope="module")
def walk(plain_session):
    """Frames, the rig, the truth."""
    source = open_source(f"{plain_session}/ar1")
    return list(read_frames(source, Config(), SequencerCounters())), source.rig, source.truth()


@pytest.fixture(scope="module")
def tracked(walk):
    """What becomes of all of them."""
    return run(walk, walk[0])


def run(walk, frames, config=None):
    tracker, results, candidates = (
        InertialTracker(walk[1], config or InertialConfig()),
        [],
        [],
    )
    for frame in frames:
        results.append(tracker.track(frame))
        if results[-1].keyframe_ready:
            candidates.append(tracker.make_keyframe(frame))
    return results, candidates, tracker


def error_m(walk, frames, results):
    published = [
        (f.stamp_ns, r.T_odom_body) for f, r in zip(frames, results, strict=True) if r.T_odom_body is not None
    ]
    stamps, poses = zip(*published, strict=True)
    return ate(Trajectory(np.array(stamps), np.array(poses)), walk[2]).rmse


def dark(frame):
    black = np.zeros_like(frame.image0)
    return dataclasses.replace(frame, image0=black, image1=black)


def mute(frame):
    return dataclasses.replace(frame, imu=ImuBatch.empty())


def some(frames, change, first, last):
    return [change(f) if first <= k < last else f for k, f in enumerate(frames)]


def states(results):
    return [r.state for r in results]


def test_every_frame_is_tracked_to_the_centimetre(walk, tracked):
    frames = walk[0]
    results, candidates, _ = tracked
    assert set(states(results)[:3]) <= {STARTING, OK}
    assert states(results)[3:] == [OK] * (len(frames) - 3)
    assert error_m(walk, frames, results) < 0.01
    assert candidates[0].new_segment
    assert not any(c.new_segment for c in candidates[1:])
    for r in results[3:]:
        assert np.linalg.eigvalsh(r.cov)[0] > 0


def test_the_up_direction(walk, tracked):
    """The body's, as keyframes publish it; the accelerometer of a D435i is off by up to 0.2 m/s^2."""
    _, _, truth = walk
    _, candidates, tracker = tracked
    last = tracker.state.stamp_ns
    up = truth.T[np.argmin(np.abs(truth.stamps_ns - last))][2, :3]
    assert np.degrees(np.arccos(tracker.state.T[2, :3] @ up)) < 1.5
    assert np.linalg.norm(candidates[-1].up) == pytest.approx(1)


def test_keyframes_carry_the_motion_by_the_present_state(walk):
    """The first keyframes come while the tilt is a degree off; its correction is no rotation, neither between
    them nor in the poses that are published."""
    frames, rig, truth = walk
    tracker, shown = InertialTracker(rig, InertialConfig()), []
    for frame in frames:
        if tracker.track(frame).keyframe_ready:
            shown.append((frame.stamp_ns, tracker.make_keyframe(frame)))
    stamps = np.array([stamp for stamp, _ in shown])
    _, true = interpolate(truth.stamps_ns, truth.T, stamps)
    true = se3.inverse(true[:-1]) @ true[1:]
    published = np.array([c.T_odom_body for _, c in shown])
    published = se3.inverse(published[:-1]) @ published[1:]
    steps = np.array([c.T_previous_body for _, c in shown[1:]])
    sigma = np.sqrt([np.trace(c.cov[:3, :3]) for _, c in shown[1:]])
    off, shown_off = (se3.rotation_angle(se3.inverse(T) @ true) for T in (steps, published))
    assert (off < 4 * sigma).all()
    assert np.sqrt((shown_off**2).mean()) < 1.5 * np.sqrt((off**2).mean())


def test_keyframes_carry_their_pose_relative_to_earlier_ones_by_the_present_state(walk):
    """Those published, as long as the state has them."""
    frames, rig, _ = walk
    tracker, published, known = InertialTracker(rig, InertialConfig()), {}, 0
    for frame in frames:
        if not tracker.track(frame).keyframe_ready:
            continue
        earlier, s = tracker.make_keyframe(frame).earlier, tracker.state
        ids = s.keyframe_ids.tolist()
        assert earlier.ids.tolist() == [stamp for stamp, id_ in published.items() if id_ in ids]
        newest = len(ids) - 1
        for k, stamp in enumerate(earlier.ids.tolist()):
            before = ids.index(published[stamp])
            T, cov = filter.relative_pose(s, before, newest), filter.relative_pose_cov(s, before, newest)
            np.testing.assert_allclose(earlier.T_earlier_body[k], T, atol=1e-6)
            np.testing.assert_allclose(earlier.cov[k], cov, rtol=1e-4, atol=1e-12)
        known += len(earlier) > 1
        published[frame.stamp_ns] = ids[newest]
    assert known >= 2


def test_the_tracker_tells_the_ledger_the_pose_relative_to_the_reference(tracked, walk):
    """By its stamps the ledger finds the keyframes that it has sent: every other one here."""
    frames, _, _ = walk
    results, candidates, _ = tracked
    stamps = [f.stamp_ns for f, r in zip(frames, results, strict=True) if r.keyframe_ready]
    chain, sent = KeyframeChain(), []
    for k, (stamp, candidate) in enumerate(zip(stamps, candidates, strict=True)):
        chain.extend(candidate)
        if k % 2 == 0:
            sent.append((stamp, candidate, chain.make_keyframe(candidate, stamp)))
    assert len(sent) >= 2
    for (before, *_), (_, candidate, keyframe) in itertools.pairwise(sent):
        row = candidate.earlier.ids.tolist().index(before)
        np.testing.assert_allclose(keyframe.T_ref_body, candidate.earlier.T_earlier_body[row], atol=1e-6)
        np.testing.assert_array_equal(keyframe.cov, candidate.earlier.cov[row].astype(float))


def test_after_a_loss_keyframes_are_relative_to_none_before_it(walk):
    frames, rig, _ = walk
    tracker, before = InertialTracker(rig, InertialConfig()), set()
    for frame in frames[: len(frames) // 2]:
        if tracker.track(frame).keyframe_ready:
            tracker.make_keyframe(frame)
            before.add(frame.stamp_ns)
    assert before
    tracker._declare_lost(frames[len(frames) // 2])
    later = []
    for frame in frames[len(frames) // 2 + 1 :]:
        if tracker.track(frame).keyframe_ready:
            later.append(tracker.make_keyframe(frame).earlier)
    assert len(later) >= 2
    assert not len(later[0]) and len(later[-1])
    assert not before & {stamp for earlier in later for stamp in earlier.ids.tolist()}


def anchoring_keyframes(tracker):
    """The keyframes that have features."""
    return set(tracker.state.keyframe_ids[tracker.state.anchor].tolist())


def test_keyframe_work_is_sliced_and_poses_do_not_depend_on_when_it_runs(walk, tracked):
    """A keyframe is published with its own frame; its features come a frame later. Whether anybody calls
    `finish_keyframe`, or the next frame does it."""
    frames, rig, _ = walk
    tracker, poses, shown = InertialTracker(rig, InertialConfig()), [], {}
    begun, hosts = {}, []  # when each keyframe came; which have features after each frame
    for k, frame in enumerate(frames):
        result = tracker.track(frame)
        poses.append(result.T_odom_body)
        if result.keyframe_ready:
            shown[k] = tracker.make_keyframe(frame)
            np.testing.assert_allclose(shown[k].T_odom_body, result.T_odom_body, atol=1e-8)
        for keyframe in tracker.state.keyframe_ids.tolist():
            begun.setdefault(keyframe, k)
        tracker.finish_keyframe()
        tracker.finish_keyframe()  # once a frame is enough
        hosts.append(anchoring_keyframes(tracker))
    later = {keyframe: k for keyframe, k in begun.items() if 0 < k < len(frames) - 2}
    for keyframe, k in later.items():
        assert [keyframe in at for at in hosts[k : k + 2]] == [False, True]
    assert len(later) >= 2 and set(shown) & set(later.values())
    results, candidates, _ = tracked
    for mine, result in zip(poses, results, strict=True):
        np.testing.assert_array_equal(mine, result.T_odom_body)
    for mine, candidate in zip(shown.values(), candidates, strict=True):
        for name in ("jpeg", "uv", "plane", "rho_sigma"):
            np.testing.assert_array_equal(getattr(mine.image, name), getattr(candidate.image, name))
        np.testing.assert_array_equal(mine.cov, candidate.cov)


@pytest.mark.parametrize("every", [2, 3])  # of 15 Hz
def test_at_low_frame_rates_a_keyframe_has_its_features_before_the_next_frame(walk, every):
    frames, rig, _ = walk
    tracker, published, samples = InertialTracker(rig, InertialConfig()), 0, ImuBatch.empty()
    for k, frame in enumerate(frames):
        samples = samples.concatenate(frame.imu)
        if k % every:
            continue
        rare, samples = dataclasses.replace(frame, index=k // every, imu=samples), ImuBatch.empty()
        if tracker.track(rare).keyframe_ready:
            tracker.make_keyframe(rare)
            newest = int(tracker.state.keyframe_ids[-1])
            tracker.finish_keyframe()
            assert newest in anchoring_keyframes(tracker)
            published += 1
    assert published >= 3


def test_a_keyframe_is_its_image_and_surfaces(walk, tracked):
    """The image of its own frame, compressed, and surfaces whose depth is that of the pair of images."""
    frames, rig, _ = walk
    tracker, off = InertialTracker(rig, InertialConfig()), []
    for frame in frames:
        if not tracker.track(frame).keyframe_ready:
            continue
        candidate = tracker.make_keyframe(frame)
        image = candidate.image
        assert len(candidate.view) == 0 and len(image.uv) > 20
        assert 0 < len(image.jpeg) < 30_000
        decoded = decompress(image, rig.cam0)
        assert np.abs(decoded.astype(float) - frame.image0).mean() < 3
        rho = 1 / image.points[:, 2]
        px = rig.cam0.distort(image.uv.astype(np.float64)).astype(np.float32)
        z = from_stereo(frame.image0, frame.image1, rig, px, image.uv.astype(np.float64), 1 / rho)
        off += ((1 / z - rho) / np.hypot(image.rho_sigma, 0.02))[np.isfinite(z)].tolist()
    assert len(off) > 100
    assert np.median(np.abs(off)) < 1 and np.percentile(np.abs(off), 90) < 3


class Late:
    """A source whose IMU has a clock of its own, as calibrated."""

    def __init__(self, source, shift_s):
        self.imu_range, self.reports_silence = source.imu_range, source.reports_silence
        self.rig, self.rate_hz = dataclasses.replace(source.rig, timeshift_s=shift_s), source.rate_hz
        self._source = source

    def measurements(self):
        shift = self.rig.timeshift_ns
        late = (
            dataclasses.replace(m, stamp_ns=m.stamp_ns + shift) if m.stream == IMU else m
            for m in self._source.measurements()
        )
        return iter(sorted(late, key=lambda m: m.stamp_ns))


@pytest.mark.parametrize("shift_s", [0.02, -0.02])
def test_a_calibrated_timeshift_does_not_change_the_error(walk, tracked, plain_session, shift_s):
    """Poses are of when the IMU's clock shows the stamp, so the truth is shifted too."""
    source = Late(open_source(f"{plain_session}/ar1"), shift_s)
    frames = list(read_frames(source, Config(), SequencerCounters()))
    truth = Trajectory(walk[2].stamps_ns + source.rig.timeshift_ns, walk[2].T)
    results, _, tracker = run((None, source.rig, truth), frames)
    assert tracker.state.timeshift_s == pytest.approx(shift_s, abs=1e-3)
    assert states(results)[3:] == [OK] * (len(frames) - 3)
    clean = error_m(walk, walk[0], tracked[0])
    assert error_m((None, None, truth), frames, results) < clean + 0.001
    deceived, _, _ = run((None, dataclasses.replace(source.rig, timeshift_s=0.0), truth), frames)
    assert error_m((None, None, truth), frames, deceived) > 2 * clean


def test_the_same_frames_give_the_same_bits(walk):
    a, b = (run(walk, walk[0][:25])[0] for _ in range(2))
    assert [x.cov is None for x in a] == [y.cov is None for y in b]
    for x, y in zip(a, b, strict=True):
        if x.cov is not None:
            assert (x.T_odom_body == y.T_odom_body).all()
            assert (x.cov == y.cov).all()


def test_the_imu_carries_the_pose_through_the_dark(walk):
    frames = some(walk[0], dark, 20, 35)
    results, _, _ = run(walk, frames)
    assert states(results)[20:35] == [BLIND] * 15
    assert states(results)[37:] == [OK] * 8
    assert error_m(walk, frames, results) < 0.03


def test_tracking_continues_when_the_imu_falls_silent(walk):
    frames = some(walk[0], mute, 8, 18)
    results, _, _ = run(walk, frames)
    assert states(results)[10:18] == [WITHOUT_IMU] * 8  # silent after a tenth of a second
    assert states(results)[20:] == [OK] * 25
    assert error_m(walk, frames, results) < 0.02


def test_divergence_is_reported_and_the_tracker_relocalises(walk):
    """The IMU is silent while the head turns by 2 rad/s, too much at 15 Hz. No pose is published for
    longer than a second."""
    frames = some(walk[0], mute, 18, 27)
    results, _, _ = run(walk, frames)
    assert set(states(results)[20:26]) == {WITHOUT_IMU}
    assert set(states(results)[-2:]) <= {OK, STARTING, LOST}


def test_tracking_starts_without_any_imu_sample(walk):
    frames = some(walk[0], mute, 0, 99)
    results, candidates, _ = run(walk, frames)
    assert states(results)[:9] == [STARTING] * 9
    assert {r.waiting_for for r in results[:9]} == {WaitReason.IMU}
    assert states(results)[10:] == [WITHOUT_IMU] * 35
    assert error_m(walk, frames, results) < 0.04
    assert all((c.up == 0).all() for c in candidates)


def test_lost_without_imu_and_features_and_relocalised(walk):
    frames = some(some(walk[0], mute, 3, 99), dark, 8, 18)
    results, candidates, _ = run(walk, frames)
    assert set(states(results)[9:18]) == {LOST}
    assert all(r.T_odom_body is None for r in results if r.state is LOST)
    assert all(r.state.has_pose for r in results[20:26])
    assert not any(c.new_segment for c in candidates[1:])


def test_dropped_frames(walk):
    kept, waiting = [], ImuBatch.empty()
    for k, frame in enumerate(walk[0]):
        waiting = waiting.concatenate(frame.imu)
        if k <= 5 or k % 4:
            kept.append(dataclasses.replace(frame, imu=waiting))
            waiting = ImuBatch.empty()
    results, _, _ = run(walk, kept)
    assert error_m(walk, kept, results) < 0.01


def test_the_first_pose_waits_for_features(walk):
    frames = some(walk[0][:15], dark, 0, 6)
    results, _, _ = run(walk, frames)
    assert states(results)[:6] == [STARTING] * 6
    assert {r.waiting_for for r in results[1:6]} == {WaitReason.VIEW}
    assert results[-1].state is OK
    assert results[-1].waiting_for is None


def test_memory_is_bounded(walk):
    config = InertialConfig(max_keyframes=4, keyframe_m=0.02, keyframe_rad=0.02)
    results, _, tracker = run(walk, walk[0], config)
    assert tracker.state.keyframe_ids[-1] >= 6
    assert len(tracker.state.keyframe_ids) <= 4 + 1  # one whose features are still to come
    assert tracker.state.size <= 22 + 6 * 5 + config.features
    assert results[-1].state is OK


def test_predicted_poses_between_frames(walk):
    """Two frames ahead, 133 ms: by the IMU to a few mm, without it as far as a head keeps its ways."""
    frames, _, truth = walk
    results, _, tracker = run(walk, frames[:40])
    to = frames[41].stamp_ns
    imu = frames[40].imu.concatenate(frames[41].imu)
    at = {int(t): T for t, T in zip(truth.stamps_ns, truth.T, strict=True)}
    true = se3.inverse(at[frames[39].stamp_ns]) @ at[to]
    before, state = results[-1].T_odom_body, tracker.state.T.copy()
    for samples, far_rad, far_m in ((imu, 0.003, 0.005), (None, 0.1, 0.03)):
        ahead = tracker.predict(to, samples)
        off = se3.log(se3.inverse(true) @ se3.inverse(before) @ ahead)
        assert np.linalg.norm(off[:3]) < far_rad
        assert np.linalg.norm(off[3:]) < far_m
    assert (state == tracker.state.T).all()
    assert InertialTracker(walk[1], InertialConfig()).predict(to) is None


def test_a_wrong_extrinsic_is_reported_and_can_be_estimated(walk, tracked, monkeypatch):
    """Turned by 5 degrees and shifted by 5 cm against its calibration."""
    frames, rig, truth = walk
    off = se3.exp(np.concatenate([np.radians(5) * np.array([0.6, 0.0, 0.8]), [0.03, -0.04, 0.0]]))
    wrong = dataclasses.replace(rig, T_body_cam0=rig.T_body_cam0 @ off)
    fixed, _, _ = run((frames, wrong, truth), frames)
    monkeypatch.setattr(initialisation, "EXTRINSIC_SIGMA_RAD", 0.05)
    monkeypatch.setattr(initialisation, "EXTRINSIC_SIGMA_M", 0.03)
    _, _, tracker = run((frames, wrong, truth), frames)
    assert all(r.is_consistent for r in tracked[0])
    assert not any(r.is_consistent for r in fixed[-5:])
    left = se3.log(se3.inverse(rig.T_body_cam0) @ tracker.state.T_body_cam)
    assert np.degrees(np.linalg.norm(left[:3])) < 1.5


def test_a_rig_without_imu_is_refused():
    camera = Camera(640, 480, 385.0, 385.0, 319.5, 239.5)
    stereo = Rig(camera, np.eye(4), cam1=camera, T_cam1_cam0=se3.from_rt(np.eye(3), np.array([-0.05, 0, 0])))
    with pytest.raises(ValueError, match="IMU"):
        InertialTracker(stereo, InertialConfig())


def test_a_recording_whose_clock_begins_at_zero(walk):
    frames, rig, _ = walk
    first_ns = frames[0].stamp_ns
    first, second = (
        dataclasses.replace(
            frame,
            stamp_ns=frame.stamp_ns - first_ns,
            imu=dataclasses.replace(frame.imu, stamps_ns=frame.imu.stamps_ns - first_ns),
        )
        for frame in frames[:2]
    )
    tracker = InertialTracker(rig, InertialConfig())
    tracker.track(first)
    assert tracker.track(second).state is not TrackState.LOST
    assert tracker.state is not None


def test_keyframes_tell_the_monitor_their_drift_and_features(walk, monkeypatch):
    added = []
    monkeypatch.setattr(DivergenceMonitor, "add_keyframe", lambda self, *arguments: added.append(arguments))
    _, candidates, _ = run(walk, walk[0])
    assert len(added) >= len(candidates) > 1
    assert all(0 < drift_m < 0.01 and count >= 6 for drift_m, count in added[1:])
    assert added[0][1] >= 25


def test_a_lost_tracker_is_found_by_images_alone_where_the_imu_is_silent(walk):
    """It does not wait for samples, nor begin with those of a while ago."""
    frames = some(some(walk[0], mute, 8, 99), dark, 12, 20)
    results, candidates, _ = run(walk, frames)
    assert set(states(results)[13:20]) == {LOST}
    assert set(states(results)[21:26]) == {WITHOUT_IMU}
    assert not any(c.new_segment for c in candidates[1:])
