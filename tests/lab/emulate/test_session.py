"""A session is complete, deterministic, and never incomplete under its name."""

import itertools
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from helpers.small_session import RATE_HZ, SIZE, files, small_profile, small_recipe, write_poses

from share.errors import ShareError, UsageError
from share.geometry import se3
from share.lab.emulate import session as sessions
from share.lab.emulate.recipe import no_progress
from share.lab.emulate.session import make_cached_session, make_session
from share.lab.emulate.stage import prepare_session
from share.lab.emulate.types import START_NS
from share.recordings.session import read_session
from share.recordings.trajectory import read_tum
from share.runtime.source import open_source
from share.sensors.measurement import CAM0, CAM1, DEPTH, IMU
from share.sensors.profile import load_profile
from share.types import AgentKind

pytestmark = pytest.mark.long

SECONDS = 3.0
TICK = 3e-6  # rad and m within the microsecond in which a D435i counts
MOTIONS = ("ann=walk:", "robot:speed=0.5")


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    return small_profile(tmp_path_factory.mktemp("profile"))


@pytest.fixture(scope="module")
def recipe(small):
    return small_recipe(small, *MOTIONS, seed=5)


@pytest.fixture(scope="module")
def whole(recipe, tmp_path_factory):
    return make_session(recipe, tmp_path_factory.mktemp("made") / "session", workers=2)


def stage_of(recipe, tmp_path):
    return prepare_session(recipe, tmp_path / "room", no_progress).stage


# ------------------------------------------------------------------ what is in it


def test_a_session_has_all_its_files(whole):
    assert sorted(files(whole)) == [
        "ann.mcap",
        "plan.png",
        "robot1.mcap",
        "session.yaml",
        "truth/ann.tum",
        "truth/robot1.tum",
    ]
    assert os.listdir(whole.parent) == ["session"]
    agents = read_session(whole).agents
    assert {n: (a.kind, a.sensors, a.rate_hz) for n, a in agents.items()} == {
        "ann": (AgentKind.AR, "stereo+imu", RATE_HZ),
        "robot1": (AgentKind.ROBOT, "rgbd+imu", RATE_HZ),
    }


@pytest.mark.parametrize(("name", "streams"), [("ann", {CAM0, CAM1, IMU}), ("robot1", {CAM0, DEPTH, IMU})])
def test_streams_have_their_counts_and_rates(name, streams, whole):
    stamps = open_source(str(whole / name)).stamps()
    assert set(stamps) == streams
    for stream in streams - {IMU}:
        assert len(stamps[stream]) == SECONDS * RATE_HZ
        np.testing.assert_allclose(np.diff(stamps[stream]), 1e9 / RATE_HZ, atol=1001)  # whole microseconds
        np.testing.assert_array_equal(stamps[stream], stamps[CAM0])
    assert len(stamps[IMU]) == pytest.approx(SECONDS * 400, abs=3)
    np.testing.assert_allclose(np.diff(stamps[IMU]), 2.5e6, atol=1001)


@pytest.mark.parametrize("name", ["ann", "robot1"])
def test_measurements_come_in_order_and_images_can_be_decoded(name, whole):
    seen = list(open_source(str(whole / name)).measurements())
    assert all(a.stamp_ns <= b.stamp_ns for a, b in itertools.pairwise(seen))
    for m in (m for m in seen if m.stream != IMU):
        image = m.payload.load()
        assert image.shape == SIZE[::-1]
        if m.stream == DEPTH:
            assert 0.3 < np.median(image[image > 0]) < 10  # m
        else:
            assert image.dtype == np.uint8
            assert image.std() > 10


def test_truth_is_the_path_at_the_stamps_of_the_pictures(whole, recipe, tmp_path):
    for actor in stage_of(recipe, tmp_path).actors:
        stamps, T = read_tum(whole / "truth" / f"{actor.name}.tum")
        np.testing.assert_array_equal(stamps, open_source(str(whole / actor.name)).stamps()[CAM0])
        exact = actor.path.poses(stamps)  # no offset: its clock is the path's
        assert se3.rotation_angle(se3.inverse(exact) @ T).max() < TICK
        assert np.abs(exact[:, :3, 3] - T[:, :3, 3]).max() < TICK


def test_calibration_is_the_rig(whole, small):
    made = load_profile(small)
    for name, depth in (("ann", False), ("robot1", True)):
        rig, stated = made.rig(depth=depth), read_session(whole).agents[name].calibration.rig
        assert (stated.cam0, stated.cam1, stated.depth, stated.imu) == (
            rig.cam0,
            rig.cam1,
            rig.depth,
            rig.imu,
        )
        for key in ("T_body_cam0", "T_cam1_cam0", "T_depth_cam0"):
            if getattr(rig, key) is None:
                assert getattr(stated, key) is None
            else:
                np.testing.assert_allclose(getattr(stated, key), getattr(rig, key), atol=1e-12)


