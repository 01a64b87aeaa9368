"""The library's tracker: the same poses as `share track`, and one's own camera sample by sample."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers.recordings import make_euroc

from share import Agent, Edge, Frame, ShareError, Tracker, load_calibration, open_recording
from share.geometry.se3 import exp, inverse, log
from share.recordings.trajectory import read_tum


@pytest.fixture(scope="module")
def tracked(plain_session):
    """A headset's recording and its poses."""
    recording = open_recording(plain_session / "ar1")
    tracker = Tracker(recording.rig)
    return recording, [pose for frame in recording if (pose := tracker.track(frame))]


@pytest.mark.long
def test_poses_are_those_of_share_track(tracked, share, plain_session, tmp_path):
    _, poses = tracked
    assert share("track", plain_session / "ar1", "--out", tmp_path / "t.tum").code == 0
    written = read_tum(tmp_path / "t.tum")
    assert [pose.stamp_ns for pose in poses] == written.stamps_ns.tolist()
    assert np.allclose([pose.T_odom_body for pose in poses], written.T, atol=2e-9)


@pytest.mark.long
def test_velocity_is_the_derivative_of_the_pose(tracked):
    """By central differences over 2 frames: 133 ms of a walk."""
    _, poses = tracked
    for before, pose, after in zip(poses[15:], poses[16:], poses[17:], strict=False):
        dt = (after.stamp_ns - before.stamp_ns) * 1e-9
        assert np.allclose(pose.velocity, (after.position - before.position) / dt, atol=0.12)
        turned = log(inverse(before.T_odom_body) @ after.T_odom_body)[:3] / dt
        assert np.allclose(pose.angular_velocity, turned, atol=0.15)
    speeds = [np.linalg.norm(pose.velocity) for pose in poses[15:]]
    assert max(speeds) > 0.3  # or the comparison says little


@pytest.mark.long
def test_velocity_without_an_imu_is_the_mean_since_the_last_frame(plain_session):
    """The body is cam0, turned here, so that its axes are not the camera's."""
    recording = open_recording(plain_session / "ar1")
    mount = exp(np.array([0.3, -0.2, 0.5, 0.1, 0.0, -0.05]))
    tracker = Tracker(replace(recording.rig.without_imu(), T_body_cam0=mount))
    poses = [pose for frame in recording if (pose := tracker.track(frame))]
    assert poses[0].velocity is None and len(poses) > 30
    errors = []
    for before, pose in pairwise(poses):
        dt = (pose.stamp_ns - before.stamp_ns) * 1e-9
        moved = log(inverse(before.T_odom_body) @ pose.T_odom_body) / dt
        velocity = pose.T_odom_body[:3, :3].T @ pose.velocity
        errors.append(np.abs(np.concatenate([pose.angular_velocity, velocity]) - moved).max())
    assert np.median(errors) < 1e-6  # where a keyframe does not refine the pose after that
    assert max(errors) < 0.1


@pytest.mark.long
def test_covariances_are_positive_definite(tracked):
    for pose in tracked[1]:
        assert np.linalg.eigvalsh(pose.cov).min() > 0
        assert pose.map_cov is None and pose.T_map_body is None and pose.map_id is None


@pytest.mark.long
@pytest.mark.parametrize("name", ["ar1", "robot"])
def test_samples_fed_one_by_one_give_the_same_poses(plain_session, name):
    """As a program's own camera delivers them: in any order between streams; its buffers are used again."""
    recording = open_recording(plain_session / name, frames=slice(0, 20))
    whole = Tracker(recording.rig)
    expected = [pose for frame in recording if (pose := whole.track(frame))]
    fed = Tracker(recording.rig)
    poses = []
    for frame in recording:
        for stamp, gyro, accel in zip(frame.imu.stamps_ns, frame.imu.gyro, frame.imu.accel, strict=True):
            poses += fed.feed_imu(int(stamp), gyro.tolist(), accel.tolist())
        images = [None if one is None else one.copy() for one in (frame.image0, frame.image1, frame.depth)]
        poses += fed.feed_images(frame.stamp_ns, *images)
        for image in images:
            if image is not None:
                image[:] = 0
    poses += fed.finish()
    assert [pose.stamp_ns for pose in poses] == [pose.stamp_ns for pose in expected]
    assert len(poses) >= 15
    for mine, theirs in zip(poses, expected, strict=True):
        assert np.array_equal(mine.T_odom_body, theirs.T_odom_body)


