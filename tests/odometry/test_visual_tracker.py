"""The tracker without IMU on a rendered room with exact truth, and under faults."""

import numpy as np
import pytest
from helpers.plain_walk import CAMERA, STEREO, pairs, poses

from share.config import TrackerConfig
from share.geometry import se3
from share.geometry.camera import Rig
from share.odometry import initialisation, relocalisation, visual_tracker
from share.odometry.visual_tracker import VisualTracker
from share.types import Frame, TrackState, WaitReason
from share.vision.depth import from_stereo
from share.vision.keyframe_images import decompress
from share.vision.orb import image_view

pytestmark = pytest.mark.long

HZ = 20
DEFAULT = TrackerConfig()


@pytest.fixture(scope="module")
def walk():
    """Three seconds of a person's stereo images, and the true poses of cam0."""
    T = poses("walker", np.arange(1, 4, 1 / HZ), 5)
    return pairs(T, 5), T


def stamp(i):
    return round(i * 1e9 / HZ)


def run(images, config=DEFAULT, stamps=None, rig=STEREO):
    tracker, results, candidates = VisualTracker(rig, config), [], []
    for i, (left, right) in enumerate(images):
        frame = Frame(stamps[i] if stamps else stamp(i), i, left, right)
        results.append(tracker.track(frame))
        if results[-1].keyframe_ready:
            candidates.append(tracker.make_keyframe(frame))
    return results, candidates