def test_provenance_holds_the_recipe(whole, recipe):
    reported = read_session(whole).provenance
    assert reported["generator"] == "share emulate"
    assert {key: reported[key] for key in recipe.to_mapping()} == recipe.to_mapping()
    assert reported["seed"] == 5


# ------------------------------------------------------------------ same recipe, same bytes


@pytest.mark.slow
def test_one_worker_makes_the_same_bytes(whole, recipe, tmp_path):
    alone = make_session(recipe, tmp_path / "other name", workers=1)
    assert files(alone) == files(whole)


def test_another_seed_is_another_room_and_other_noise(whole, recipe, tmp_path):
    other = replace(recipe, seed=6)
    prepared = [prepare_session(r, tmp_path / str(r.seed), no_progress) for r in (recipe, other)]
    assert not np.allclose(*(one.layout.pieces[0].bounding_box for one in prepared))
    a, b = (one.stage.actors[0] for one in prepared)
    assert not np.allclose(a.path.poses(a.pictures.true_ns[:5]), b.path.poses(b.pictures.true_ns[:5]))
    assert (
        np.abs(a.device.imu_streams(a.path).gyro[:50] - b.device.imu_streams(a.path).gyro[:50]).max() > 1e-4
    )
    assert recipe.digest != other.digest


def test_the_digest_follows_files_that_the_user_edits(small, tmp_path):
    poses = write_poses(tmp_path / "poses.tum", START_NS + np.arange(0, 10**9, 10**7))
    recipe = small_recipe(small, f"tum:{poses}")
    before = recipe.digest
    assert recipe.digest == before
    poses.write_text(poses.read_text().replace(" -0.5 0.5 ", " -0.50 0.5 ", 1))
    assert recipe.digest != before


# ------------------------------------------------------------------ breaks


@pytest.mark.slow
def test_a_killed_session_is_resumed_with_the_same_result(whole, recipe, small, tmp_path):
    out, grows = tmp_path / "session", tmp_path / ".session.partial"
    words = ["--scene", "plain", "--seconds", "3", "--seed", "5", "--workers", "1", "--profile", str(small)]
    words += [word for motion in MOTIONS for word in ("--motion", motion)]
    maker = subprocess.Popen([sys.executable, "-m", "share", "emulate", *words, "--out", str(out)])
    deadline = time.monotonic() + 60
    while not (drawn := sorted(grows.glob("*/frames/*/*.chunk"))):
        assert maker.poll() is None, "ended before it was killed"
        assert time.monotonic() < deadline
        time.sleep(0.002)
    maker.send_signal(signal.SIGKILL)
    maker.wait()
    assert not out.exists()
    before = {chunk: chunk.stat().st_mtime_ns for chunk in drawn}
    (grows / "session").mkdir(exist_ok=True)
    (grows / "session" / ".ann.mcap.left").write_text("half of something")
    kept = {}

    def look(what, done, total):
        if what == "writing recordings" and not kept:
            kept.update({chunk: chunk.stat().st_mtime_ns for chunk in before})

    make_session(recipe, out, workers=2, progress=look)
    assert kept == before
    assert files(out) == files(whole)
    assert os.listdir(tmp_path) == ["session"]


def test_a_folder_that_exists_is_not_touched(recipe, tmp_path):
    (tmp_path / "session").mkdir()
    with pytest.raises(UsageError, match="session: exists already; give the name of a new folder"):
        make_session(recipe, tmp_path / "session")
    assert files(tmp_path) == {}


def test_a_second_process_on_the_same_folder_is_refused(recipe, tmp_path):
    from share.files.locks import lock_folder

    held = lock_folder(tmp_path / ".session.partial")
    try:
        with pytest.raises(UsageError, match="another run is writing there"):
            make_session(recipe, tmp_path / "session")
    finally:
        os.close(held)


