"""Faults do what their table says, and nothing else."""

import dataclasses

import numpy as np
import pytest
from helpers.experiments import experiment

from share.config import SequencerConfig
from share.geometry import se3
from share.geometry.camera import Camera, ImuNoise, Rig
from share.recordings.images import ArrayImage
from share.recordings.trajectory import Trajectory
from share.sensors.measurement import CAM0, CAM1, IMU, Measurement
from share.sensors.sequencer import FrameMerger, SequencerCounters, sequence_frames
from share.types import Frame, ImuBatch

moving_panel, sensor_faults = experiment("moving_panel"), experiment("sensor_faults")
Panel, draw_panel, share_of_view = moving_panel.Panel, moving_panel.draw_panel, moving_panel.share_of_view
FAULTS, apply_fault = sensor_faults.FAULTS, sensor_faults.apply_fault
RATE_HZ, SECONDS, IMU_HZ = 10, 20, 200
STEP_NS, IMU_NS = 10**9 // RATE_HZ, 10**9 // IMU_HZ
SHAPE = HEIGHT, WIDTH = 90, 120
CAMERA = Camera(WIDTH, HEIGHT, 100.0, 100.0, 59.5, 44.5)
BASELINE = 0.05
EAST = np.array(
    [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
)  # R_world_cam of who looks along x, upright
UPRIGHT = se3.from_rt(EAST, np.zeros(3))
RIG = Rig(
    CAMERA,
    UPRIGHT,  # the body's x is ahead, its z up
    cam1=CAMERA,
    T_cam1_cam0=se3.from_rt(np.eye(3), np.array([-BASELINE, 0.0, 0.0])),
    depth=CAMERA,
    T_depth_cam0=np.eye(4),
    imu=ImuNoise(1e-3, 1e-2, 1e-5, 1e-4, IMU_HZ),
)
IMU_FAULTS = {"imu_silent_1s", "imu_dead", "imu_never", "saturating"}
CHANGES = sorted(name for name, fault in FAULTS.items() if fault.change_frames)


def seconds(frames):
    return np.array([f.stamp_ns for f in frames]) * 1e-9


@pytest.fixture(scope="module")
def frames():
    """A body that goes ahead by 0.1 m/s and looks at noise."""
    rng = np.random.default_rng(7)
    out = []
    for k in range(RATE_HZ * SECONDS):
        stamps = np.arange(k * STEP_NS - STEP_NS + IMU_NS, k * STEP_NS + 1, IMU_NS)
        imu = ImuBatch(stamps, rng.normal(size=(len(stamps), 3)), rng.normal(size=(len(stamps), 3)))
        left, right = rng.integers(60, 200, (2, *SHAPE), np.uint8)
        out.append(Frame(k * STEP_NS, k, left, right, np.full(SHAPE, 5.0, np.float32), imu))
    return out


@pytest.fixture(scope="module")
def truth(frames):
    stamps = np.array([f.stamp_ns for f in frames])
    p = np.stack([0.1 * seconds(frames), 0 * stamps, 1.6 + 0 * stamps], axis=1)
    return Trajectory(stamps, se3.from_rt(np.tile(np.eye(3), (len(p), 1, 1)), p))


def done(name, frames, truth):
    return apply_fault(FAULTS[name], frames, RIG, truth)


def images(frame):
    return [frame.image0, frame.image1]


def gyro(frames):
    return np.concatenate([f.imu.gyro for f in frames])


def as_it_was(before, after):
    return before.imu is after.imu and all(a is b for a, b in zip(images(before), images(after), strict=True))


# ------------------------------------------------------------------ all


@pytest.mark.long
@pytest.mark.parametrize("name", CHANGES)
def test_a_fault_is_deterministic_and_leaves_the_recording_unchanged(name, frames, truth):
    kept = [[image.copy() for image in images(f)] for f in frames]
    first, again = done(name, frames, truth), done(name, frames, truth)
    assert all(
        (a == b).all() for f, k in zip(frames, kept, strict=True) for a, b in zip(images(f), k, strict=True)
    )
    for a, b in zip(first, again, strict=True):
        assert a.stamp_ns == b.stamp_ns
        assert (a.image0 == b.image0).all()
        assert (a.image1 == b.image1).all()
        assert (a.imu.gyro == b.imu.gyro).all()


@pytest.mark.parametrize("name", CHANGES)
def test_a_fault_changes_only_its_streams(name, frames, truth):
    after = done(name, frames, truth)
    assert (np.diff([f.stamp_ns for f in after]) > 0).all()
    assert all(f.image0.shape == f.image1.shape == SHAPE and f.image0.dtype == np.uint8 for f in after)
    if name == "drop20":
        return
    felt = [a.imu is b.imu for a, b in zip(frames, after, strict=True)]
    shown = [(a.image0 == b.image0).all() for a, b in zip(frames, after, strict=True)]
    assert all(felt) == (name not in IMU_FAULTS)
    assert all(shown) == (name in IMU_FAULTS)


def test_the_clean_fault_changes_nothing(frames, truth):
    assert done("clean", frames, truth) is frames


# ------------------------------------------------------------------ frames and stamps


def test_dropped_frames_leave_their_samples_to_the_next(frames, truth):
    after = done("drop20", frames, truth)
    assert 0.75 < len(after) / len(frames) < 0.85
    until = np.concatenate([f.imu.stamps_ns for f in frames if f.stamp_ns <= after[-1].stamp_ns])
    assert (np.concatenate([f.imu.stamps_ns for f in after]) == until).all()
    steps = np.diff([f.stamp_ns for f in after])
    assert [f.gap_ns for f in after[1:]] == [step if step > 2.5 * STEP_NS else 0 for step in steps]
    assert any(f.gap_ns for f in after)


def test_bad_stamps_go_through_the_sequencer(frames):
    measurements = [
        Measurement(stream, f.stamp_ns, image)
        for f in frames
        for stream, image in ((IMU, (0.0,) * 6), (CAM0, ArrayImage(f.image0)), (CAM1, ArrayImage(f.image1)))
    ]
    arriving = FAULTS["stamps"].change_measurements(measurements)
    reported = {name: [m.stamp_ns for m in arriving if m.stream == name] for name in (CAM0, CAM1, IMU)}
    assert reported[CAM0] == reported[CAM1]
    assert reported[IMU] == [f.stamp_ns for f in frames]
    off = np.array(reported[CAM0]) - reported[IMU]
    sorts = (off == -STEP_NS, off == -500_000_000, np.abs(off) == 40_000_000)
    assert all(1 <= wrong.sum() <= 12 for wrong in sorts)  # 2 % of 200 is 4
    assert sum(wrong.sum() for wrong in sorts) == (off != 0).sum()
    counters = SequencerCounters()
    bundles = list(
        sequence_frames(arriving, FrameMerger((CAM0, CAM1, IMU), RATE_HZ, SequencerConfig(), counters))
    )
    assert (np.diff([b.stamp_ns for b in bundles]) > 0).all()
    assert counters.duplicates > 0
    assert counters.backward > 0


# ------------------------------------------------------------------ light


@pytest.mark.parametrize(("name", "lasts"), [("black", 2.0), ("covered", 2.0), ("white_wall", 3.0)])
def test_a_temporary_fault_affects_both_cameras_for_its_duration(name, lasts, frames, truth):
    after = done(name, frames, truth)
    since = seconds(frames) - 0.4 * seconds(frames)[-1]
    inside = (since >= 0) & (since < lasts)
    for before, now, wrong in zip(frames, after, inside, strict=True):
        assert as_it_was(before, now) == (not wrong)
        assert (now.depth == 0).all() == wrong


def middle(frames, after):
    """Return the frame in the middle of the fault."""
    return after[int(np.searchsorted(seconds(frames), 0.4 * seconds(frames)[-1] + 1.0))]


def test_black_covered_and_white(frames, truth):
    black, covered, white = (
        middle(frames, done(name, frames, truth)) for name in ("black", "covered", "white_wall")
    )
    assert all((image == 0).all() for image in images(black))
    assert all(2 < image.mean() < 6 and 1 < image.std() < 3 for image in images(covered))
    assert (covered.image0 != covered.image1).any()
    assert all(160 < image.mean() < 180 and 1 < image.std() < 4 for image in images(white))


def test_exposure_saturates(frames, truth):
    after = done("exposure", frames, truth)
    bright, dark = after[RATE_HZ * 2], after[RATE_HZ * 5]
    assert (bright.image0[frames[RATE_HZ * 2].image0 > 85] == 255).all()
    assert np.abs(dark.image1 - frames[RATE_HZ * 5].image1 / 3).max() <= 0.5
    assert (after[0].image0 == frames[0].image0).all()


def turning(frames, way, rate=3.0):
    """The frames with a white vertical line, on a body that turns about its axis `way`."""
    line = np.zeros(SHAPE, np.uint8)
    line[:, 60] = 240
    rates = np.zeros(3)
    rates[way] = rate
    return [
        dataclasses.replace(
            f,
            image0=line,
            image1=line,
            imu=ImuBatch(f.imu.stamps_ns, np.tile(rates, (len(f.imu), 1)), f.imu.accel),
        )
        for f in frames[:20]
    ]


def test_blur_has_the_length_and_direction_of_the_image_motion(frames, truth):
    about_z, about_y = (turning(frames, way) for way in (2, 1))  # the body's z is up
    for after in (done("blur", about_z, truth)[10], done("blur", about_y, truth)[10]):
        assert np.abs(after.image0 - after.image1.astype(int)).max() == 0
    row = done("blur", about_z, truth)[10].image0[45].astype(float)
    x = np.arange(WIDTH)
    assert row.sum() == pytest.approx(240, rel=0.02)
    spread = np.sqrt(np.average((x - 60.0) ** 2, weights=row))
    assert spread == pytest.approx(100 * 3.0 * 0.008 / np.sqrt(12), rel=0.25)  # of a box, and the pixels'
    assert np.average(x, weights=row) == pytest.approx(60, abs=0.02)
    assert (done("blur", about_y, truth)[10].image0[45, [59, 61]] == 0).all()


# ------------------------------------------------------------------ IMU


def test_a_silent_imu_has_no_samples(frames, truth):
    until = int(0.4 * len(frames))
    second, dead, never = (
        [len(f.imu) == 0 for f in done(name, frames, truth)]
        for name in ("imu_silent_1s", "imu_dead", "imu_never")
    )
    assert sum(second) == RATE_HZ
    assert not any(second[: until - 1]) and all(second[until : until + RATE_HZ - 1])
    assert not any(dead[: until - 1]) and all(dead[until:])
    assert all(never)


def test_a_saturating_imu_is_clipped(frames, truth):
    for name in ("gyro", "accel"):
        before, after = (
            np.concatenate([getattr(f.imu, name) for f in some])
            for some in (frames, done("saturating", frames, truth))
        )
        most = np.abs(after).max()
        assert (np.abs(after) == most).any(axis=1).mean() == pytest.approx(0.05, abs=0.005)
        inside = np.abs(before) < most
        assert (after[inside] == before[inside]).all()


# ------------------------------------------------------------------ things that move by themselves


def at(x, y, z):
    """T_cam_panel of one that faces the camera."""
    return se3.from_rt(np.eye(3), np.array([x, y, z]))


def extent(frame, clean):
    """Width in px of what was drawn into cam0, in the middle row."""
    there = np.flatnonzero(frame.depth[45] != clean.depth[45])
    return there[-1] - there[0] + 1


def test_a_panel_is_where_both_cameras_would_see_it(frames):
    panel, clean = Panel(0.4, 0.4), frames[0]
    (near,) = draw_panel([clean], RIG, panel, (RIG.T_body_cam0 @ at(0, 0, 1.0))[None])
    (far,) = draw_panel([clean], RIG, panel, (RIG.T_body_cam0 @ at(0, 0, 2.0))[None])
    assert extent(near, clean) == pytest.approx(40, abs=1)
    assert extent(far, clean) == pytest.approx(20, abs=1)
    assert set(np.unique(near.depth)) == {1.0, 5.0}
    left, right = (
        near.image0[35:55, 45:75].astype(float),
        near.image1[35:55, 40:70].astype(float),
    )  # f b / z = 5 px
    assert np.abs(left - right).mean() < 3  # noise
    assert np.abs(left - near.image1[35:55, 45:75]).mean() > 10
    assert (near.image0[:, :35] == clean.image0[:, :35]).all()
    share = share_of_view(CAMERA, panel, at(0, 0, 1.0)[None], 1)[0]
    assert share == pytest.approx((near.depth == 1).mean())


def test_a_panel_that_is_not_there_or_behind_is_not_drawn(frames):
    panel = Panel(0.4, 0.4)
    behind, nowhere = RIG.T_body_cam0 @ at(0, 0, -1.0), np.full((4, 4), np.nan)
    after = draw_panel(frames[:2], RIG, panel, np.array([behind, nowhere]))
    assert all((a.image0 == b.image0).all() for a, b in zip(frames, after, strict=False))
    assert after[1] is frames[1]


def test_a_panel_seen_from_its_edge(frames):
    """Some ways run along it and never meet it."""
    edge_on = se3.from_rt(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), np.array([0.005, -0.005, 1.0]))
    (after,) = draw_panel(frames[:1], RIG, Panel(0.4, 0.4), (RIG.T_body_cam0 @ edge_on)[None])
    assert (after.depth != frames[0].depth).mean() < 0.02
    assert share_of_view(CAMERA, Panel(0.4, 0.4), edge_on[None], 1)[0] < 0.02