def test_a_recording_can_be_read_again(tmp_path):
    recording = open_recording(make_euroc(tmp_path), frames=slice(1, 4))
    first, again = list(recording), list(recording)
    assert len(first) == len(again) == len(recording) == 3
    assert recording.rig.kind == "stereo+imu" and recording.rate_hz == 20.0
    assert all(np.array_equal(a.image0, b.image0) for a, b in zip(first, again, strict=True))
    assert recording.truth().T.shape == (6, 4, 4)


def test_a_calibration_is_a_rig():
    rig = load_calibration("calib/d435i")
    assert rig.kind == "stereo+imu" and rig.baseline == pytest.approx(0.05)


def rig():
    return load_calibration("calib/d435i")


GRAY = np.zeros((480, 848), np.uint8)


@pytest.mark.parametrize(
    ("images", "what"),
    [
        ((np.zeros((480, 848, 3), np.uint8), GRAY), r"image0: is 480x848x3 uint8, expected 480x848 uint8"),
        ((GRAY.astype(np.float32), GRAY), "image0: is 480x848 float32, expected 480x848 uint8"),
        ((GRAY[:100], GRAY), "image0: is 100x848 uint8"),
        ((GRAY, None), "image1: is missing; the rig has cam0, cam1"),
        ((GRAY, GRAY, GRAY.astype(np.float32)), "depth: the rig has no depth"),
        (([[0]], GRAY), "image0: is a list, expected a numpy array"),
    ],
)
def test_images_that_do_not_fit_the_rig_are_refused(images, what):
    with pytest.raises(ShareError, match=what):
        Tracker(rig()).feed_images(1, *images)
    image0, image1, depth = (*images, None, None)[:3]
    with pytest.raises(ShareError, match=what):
        Tracker(rig()).track(Frame(1, 0, image0, image1, depth))


def test_samples_that_are_none_are_refused():
    tracker = Tracker(rig())
    with pytest.raises(ShareError, match=r"gyro: has shape \(2,\), expected three numbers"):
        tracker.feed_imu(1, [0, 0], [0, 0, 9.81])
    with pytest.raises(ShareError, match=r"stamp_ns: 1\.5 is not an integer; give nanoseconds"):
        tracker.feed_imu(1.5, [0, 0, 0], [0, 0, 9.81])
    with pytest.raises(ShareError, match="stamp_ns: -1 is out of range"):
        tracker.feed_images(-1, GRAY, GRAY)
    with pytest.raises(ShareError, match="the rig has no IMU"):
        Tracker(rig().without_imu()).feed_imu(1, [0, 0, 0], [0, 0, 9.81])


def repr_of(value):
    """An id of a parameter: pytest cannot write a number of 5000 digits."""
    return type(value).__name__


@pytest.mark.parametrize(
    "value",
    ["abc", ["a", "b", "c"], ["1", "2", "3"], [[1], [2, 3], 4], [1j, 0, 0], [object()] * 3, None, {1, 2, 3},
     [10**400, 0, 0], [10**5000, 0, 0], [True] * 3, {"x": 1}],
    ids=repr_of,
)  # fmt: skip
def test_numbers_that_are_none_are_refused_in_one_line(value):
    for name, samples in (("gyro", (value, [0, 0, 9.81])), ("accel", ([0, 0, 0], value))):
        with pytest.raises(ShareError, match=rf"^{name}: .*expected three") as caught:
            Tracker(rig()).feed_imu(1, *samples)
        assert len(str(caught.value)) < 200 and "\n" not in str(caught.value)


