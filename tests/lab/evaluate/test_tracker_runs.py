"""What a peer tracker in another interpreter receives and returns, and errors of one that is missing."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.recordings import make_euroc

from share.config import Config
from share.errors import DataError, UsageError
from share.lab import peer_trackers
from share.lab.evaluate.peer_comparison import score_tracker
from share.lab.evaluate.tracker_runs import peer_frames, peer_version, rig_calibration, run_peer, run_share
from share.lab.peer_trackers import PEERS
from share.odometry.inertial_tracker import InertialTracker
from share.odometry.visual_tracker import VisualTracker
from share.recordings.trajectory import Trajectory
from share.runtime.pipeline import read_frames
from share.runtime.source import open_source
from share.sensors.sequencer import SequencerCounters

PEER = f"""
import sys
sys.path.insert(0, {str(Path(peer_trackers.__file__).parent)!r})
import numpy as np
from peer_wire import claim_stdout, read_line, read_frame, write_line

answers = claim_stdout()
print("chatter that is no answer", flush=True)
seen = dict(calibration=read_line(sys.stdin.buffer), moments=[])
while (moment := read_frame(sys.stdin.buffer)) is not None:
    if len(seen["moments"]) == int(sys.argv[2]):
        sys.exit("had enough")
    seen["moments"].append(moment._asdict())
    T = np.eye(4)
    T[:3, 3] = 0.1 * len(seen["moments"]), moment.left[0, 0], 1 / 3
    write_line(answers, dict(T_world_body=T.tolist(), cpu_s=0.001 * len(seen["moments"])))
