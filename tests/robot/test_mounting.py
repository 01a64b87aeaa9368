"""Where the camera sits on the robot, from emulated drives: slip, unequal wheels, latency, noise."""

from __future__ import annotations

import json
import socket
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from helpers.mounting_drive import eight, mounting_drive
from helpers.robot_drive import SECOND

from share.cli.main import cli
from share.errors import ConfigError, DataError
from share.files.yaml_file import read_yaml_text
from share.geometry.se3 import inverse, so3_log
from share.robot import robot_events as ev
from share.robot.mounting import MountingDrive, find_mounting
from share.robot.mounting_text import mounting_line, with_mounting
from share.robot.planar import PlanarPose
from share.robot.pose_message import parse_pose_message
from share.robot.robot_file import T_base_of_camera, read_robot
from share.runtime.pose import Pose
from share.runtime.pose_feed import PoseMessages
from share.runtime.robot_drive import DriveRecorder
from share.types import TrackState

TRUE = T_base_of_camera([0.09, -0.05, 0.21], yaw_deg=12.0, pitch_deg=8.0)


def error(T_base_body: np.ndarray) -> tuple[float, float, float]:
    """x and y, m; rotation, degrees."""
    x, y, _ = T_base_body[:3, 3] - TRUE[:3, 3]
    return x, y, float(np.degrees(np.linalg.norm(so3_log(TRUE[:3, :3] @ T_base_body[:3, :3].T))))


@pytest.fixture(scope="module")
def drive() -> MountingDrive:
    return mounting_drive(TRUE, eight, 48.0, seed=31)


@pytest.mark.long
@pytest.mark.parametrize("late_s", [0.0, 0.06, -0.04])
def test_a_drive_in_eights_finds_it(drive: MountingDrive, late_s: float) -> None:
    late = replace(drive, wheel_ns=drive.wheel_ns + round(late_s * SECOND))
    found = find_mounting(late, 0.21)
    x, y, turned = error(found.T_base_body)
    assert abs(x) < 0.004 and abs(y) < 0.004 and turned < 0.2
    assert abs(x) < 5 * found.sigma_x_m and abs(y) < 5 * found.sigma_y_m
    assert found.T_base_body[2, 3] == 0.21 and found.sigma_x_m < 0.003
    assert "mm ahead" in found.text() and json.dumps(found.report())


@pytest.mark.long
@pytest.mark.parametrize(
    ("command", "text"),
    [
        (lambda t: (0.2, 0.0), "turn by 180° and more to both sides"),
        (lambda t: (0.2, 0.5), "0° to the right so far"),
        (lambda t: (0.0, 0.8 if t < 15 else -0.8), "not only turn on the spot"),
    ],
)
def test_a_drive_that_does_not_show_it_is_refused(command, text: str) -> None:
    with pytest.raises(DataError, match="does not show where the camera sits") as refused:
        find_mounting(mounting_drive(TRUE, command, 30.0, seed=32))
    assert text in str(refused.value)


@pytest.mark.long
def test_gaps_and_jumps_of_the_tracker_do_no_harm(drive: MountingDrive) -> None:
    poses = drive.T_odom_body.copy()
    poses[300:, :3, 3] += (5.0, -2.0, 0.0)  # it began anew
    kept = np.ones(len(poses), bool)
    kept[400:430] = False
    cut = replace(drive, T_odom_body=poses[kept], pose_ns=drive.pose_ns[kept])
    x, y, turned = error(find_mounting(cut).T_base_body)
    assert abs(x) < 0.005 and abs(y) < 0.005 and turned < 0.3


@pytest.mark.long
def test_the_sigma_knows_that_the_cameras_scale_may_be_off(drive: MountingDrive) -> None:
    """By 3 %, which moves x by 2.7 mm; what the windows show is a tenth of that."""
    poses = drive.T_odom_body.copy()
    poses[:, :3, 3] *= 1.03
    found = find_mounting(replace(drive, T_odom_body=poses))
    x, y, _ = error(found.T_base_body)
    assert 0.002 < abs(x) < 2 * found.sigma_x_m and abs(y) < 2.5 * found.sigma_y_m
    assert found.sigma_x_m < 0.005 and found.scale == pytest.approx(0.03, abs=0.015)


@pytest.mark.long
def test_another_robots_wheels_are_refused(drive: MountingDrive) -> None:
    with pytest.raises(DataError, match=r"of the way|known to"):
        find_mounting(replace(drive, wheels=drive.wheels * (0.6, 0.6, 1.0)))
    with pytest.raises(DataError, match="drive longer"):
        find_mounting(replace(drive, wheel_ns=drive.wheel_ns + 3600 * SECOND))


def test_the_file_keeps_everything_else(tmp_path: Path) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text(
        "# mine\ncamera:\n  position_m: [0, 0, 0.2]\n\n# speed\nmax_speed_m_s: 0.1\n"
        "area: [[0, 0], [2, 0], [2, 1]]\n"
    )
    for _ in range(2):  # and again over its own result
        file.write_text(with_mounting(file.read_text(), TRUE, "").text)
        settings = read_robot(file).settings
        assert np.allclose(inverse(settings.T_body_base), TRUE, atol=1e-5)
        assert settings.max_speed_m_s == 0.1 and settings.area is not None
    assert "# mine\n# camera:\n#   position_m: [0, 0, 0.2]\n" in file.read_text()


