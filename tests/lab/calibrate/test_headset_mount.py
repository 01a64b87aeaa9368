"""The mount of a headset's own tracking on a device, from two paths that share nothing but the head."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from helpers.special_files import special

from share.cli.main import cli
from share.errors import CalibrationMismatchError, DataError, ShareError
from share.geometry import se3
from share.lab.calibrate.headset import fit_mount, mount_warnings, moved_warning
from share.lab.mocap.trajectory import MocapTrajectory
from share.recordings.trajectory import Trajectory, format_tum

T_body_viewer = se3.exp(np.array([1.2, -0.3, 0.5, 0.02, -0.08, 0.05]))
SECONDS = 30


def head_poses(rng: np.random.Generator, roll_pitch_yaw: tuple[float, float, float], *times: np.ndarray):
    """Return the viewer's true poses of one head at the times (N,) s of each array."""
    hz, phase = rng.uniform(0.15, 0.6, (6, 3)), rng.uniform(0, 2 * np.pi, (6, 3))
    out = []
    for t in times:
        waves = np.sin(2 * np.pi * hz[:, :, None] * t + phase[:, :, None]).sum(1).T / np.sqrt(1.5)
        turns = [se3.so3_exp(np.outer(waves[:, k] * roll_pitch_yaw[k], np.eye(3)[k])) for k in range(3)]
        R = turns[2] @ turns[1] @ turns[0]
        out.append(se3.from_rt(R, waves[:, 3:] * [0.6, 0.6, 0.05] + [0, 0, 1.7]))
    return out


def tracked(rng: np.random.Generator, T: np.ndarray, hz: float) -> np.ndarray:
    """Return poses as a tracker that drifts and trembles would have them, in a world of its own."""
    steps = rng.normal(size=(len(T), 6)) * np.repeat([0.0005, 0.002], 3) / np.sqrt(hz)
    drift, tremble = np.cumsum(steps, 0), rng.normal(size=(len(T), 6)) * np.repeat([0.0003, 0.0005], 3)
    out = T.copy()
    out[:, :3, :3] = se3.so3_exp(drift[:, :3]) @ T[:, :3, :3]
    out[:, :3, 3] += drift[:, 3:]
    return se3.exp(rng.normal(size=6)) @ out @ se3.exp(tremble)


def two_trackers(
    seed: int,
    roll_pitch_yaw=(0.5, 0.5, 0.9),
    loose_rad: float = 0.0,
    seconds: float = SECONDS,
    loose_m: float = 0.0,
):
    """Return a device's and a headset's poses, and the offset of their clocks, s."""
    rng = np.random.default_rng(seed)
    t_device, t_headset = np.arange(0, seconds, 1 / 30), np.arange(-1, seconds + 1, 1 / 72)
    viewer_of_device, viewer = head_poses(rng, roll_pitch_yaw, t_device, t_headset)
    turned = np.where(t_device[:, None] > seconds / 2, [[loose_rad, 0, 0, 0, loose_m, 0]], 0.0)
    body = viewer_of_device @ se3.inverse(T_body_viewer @ se3.exp(turned))
    offset_s, start = rng.uniform(-0.4, 0.4), 10**12
    device = MocapTrajectory((t_device * 1e9).astype(np.int64) + start, tracked(rng, body, 30), "device")
    stamps = ((t_headset - offset_s) * 1e9).astype(np.int64) + start
    return device, MocapTrajectory(stamps, tracked(rng, viewer, 72), "headset"), offset_s


@pytest.mark.slow
def test_mount_and_offset_are_found_and_their_sigmas_hold():
    nees, errors = [], []
    for seed in range(12):
        device, headset, offset_s = two_trackers(seed)
        mount = fit_mount(device, headset)
        pose_error = se3.log(se3.inverse(mount.T_body_viewer) @ T_body_viewer)
        error = np.append(pose_error, offset_s - mount.offset_ns * 1e-9)
        errors.append([np.linalg.norm(error[:3]), np.linalg.norm(error[3:6]), abs(error[6])])
        nees.append(error @ np.linalg.solve(mount.cov, error) / 7)
        assert mount_warnings(mount) == [] and moved_warning(device, headset, mount) is None
    rotation, translation, offset = np.median(errors, axis=0)
    assert np.degrees(rotation) < 0.03 and translation < 0.0015 and offset < 0.0001
    assert 0.2 < np.mean(nees) < 2


def test_a_head_that_hardly_nods_is_said():
    device, headset, _ = two_trackers(3, (0.05, 0.1, 0.9))
    assert any("nods, tilts the head" in warning for warning in mount_warnings(fit_mount(device, headset)))