@pytest.mark.parametrize("stamp", [10**400, 10**5000, "1", None, np.array([5]), 1e9], ids=repr_of)
def test_stamps_that_are_none_are_refused(stamp):
    with pytest.raises(ShareError, match=r"^stamp_ns: .{,80}give nanoseconds"):
        Tracker(rig()).feed_imu(stamp, [0, 0, 0], [0, 0, 9.81])


@pytest.mark.parametrize(
    "rate",
    [float("nan"), float("inf"), -1, 1e-300, 1e300, 10**400, 10**5000, "30", None, [30], 30j, True],
    ids=repr_of,
)
def test_rates_that_no_camera_has_are_refused(rate):
    for make in (lambda: Tracker(rig(), rate_hz=rate), lambda: Agent(rig(), "ann", EDGE, rate_hz=rate)):
        with pytest.raises(ShareError, match=r"^rate_hz: .* is outside 0\.1 \.\. 1000 Hz"):
            make()


def test_rates_of_numpy_and_an_unknown_one_are_accepted():
    for rate in (0, 0.0, np.float32(0), np.float32(30), np.int64(30), 30):
        Tracker(rig(), rate_hz=rate)


EDGE = "tcp://127.0.0.1:5999"
WRONG = {
    "a rig": lambda: Tracker(None),
    "settings": lambda: Tracker(rig(), config={"a": 1}),
    "a frame": lambda: Tracker(rig()).track(GRAY),
    "its samples": lambda: Tracker(rig()).track(Frame(1, 0, GRAY, GRAY, imu=None)),
    "a path": lambda: open_recording(None),
    "a long name": lambda: open_recording("x" * 5000),
    "a NUL": lambda: load_calibration("\0"),
    "frames": lambda: open_recording("x", frames=5),
    "frames of text": lambda: open_recording("x", frames=slice("a")),
    "no step": lambda: open_recording("x", frames=slice(None, None, 0)),
    "a name": lambda: Agent(rig(), None, EDGE),
    "an edge": lambda: Agent(rig(), "ann", 5),
    "a kind": lambda: Agent(rig(), "ann", EDGE, ["ar"]),
    "keys": lambda: Agent(rig(), "ann", EDGE, keys="\0", server_key="x"),
    "poses": lambda: Agent(rig(), "ann", EDGE, poses=["udp://127.0.0.1:5"]),
    "a folder": lambda: Agent(rig(), "ann", EDGE, out="\0"),
    "a function": lambda: Agent(rig(), "ann", EDGE, notify=5),
    "an address": lambda: Edge(None),
    "a policy": lambda: Edge(EDGE, policy=["share"]),
    "a map": lambda: Edge("tcp://127.0.0.1:0", map_file="\0"),
    "its folder": lambda: Edge("tcp://127.0.0.1:0", out=5),
    "its function": lambda: Edge("tcp://127.0.0.1:0", on_event=5),
}


@pytest.mark.parametrize("what", WRONG)
def test_arguments_of_another_kind_are_a_share_error_of_one_line(what):
    with pytest.raises(ShareError) as caught:
        WRONG[what]()
    assert str(caught.value).isprintable() and len(str(caught.value)) < 300


def test_frames_must_come_in_order():
    tracker = Tracker(rig())
    tracker.track(Frame(100, 0, GRAY, GRAY))
    with pytest.raises(ShareError, match="100 is not after the last frame's, 100"):
        tracker.track(Frame(100, 1, GRAY, GRAY))


def test_without_features_there_is_no_pose_but_a_reason():
    tracker = Tracker(rig().without_imu())
    assert tracker.track(Frame(0, 0, GRAY, GRAY)) is None
    assert (tracker.state, tracker.waiting_for) == ("INITIALISING", "view")


def test_what_cannot_be_tracked_or_opened_is_a_share_error(tmp_path):
    alone = replace(rig().without_imu(), cam1=None, T_cam1_cam0=None)
    with pytest.raises(ShareError, match=r"^rig: "):
        Tracker(alone)
    with pytest.raises(ShareError, match="no such file"):
        open_recording(tmp_path / "missing")
    with pytest.raises(ShareError, match="no such file"):
        load_calibration(tmp_path / "missing")