def test_a_full_disk_is_reported_before_drawing(recipe, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(sessions.shutil, "disk_usage", lambda path: usage._replace(free=10**6))
    with pytest.raises(ShareError, match=r"about 0.03 GB are needed and 0.00 GB are free; make room, or"):
        make_session(recipe, tmp_path / "deep" / "session")
    assert os.listdir(tmp_path) == []


@pytest.mark.slow
def test_a_cached_session_is_made_once_and_not_from_work_for_another(small, tmp_path):
    recipe = small_recipe(small, "ann=walk:", effects=("blur=off",))
    name = f"session-{recipe.digest}"
    left = tmp_path / f".{name}.partial" / "123456789abc" / "frames" / "ann"
    left.mkdir(parents=True)
    (left / "000000.chunk").write_bytes(b"of another recipe")
    assert make_cached_session(recipe, tmp_path, workers=1) == tmp_path / name
    assert (
        make_cached_session(recipe, tmp_path, progress=lambda *_: pytest.fail("made again"))
        == tmp_path / name
    )
    assert os.listdir(tmp_path) == [name]


# ------------------------------------------------------------------ other forms and faults


@pytest.mark.slow
def test_asl_folders_hold_the_same(small, tmp_path):
    recipe = small_recipe(small, "ann=walk:", sensors={"": "stereo"}, images="png")
    out = make_session(recipe, tmp_path / "flights", workers=1, asl=True)
    assert sorted(os.listdir(out)) == ["ann", "emulation.yaml", "plan.png"]
    source, actor = open_source(str(out / "ann")), stage_of(recipe, tmp_path).actors[0]
    assert source.rig.kind == "stereo+imu"
    np.testing.assert_array_equal(source.stamps()[CAM0], actor.pictures.stamp_ns)
    np.testing.assert_array_equal(source.stamps()[IMU], actor.device.imu(actor.path).joined().stamps_ns)
    stamps, T = source.truth()
    np.testing.assert_array_equal(stamps, actor.pictures.stamp_ns)
    np.testing.assert_allclose(T, actor.path.poses(stamps), atol=TICK)
    np.testing.assert_allclose(source.rig.T_body_cam0, actor.rig.T_body_cam0, atol=1e-12)


def test_depth_does_not_fit_an_asl_folder(recipe, tmp_path):
    with pytest.raises(UsageError, match="robot1: an ASL folder has no place for depth; give --sensors"):
        make_session(recipe, tmp_path / "flights", asl=True)
    assert os.listdir(tmp_path) == []


@pytest.mark.slow
def test_faults_of_clocks_and_cables(small, tmp_path):
    """Drops, jitter, a camera that is stamped late, and two clocks that differ from the session's."""
    effects = ("drops=0.2", "jitter_ms=4", "time_offset_ms=30", "clock_offset_ms=1500", "blur=off")
    recipe = small_recipe(small, "ann=walk:", seconds=4.0, effects=effects)
    out = make_session(recipe, tmp_path / "session", workers=1)
    agent, actor = read_session(out).agents["ann"], stage_of(recipe, tmp_path).actors[0]
    stamps = open_source(str(out / "ann")).stamps()
    assert agent.clock_offset_ns == 1_500_000_000
    session_ns = stamps[CAM0] - agent.clock_offset_ns
    late = (session_ns - actor.pictures.true_ns) / 1e6
    assert late.mean() == pytest.approx(-30, abs=3)
    assert 1.5 < late.std() < 7
    assert np.diff(actor.pictures.index).max() >= 2
    assert len(stamps[CAM0]) < 4 * RATE_HZ
    assert np.diff(stamps[CAM0]).max() > 1.7e9 / RATE_HZ
    imu_ns = stamps[IMU] - agent.clock_offset_ns
    assert START_NS <= imu_ns[0] < START_NS + 10**7
    truth, T = read_tum(out / "truth" / "ann.tum")
    assert set(truth) <= set(stamps[CAM0])
    exact = actor.path.poses(truth - agent.clock_offset_ns)
    np.testing.assert_allclose(T, exact, atol=TICK)


@pytest.mark.slow
def test_a_counter_that_wraps_keeps_its_order(small, tmp_path):
    period, before_ns = (1 << 32) * 1000, 1_500_000_000
    offset = (period - START_NS % period - before_ns) / 1e6  # ms: wraps 1.5 s after the start
    effects = ("wrap=on", f"clock_offset_ms={offset!r}", "blur=off")
    recipe = small_recipe(small, "ann=walk:", effects=effects)
    out = make_session(recipe, tmp_path / "session", workers=1)
    raw = [m.stamp_ns for m in open_source(str(out / "ann")).measurements()]
    falls = [(a, b) for a, b in itertools.pairwise(raw) if b < a - period // 2]
    assert len(falls) == 1
    assert max(raw) < period
    unwrapped = np.where(np.array(raw) < period // 2, np.array(raw) + period, raw)
    assert (np.diff(unwrapped) >= 0).all()
    start = START_NS + read_session(out).agents["ann"].clock_offset_ns
    assert start == period - before_ns
    assert unwrapped[0] - start < 10**8


@pytest.mark.slow
def test_pictures_are_left_out_in_gaps_of_the_truth(small, tmp_path):
    stamps = START_NS + np.arange(0, 4 * 10**9, 10**7)
    gap = (stamps[150], stamps[230])
    poses = write_poses(tmp_path / "poses.tum", stamps[(stamps <= gap[0]) | (stamps >= gap[1])])
    recipe = small_recipe(small, f"ann=tum:{poses}", seconds=4.0, effects=("time_offset_ms=20", "blur=off"))
    out = make_session(recipe, tmp_path / "session", workers=1)
    seen = open_source(str(out / "ann")).stamps()
    exposed = seen[CAM0] + 20_000_000
    assert not ((exposed > gap[0]) & (exposed < gap[1])).any()
    assert len(exposed) == pytest.approx(10 * (4.0 - 0.8), abs=2)
    truth, _ = read_tum(out / "truth" / "ann.tum")
    assert not ((truth > gap[0]) & (truth < gap[1])).any()
    assert len(truth) >= len(exposed) - 2
    assert np.diff(seen[IMU]).max() < 3e6  # the IMU goes on