def test_tracks_every_frame_to_the_centimetre(walk):
    images, T = walk
    results, candidates = run(images)
    assert [r.state for r in results] == [TrackState.OK] * len(images)
    estimate = np.array([r.T_odom_body for r in results])
    truth = se3.inverse(T[0]) @ T
    relative = se3.inverse(estimate[0]) @ estimate
    assert np.linalg.norm(relative[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.03
    assert np.degrees(se3.rotation_angle(se3.inverse(relative) @ truth)).max() < 0.6
    assert 4 < len(candidates) < 40
    assert candidates[0].new_segment
    assert not any(c.new_segment for c in candidates[1:])


def test_a_keyframe_is_its_image_and_surfaces_that_face_the_camera(walk):
    images, _ = walk
    tracker, off = VisualTracker(STEREO, DEFAULT), []
    for i, (left, right) in enumerate(images[:40]):
        if not tracker.track(Frame(stamp(i), i, left, right)).keyframe_ready:
            continue
        candidate = tracker.make_keyframe(Frame(stamp(i), i, left, right))
        image = candidate.image
        assert len(candidate.view) == 0 and len(image.uv) > 60
        assert np.abs(decompress(image, CAMERA).astype(float) - left).mean() < 3
        assert (image.plane[:, :2] == 0).all()
        uv = image.uv.astype(np.float64)
        z = from_stereo(left, right, STEREO, CAMERA.distort(uv).astype(np.float32), uv, image.points[:, 2])
        off += ((1 / z - image.plane[:, 2]) / image.rho_sigma)[np.isfinite(z)].tolist()
    assert len(off) > 500
    assert np.median(np.abs(off)) < 1 and np.percentile(np.abs(off), 90) < 4


def test_orb_features_are_found_only_once_an_agent_is_lost(walk, monkeypatch):
    images, made = walk[0], []

    def counted(image, *rest):
        made.append(image)
        return image_view(image, *rest)

    monkeypatch.setattr(relocalisation, "image_view", counted)
    results, _ = run(images[:40])
    assert made == [] and results[-1].state is TrackState.OK
    dark = (np.zeros((480, 640), np.uint8),) * 2
    results, _ = run([*images[:40], *[dark] * 3, *images[43:46]])
    assert results[-1].state.has_pose
    assert 0 < len(made) == len({id(image) for image in made})  # of each keyframe once


def test_finishing_a_keyframe_may_wait_for_the_next_frame(walk):
    images, _ = walk
    tracker, poses = VisualTracker(STEREO, DEFAULT), []
    for i, (left, right) in enumerate(images[:30]):
        frame = Frame(stamp(i), i, left, right)
        result = tracker.track(frame)
        poses.append(result.T_odom_body)
        if result.keyframe_ready:
            tracker.make_keyframe(frame)
            tracker.finish_keyframe()
    for mine, result in zip(poses, run(images[:30])[0], strict=True):
        np.testing.assert_array_equal(mine, result.T_odom_body)


def test_odom_starts_at_the_origin_with_z_up(walk):
    results, _ = run(walk[0][:1])
    T = results[0].T_odom_body
    assert np.allclose(T[:3, 3], 0)
    assert np.allclose(T[:3, 1], (0, 0, -1))  # the camera's y, down
    assert np.allclose(T[:3, 2], (1, 0, 0))  # the camera's z, ahead


def test_same_frames_same_poses(walk):
    a, _ = run(walk[0][:30])
    b, _ = run(walk[0][:30])
    assert all((x.T_odom_body == y.T_odom_body).all() for x, y in zip(a, b, strict=True))


def test_lost_in_the_dark_and_relocalised(walk):
    images, T = walk
    dark = (np.zeros((480, 640), np.uint8),) * 2
    results, candidates = run([*images[:40], *[dark] * 10, *images[45:60]])
    assert [r.state for r in results[40:50]] == [TrackState.LOST] * 10
    assert all(r.T_odom_body is None for r in results[40:50])
    back = results[50:]
    assert all(r.state.has_pose for r in back)
    truth = se3.inverse(T[0]) @ T[45:60]
    found = np.array([se3.inverse(results[0].T_odom_body) @ r.T_odom_body for r in back])
    assert np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.04
    assert not any(c.new_segment for c in candidates[1:])


def test_the_map_survives_a_long_darkness(walk, monkeypatch):
    """Longer than it takes to begin anew, but there was nothing to begin with."""
    images, _ = walk
    dark = (np.zeros((480, 640), np.uint8),) * 2
    monkeypatch.setattr(relocalisation, "NEW_SEGMENT_S", 0.3)
    results, candidates = run([*images[:40], *[dark] * 20, *images[45:55]])
    assert [r.state for r in results[40:60]] == [TrackState.LOST] * 20
    assert all(r.state.has_pose for r in results[60:])
    assert not any(c.new_segment for c in candidates[1:])


def test_moved_while_blind_starts_a_new_segment(walk, monkeypatch):
    """To a room that is the mirror image of this one."""
    images, _ = walk
    other = [(right[:, ::-1].copy(), left[:, ::-1].copy()) for left, right in images[40:]]
    monkeypatch.setattr(relocalisation, "NEW_SEGMENT_S", 0.3)
    results, candidates = run([*images[:20], *other])
    states = [r.state for r in results]
    assert TrackState.LOST in states[20:30]
    assert states[-1].has_pose
    assert sum(c.new_segment for c in candidates) == 2


def test_a_pose_that_implies_too_high_a_speed_is_rejected(walk):
    """The same images a hundred times as fast: the geometry fits, the speed does not."""
    images, _ = walk
    stamps = [round(i * 1e9 / HZ / 100) for i in range(40)]
    results, _ = run(images[20:60], stamps=stamps)
    assert TrackState.LOST in [r.state for r in results]


def test_the_first_pose_waits_for_features(walk):
    dark = (np.zeros((480, 640), np.uint8),) * 2
    results, _ = run([dark, dark, *walk[0][:3]])
    assert [r.state for r in results] == [TrackState.INITIALISING] * 2 + [TrackState.OK] * 3
    assert [r.waiting_for for r in results] == [WaitReason.VIEW] * 2 + [None] * 3


def test_memory_is_bounded(walk, monkeypatch):
    monkeypatch.setattr(relocalisation, "MAX_KEYFRAMES", 5)
    monkeypatch.setattr(visual_tracker, "KEYFRAME_M", 0.02)
    monkeypatch.setattr(visual_tracker, "KEYFRAME_RAD", 0.02)
    tracker = VisualTracker(STEREO, DEFAULT)
    for i, (left, right) in enumerate(walk[0]):
        frame = Frame(stamp(i), i, left, right)
        if tracker.track(frame).keyframe_ready:
            tracker.make_keyframe(frame)
        local_map = tracker.local_map
        assert len(local_map.keyframes) <= 5
        assert len(local_map.ids) <= 5 * DEFAULT.corners
        assert set(local_map.anchors) <= set(local_map.keyframes)


def test_one_camera_alone_is_refused():
    with pytest.raises(ValueError, match="scale"):
        VisualTracker(Rig(CAMERA, np.eye(4)), TrackerConfig())


def test_align_to_gravity_ahead_and_down():
    T = initialisation.align_to_gravity(np.array([0, -1.0, 0]), np.array([0, 0, 1.0]))
    assert np.allclose(T[:3, :3] @ [0, -1, 0], (0, 0, 1))
    assert np.allclose(T[:3, :3] @ [0, 0, 1], (1, 0, 0))
    down = initialisation.align_to_gravity(np.array([0, 0, -1.0]), np.array([0, 0, 1.0]))
    assert np.allclose(down[:3, :3] @ [0, 0, -1], (0, 0, 1))
    assert np.linalg.det(down[:3, :3]) == pytest.approx(1)