def test_yaw_alone_is_refused():
    with pytest.raises(DataError, match="turn the device about two axes"):
        fit_mount(*two_trackers(3, (0.001, 0.002, 0.9))[:2])


def test_a_mount_that_slips_by_a_degree_is_said():
    device, headset, _ = two_trackers(4, loose_rad=np.radians(1))
    warning = moved_warning(device, headset, fit_mount(device, headset))
    assert warning is not None and "the mount moved by 1.0 deg" in warning


@pytest.mark.parametrize("seed", [61, 62, 63])
def test_a_mount_that_slips_by_8_mm_is_said(seed):
    device, headset, _ = two_trackers(seed, loose_m=0.008)
    warning = moved_warning(device, headset, fit_mount(device, headset))
    assert warning is not None and "the mount moved by 0." in warning


def test_too_short_and_of_two_heads_is_refused():
    device, headset, _ = two_trackers(5, seconds=10)
    with pytest.raises(DataError, match="10 s in common, 15 are needed"):
        fit_mount(device, headset)
    with pytest.raises(CalibrationMismatchError, match=r"match at no time offset|not of one head"):
        fit_mount(two_trackers(5)[0], two_trackers(6)[1])


def test_command_writes_the_mount_and_says_its_sigmas(tmp_path):
    device, headset, offset_s = two_trackers(7)
    for name, poses in (("odom.tum", device), ("quest.tum", headset)):
        (tmp_path / name).write_text(format_tum(Trajectory(poses.stamps_ns, poses.T)))
    arguments = ["calibrate", "headset", str(tmp_path / "odom.tum"), str(tmp_path / "quest.tum")]
    done = CliRunner().invoke(cli, [*arguments, "--out", str(tmp_path / "mount")])
    assert done.exit_code == 0 and "viewer position" in done.output
    report = json.loads((tmp_path / "mount" / "headset-report.json").read_text())
    assert report["timeshift_device_headset_s"] == pytest.approx(offset_s, abs=2e-4)
    assert np.array(report["T_body_viewer"]) == pytest.approx(T_body_viewer, abs=0.005)
    assert (tmp_path / "mount" / "headset.yaml").read_text().splitlines()[-1].startswith("  timeshift_s")
    missing = CliRunner().invoke(cli, [*arguments[:-1], str(tmp_path / "no.tum"), "--out", str(tmp_path)])
    assert missing.exit_code != 0


@pytest.mark.parametrize(("factor", "apart"), [(1e3, "13.9 s"), (1e6, "13,888.9 s")])
def test_stamps_in_another_unit_are_said(factor, apart):
    headset = two_trackers(7)[1]
    stamps = ((headset.stamps_ns - headset.stamps_ns[0]) * factor).astype(np.int64)
    with pytest.raises(DataError, match=f"headset: poses are {apart} apart.*in ms or µs"):
        MocapTrajectory(stamps, headset.T, "headset")


def test_a_recording_with_a_hole_of_days_is_refused():
    """Its two clocks would be found by rotations every 10 ms of all of it."""
    stamps = np.arange(40_000) * 500_000_000
    stamps[-1] += 25 * 3600 * 10**9
    with pytest.raises(DataError, match="stamps jump by 90000 s"):
        MocapTrajectory(stamps, np.repeat(np.eye(4)[None], len(stamps), 0))


def test_a_damaged_line_is_left_out_and_a_pipe_is_said(tmp_path):
    device, headset, _ = two_trackers(7)
    for name, poses in (("odom.tum", device), ("quest.tum", headset)):
        (tmp_path / name).write_text(format_tum(Trajectory(poses.stamps_ns, poses.T)))
    lines = (tmp_path / "quest.tum").read_text().splitlines()
    lines[100] = " ".join([lines[100].split()[0], "nan", *lines[100].split()[2:]])
    (tmp_path / "quest.tum").write_text("\n".join(lines) + "\n")
    arguments = ["calibrate", "headset", str(tmp_path / "odom.tum"), str(tmp_path / "quest.tum")]
    done = CliRunner().invoke(cli, [*arguments, "--out", str(tmp_path / "mount")])
    assert done.exit_code == 0 and "skipped as damaged: 1 of the lines" in done.output
    special(tmp_path / "pipe.tum", "pipe")
    refused = CliRunner().invoke(cli, [*arguments[:-1], str(tmp_path / "pipe.tum"), "--out", str(tmp_path)])
    assert isinstance(refused.exception, ShareError) and "no such file" not in str(refused.exception)