@pytest.mark.parametrize(
    ("text", "is_rewritten"),
    [
        ("camera:\n  position_m: [0, 0, 0.2]\n# by eye\n  yaw_deg: 2\nmax_speed_m_s: 0.1\n", False),
        ("camera:\n  position_m:\n  - 0\n  - 0\n  - 0.2\nmax_speed_m_s: 0.1\n", False),
        ("T_base_body:\n- [1,0,0,0]\n- [0,1,0,0]\n- [0,0,1,0]\n- [0,0,0,1]\nmax_speed_m_s: 0.1\n", False),
        ('"camera": {position_m: [0, 0, 0.2]}\nmax_speed_m_s: 0.1\n', False),
        ("max_speed_m_s: 0.1\ncamera : {position_m: [0, 0, 0.2]}\n", False),
        ("  camera: {position_m: [0, 0, 0.2]}\n  max_speed_m_s: 0.1\n", False),
        ("camera: {position_m: [0, 0, 0.2],\nyaw_deg: 0}\nmax_speed_m_s: 0.1\n", False),
        ("max_speed_m_s: 0.1\ncamera: {position_m: [0, 0, 0.2]}\n...\n", False),
        ("max_speed_m_s: 0.1\ncamera:\n  position_m: [0, 0, 0.2]", False),
        ("%YAML:1.0\n---\ncamera: {position_m: [0, 0, 0.2]}\nmax_speed_m_s: 0.1\n", False),
        ("camera:\r\n  position_m: [0, 0, 0.2]\r\nmax_speed_m_s: 0.1\r\n", False),
        ("{camera: {position_m: [0, 0, 0.2]}, max_speed_m_s: 0.1}\n", True),
        ('{\n  "camera": {"position_m": [0, 0, 0.2]},\n  "max_speed_m_s": 0.1\n}\n', True),
        ("? camera\n: position_m: &p [0, 0, 0.2]\nmax_speed_m_s: 0.1\n", False),
        ("<<: {camera: {position_m: [0, 0, 0.2]}}\nmax_speed_m_s: 0.1\n", True),
    ],
)
def test_every_form_of_the_file_is_read_afterwards(tmp_path: Path, text: str, is_rewritten: bool) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text(text, newline="")
    read_robot(file)
    for is_other_form in (is_rewritten, False):
        written = with_mounting(read_yaml_text(file), TRUE, "")
        file.write_text(written.text)
        settings = read_robot(file).settings
        assert np.allclose(inverse(settings.T_body_base), TRUE, atol=1e-5) and settings.max_speed_m_s == 0.1
        assert written.is_rewritten == is_other_form
    assert all(line.strip() in file.read_text() for line in text.splitlines())


def test_a_mounting_that_cannot_be_written_is_told() -> None:
    with pytest.raises(ConfigError, match="expected keys and values"):
        with_mounting("- 1\n", TRUE, "robot.yaml")
    assert np.allclose(yaml.safe_load(mounting_line(TRUE))["T_base_body"], TRUE, atol=1e-6)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("metres", [1e154, 1e308])
def test_a_fit_that_is_no_number_is_refused(drive: MountingDrive, metres: float) -> None:
    wheels = drive.wheels.copy()
    wheels[600, :2] = metres, -metres
    with pytest.raises(DataError, match=r"values of no robot|known to"):
        find_mounting(replace(drive, wheels=wheels))


@pytest.mark.long
def test_what_comes_live_is_recorded(drive: MountingDrive) -> None:
    """Poses as the agent sends them and odometry by another clock, 8 to 30 ms on the way."""
    recorder, messages = DriveRecorder(None), PoseMessages("bot")
    rng, events = np.random.default_rng(5), []
    for time_ns, T in zip(drive.pose_ns, drive.T_odom_body, strict=True):
        pose = Pose(int(time_ns), TrackState.OK, T, None, None, age_ms=40.0)
        event = parse_pose_message(messages.of_pose(pose).encode())
        events.append((int(time_ns) + 40_000_000, event))
    for time_ns, (x, y, yaw) in zip(drive.wheel_ns, drive.wheels, strict=True):
        event = ev.OdometryReceived(int(time_ns) + 77 * SECOND, 0, PlanarPose(x, y, yaw), 0.2)
        events.append((int(time_ns) + int(rng.uniform(8e6, 30e6)), event))
    for now_ns, event in sorted(events, key=lambda one: one[0]):
        recorder.add(event, now_ns)
    x, y, turned = error(find_mounting(recorder.drive(), 0.21).T_base_body)
    assert abs(x) < 0.004 and abs(y) < 0.004 and turned < 0.2
    assert "m; drive in eights" in recorder.text


def test_the_command_without_an_agent_changes_nothing(tmp_path: Path) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text("camera: {position_m: [0, 0, 0.21]}\n")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        poses = f"udp://127.0.0.1:{free.getsockname()[1]}"
    words = ["--robot", str(file), "--poses", poses, "--node", "tcp://127.0.0.1:0", "--seconds", "0.1"]
    result = CliRunner().invoke(cli, ["robot", "calibrate", *words])
    assert isinstance(result.exception, DataError) and "no poses came" in str(result.exception)
    assert file.read_text() == "camera: {position_m: [0, 0, 0.21]}\n"