@pytest.fixture
def ride(frames, truth):
    """Seconds, T_world_cam."""
    return seconds(frames), truth.T @ RIG.T_body_cam0


def test_a_starting_panel_moves_off_slowly(ride):
    t, T_world_cam = ride
    panel = Panel(1.1, 1.4)
    T = moving_panel.path_starts(t, T_world_cam, CAMERA, panel, 5.0)
    gone = np.linalg.norm(T[:, :3, 3] - T[0, :3, 3], axis=1)
    begin = t[np.flatnonzero(gone > 0)[0] - 1]
    assert 0.3 <= begin / t[-1] <= 0.55
    assert gone[-1] == pytest.approx(0.75)
    assert np.diff(gone)[(t[1:] > begin + 0.2) & (t[1:] < begin + 4.9)] == pytest.approx(0.015)
    seen = share_of_view(CAMERA, panel, se3.inverse(T_world_cam) @ T)
    assert seen[(t > begin - 3) & (t < begin + 5)].min() > 0.2
    assert np.linalg.norm(T[:, :3, 3] - T_world_cam[:, :3, 3], axis=1).min() > 0.4
    stays = moving_panel.path_starts(t, T_world_cam, CAMERA, panel, 5.0, speed=0.0)
    assert np.ptp(stays, axis=0).max() == 0