np.save(sys.argv[1], seen, allow_pickle=True)
"""


@pytest.fixture
def source(tmp_path):
    return open_source(str(make_euroc(tmp_path / "recording", frames=25)))


def command(tmp_path, most=1000):
    script = tmp_path / "peer.py"
    script.write_text(PEER)
    return [sys.executable, str(script), str(tmp_path / "seen.npy"), str(most)]


def test_a_peer_receives_the_recorded_data(source, tmp_path):
    run_peer(source, command(tmp_path))
    seen = np.load(tmp_path / "seen.npy", allow_pickle=True).item()
    frames = list(read_frames(source, Config(), SequencerCounters()))
    assert [m["stamp_ns"] for m in seen["moments"]] == [frame.stamp_ns for frame in frames]
    for moment, frame in zip(seen["moments"], frames, strict=True):
        assert np.array_equal(moment["left"], frame.image0) and np.array_equal(moment["right"], frame.image1)
    imu_ns, imu = (np.concatenate([m[key] for m in seen["moments"]]) for key in ("imu_ns", "imu"))
    recorded = [m for m in source.measurements() if m.stream == "imu"][: len(imu_ns)]
    assert imu_ns.tolist() == [m.stamp_ns for m in recorded]
    assert imu.tolist() == [list(m.payload) for m in recorded]


def test_samples_go_just_past_their_frame(source):
    for moment in peer_frames(source):
        assert moment.imu_ns[-2] <= moment.stamp_ns < moment.imu_ns[-1]


def test_frames_without_a_later_sample_are_not_sent(source):
    stamps, values = source.imu
    last = source.stamps()["cam0"][-1]
    object.__setattr__(source, "imu", (stamps[stamps <= last], values[stamps <= last]))
    assert [m.stamp_ns for m in peer_frames(source)] == source.stamps()["cam0"][:-1].tolist()


def test_a_peer_receives_the_calibration(source, tmp_path):
    run_peer(source, command(tmp_path))
    told = np.load(tmp_path / "seen.npy", allow_pickle=True).item()["calibration"]
    left, right = told["cameras"]
    assert left["K"] == [[50.0, 0.0, 31.5], [0.0, 51.0, 23.5], [0.0, 0.0, 1.0]]
    assert left["distortion"] == [-0.28, 0.07, 0.0002, 1.76e-05] and (left["width"], left["height"]) == (
        64,
        48,
    )
    assert np.allclose(np.array(right["T_body_cam"]), [[1, 0, 0, 0.11], *np.eye(4)[1:]], atol=1e-12)
    assert told["imu"]["gyro_density"] == 1.7e-4 and told["imu"]["rate_hz"] == 200


def test_a_fisheye_lens_is_refused_in_one_line(source):
    fisheye = dataclasses.replace(source.rig.cam0, distortion=(0.0,) * 4, model="equidistant")
    object.__setattr__(source, "rig", dataclasses.replace(source.rig, cam0=fisheye))
    with pytest.raises(UsageError, match="has a fisheye lens"):
        rig_calibration(source)


def test_poses_of_a_peer_are_returned(source, tmp_path):
    run = run_peer(source, command(tmp_path))
    first = next(peer_frames(source))
    assert run.stamps == source.stamps()["cam0"].tolist()
    assert run.poses[0][:3, 3].tolist() == [0.1, float(first.left[0, 0]), 1 / 3]
    assert run.cpu_ms == pytest.approx(range(2, 26))  # the first frame sets up


def test_a_peer_that_ends_early_is_an_error(source, tmp_path):
    with pytest.raises(DataError, match="frame 3"):
        run_peer(source, command(tmp_path, most=3))


def test_a_lost_peer_has_no_pose_and_may_correct_earlier_ones(source, tmp_path):
    lost = PEER.replace(
        "T_world_body=T.tolist()", "T_world_body=None if len(seen['moments']) < 5 else T.tolist()"
    )
    end = "write_line(answers, dict(stamps_ns=[10, 20], T_world_body=[np.eye(4).tolist()] * 2))"
    script = tmp_path / "peer.py"
    script.write_text(lost + end)
    run = run_peer(source, [sys.executable, str(script), str(tmp_path / "seen.npy"), "1000"])
    assert run.stamps == source.stamps()["cam0"][4:].tolist()
    assert len(run.cpu_ms) == 24
    assert run.final.stamps_ns.tolist() == [10, 20]
    assert run.final.T.shape == (2, 4, 4)


def test_other_output_of_a_peer_is_kept(source, tmp_path):
    with pytest.raises(DataError, match=r"frame 3; see .*peer\.log"):
        run_peer(source, command(tmp_path, most=3), tmp_path / "peer.log")
    assert "chatter that is no answer" in (tmp_path / "peer.log").read_text()


def test_our_result_is_that_of_share_track(source):
    from share.runtime.offline_tracking import track

    run, told = run_share(source, Config()), track(source, Config(), lambda done: None)
    assert run.trajectory.stamps_ns.tolist() == told.trajectory.stamps_ns.tolist()
    assert np.array_equal(run.trajectory.T, told.trajectory.T)
    assert len(run.cpu_ms) == 24


def test_a_failure_of_our_tracker_ends_the_experiment(source, monkeypatch):
    def fail(self, frame):
        raise ArithmeticError("a singular matrix")

    monkeypatch.setattr(VisualTracker, "track", fail)
    monkeypatch.setattr(InertialTracker, "track", fail)
    with pytest.raises(ArithmeticError, match="a singular matrix"):
        run_share(source, Config())


def test_similar_cameras_need_not_be_turned(source):
    assert np.allclose(rig_calibration(source)["R_rectified_cam0"], np.eye(3), atol=1e-6)


def test_score_is_of_all_frames_under_one_alignment(source):
    truth = source.truth()
    T = np.array([[0, -1, 0, 4], [1, 0, 0, 5], [0, 0, 1, 6], [0, 0, 0, 1.0]])
    poses = T @ truth.T
    good = score_tracker("x", "y", source, Trajectory(truth.stamps_ns, poses), [1.0, 2.0, 6.0])
    assert good.ate_cm == pytest.approx(0, abs=1e-9)
    assert good.tracked_share == 1
    assert (good.cpu_ms, good.cpu_mean_ms) == (2, 3)
    poses[7, 2, 3] += 0.05
    off = score_tracker("x", "y", source, Trajectory(truth.stamps_ns, poses), [])
    assert off.max_cm == pytest.approx(5, rel=0.2)
    assert np.isnan(off.cpu_ms)


@pytest.mark.parametrize("python", [Path(sys.executable), Path("/nowhere/python")])
def test_peer_that_is_not_there_has_no_version(python):
    if python == Path(sys.executable) and importlib.util.find_spec("depthai"):
        pytest.skip("depthai is installed here")
    assert peer_version(PEERS["basalt"], python) is None


def test_mono_is_refused(tmp_path):
    folder = make_euroc(tmp_path / "mono", imu=False)
    with pytest.raises(UsageError, match="stereo"):
        rig_calibration(open_source(str(folder)))