def test_a_panel_without_a_free_place_is_refused(ride):
    """Who goes straight ahead by 1 m/s would run into it."""
    t, T_world_cam = ride
    ahead = T_world_cam.copy()
    ahead[:, 0, 3] = t
    with pytest.raises(ValueError, match="no place"):
        moving_panel.path_starts(t, ahead, CAMERA, Panel(1.1, 1.4), 5.0)


def test_a_coming_panel_moves_on_its_own_and_stays_in_view(ride):
    t, T_world_cam = ride
    T = moving_panel.path_comes(t, T_world_cam, 5.0, 10.0)
    there = ~np.isnan(T[:, 0, 0])
    assert (there == ((t >= 5) & (t <= 15))).all()
    p = (se3.inverse(T_world_cam[there]) @ T[there])[:, :3, 3]
    assert p[0, 0] < -1.2 and p[-1, 0] < -1.2  # from the left, where nothing of it is seen
    assert np.abs(p[20:-20, 0]).max() < 0.4 and np.ptp(p[20:-20, 0]) > 0.4
    assert p[:, 2] == pytest.approx(1.0, abs=0.05)


def test_a_following_panel_is_fixed_in_the_view(ride):
    t, T_world_cam = ride
    T = se3.inverse(T_world_cam) @ moving_panel.path_follows(t, T_world_cam, 5.0, 10.0)
    inside = (t > 6.6) & (t < 13.4)
    assert np.ptp(T[inside], axis=0).max() < 1e-9
    assert T[inside][0, :3, 3] == pytest.approx([-0.35, 0, 1.0])
