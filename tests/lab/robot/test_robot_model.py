"""The parts of a simulated robot: drive, true path, IMU, planner, navigator, goals."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.robot_loop import START, empty_room

from share.errors import UsageError
from share.geometry import se3
from share.lab.emulate.motion.route import Floor
from share.lab.emulate.sensor.device import EmulatedDevice
from share.lab.emulate.types import GRAVITY, START_NS
from share.lab.robot.base import RobotBase, is_person_ahead
from share.lab.robot.drive import STEP_NS, STEP_S, DifferentialDrive, DriveModel
from share.lab.robot.faults import LoopFault, parse_fault
from share.lab.robot.goals import drawn_goals, read_goals, start_pose
from share.lab.robot.navigator import CmdVel, Navigator
from share.lab.robot.planner import Costmap, RoomGrid
from share.robot.planar import PlanarPose
from share.robot.robot_events import GoalStatus
from share.robot.robot_file import T_base_of_camera
from share.sensors.profile import load_profile

PERFECT = DriveModel(diameter_error=0.0, wheel_base_error=0.0, slip=0.0)
NOBODY = np.zeros((0, 2))
GOAL_ID = b"g" * 16


def driven(model: DriveModel, seconds: float, speed: float, turn: float, seed: int = 0) -> DifferentialDrive:
    drive = DifferentialDrive(model, START, np.random.default_rng(seed))
    for k in range(round(seconds / STEP_S)):
        if k % 20 == 0:
            drive.command(k * STEP_NS, speed, turn)
        drive.step()
    return drive


# ---------------------------------------------------------------- the drive


def test_a_base_without_errors_is_where_its_wheels_say() -> None:
    drive = driven(PERFECT, 10.0, 0.2, 0.3)
    true, by_wheels = drive.last.T_world_base, START @ drive.last.T_odom_base
    assert true.distance_m(by_wheels) < 1e-9
    assert drive.last.speed_m_s == pytest.approx(0.2, abs=1e-3)
    assert drive.last.T_odom_base.yaw == pytest.approx(
        0.3 * (10.0 - 0.06 - 0.08) - 0.06, abs=0.02
    )  # less the ramp


def test_a_base_keeps_to_its_limits_of_speed_and_acceleration() -> None:
    drive = DifferentialDrive(PERFECT, START, np.random.default_rng(0))
    drive.command(0, 5.0, 0.0)
    speeds = [drive.step().speed_m_s for _ in range(90)]
    assert max(speeds) <= 0.306 + 1e-9
    assert max(np.diff(speeds)) / STEP_S <= 0.9 + 1e-6
    assert all(speed == 0.0 for speed in speeds[: round(0.06 / STEP_S) - 1])  # latency


def test_a_base_stops_when_commands_stop() -> None:
    drive = driven(PERFECT, 2.0, 0.3, 0.0)
    for _ in range(round(1.6 / STEP_S)):
        drive.step()
    assert abs(drive.last.speed_m_s) < 1e-3


@pytest.mark.slow
def test_wheels_drift_by_their_errors_and_each_robot_has_its_own() -> None:
    """10 m: some 0.5 % of unequal diameters and 2 % of slip that averages out."""
    ends = []
    for seed in range(12):
        drive = driven(DriveModel(), 35.0, 0.3, 0.0, seed)
        ends.append(drive.last.T_world_base.distance_m(START @ drive.last.T_odom_base))
    assert 0.1 < np.median(ends) < 1.5 and np.std(ends) > 0.05
    again = driven(DriveModel(), 35.0, 0.3, 0.0, 0)
    assert again.last.T_world_base.distance_m(START @ again.last.T_odom_base) == ends[0]


# ---------------------------------------------------------------- the true path


def base(seconds: float = 6.0) -> RobotBase:
    T = T_base_of_camera((0.09, 0.018, 0.21))
    return RobotBase(DriveModel(), empty_room(), START, T, seconds, np.random.default_rng(2))


def drive_on(robot: RobotBase, seconds: float) -> None:
    for k in range(round(seconds / 0.05)):
        robot.command(k * 50_000_000, 0.25, 0.4)


def test_pieces_of_the_path_agree_and_follow_the_base() -> None:
    robot = base()
    drive_on(robot, 4.0)
    body = robot.body
    stamps = np.array([2_003_000_000]) + START_NS
    long, short = body.part(500_000_000, 3_500_000_000), body.part(2_003_000_000, 2_003_000_000)
    np.testing.assert_allclose(long.poses(stamps), short.poses(stamps), atol=1e-12)
    for one, other in zip(long.inertial(stamps), short.inertial(stamps), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-7)
    T = robot.steps[2_000_000_000 // STEP_NS].T_world_base @ PlanarPose(0.09, 0.018, 0.0)
    p = body.part(2_000_000_000, 2_000_000_000).poses(np.array([2_000_000_000 + START_NS]))[0, :3, 3]
    assert np.linalg.norm(p - (T.x, T.y, 0.21)) < 2e-3  # the floor shakes it


def test_a_standing_imu_feels_gravity_and_a_turning_one_its_turn() -> None:
    robot = base()
    robot.advance(1_000_000_000)
    gyro, force = robot.body.part(0, 500_000_000).inertial(np.arange(0, 500_000_000, 5_000_000) + START_NS)
    assert np.abs(gyro).max() < 0.02
    np.testing.assert_allclose(force.mean(axis=0), (0.0, -GRAVITY, 0.0), atol=0.05)  # y is down
    robot = base()
    for k in range(60):
        robot.command(k * 50_000_000, 0.0, 0.5)
    gyro, _ = robot.body.part(1_500_000_000, 2_500_000_000).inertial(
        np.arange(1_500_000_000, 2_500_000_000, 5_000_000) + START_NS
    )
    assert gyro.mean(axis=0)[1] == pytest.approx(-0.5, abs=0.03)


def test_the_path_is_not_known_ahead_of_the_commands() -> None:
    robot = base()
    robot.advance(1_000_000_000)
    with pytest.raises(ValueError, match="is known until"):
        robot.body.part(1_000_000_000, 1_500_000_000)


def test_imu_samples_of_pieces_are_those_of_the_whole() -> None:
    robot = base()
    drive_on(robot, 3.0)
    device = EmulatedDevice(load_profile("d435i"), None, (3,), START_NS)
    whole = device.imu_streams(robot.body.part(0, 2_500_000_000))
    errors = device.imu_errors(10.0)
    part = device.imu_streams(robot.body.part(1_000_000_000, 1_200_000_000), errors)
    rows = np.searchsorted(whole.gyro_ns, part.gyro_ns)
    np.testing.assert_array_equal(whole.gyro_ns[rows], part.gyro_ns)
    np.testing.assert_allclose(whole.gyro[rows], part.gyro, atol=6e-4)  # a digit
    rows = np.searchsorted(whole.accel_ns, part.accel_ns)
    np.testing.assert_allclose(whole.accel[rows], part.accel, atol=0.02)


def test_a_bumped_base_stands() -> None:
    robot = base(25.0)
    for k in range(round(24.0 / 0.05)):
        robot.command(k * 50_000_000, 0.3, 0.0)
    here = robot.at(24_000_000_000)
    assert robot.bumps >= 1
    assert 7.75 < here.T_world_base.x < 7.90  # the wall is at 8 m, its radius 0.17


# ---------------------------------------------------------------- planner and navigator


def walled() -> RoomGrid:
    """The empty room with a wall from y 0 to 4.5 m at x 4 m."""
    floor = empty_room().floor
    x, y = (floor.origin + floor.step * np.arange(n) for n in floor.clearance.shape)
    beside = np.hypot(np.abs(x - 4.0)[:, None], (y - 4.5).clip(0)[None, :])
    return RoomGrid(replace(floor, clearance=np.minimum(floor.clearance, beside)))


def test_a_way_leads_round_a_wall_and_none_through_it() -> None:
    grid, here = walled(), PlanarPose(2.0, 2.0, 0.7)
    way = Costmap(grid, here.inverse(), NOBODY).plan(here, PlanarPose(6.0, 2.0, 0.0))
    assert way is not None
    assert way[:, 1].max() > 4.5 and grid.floor.clearance_at(way).min() > 0.15
    closed = replace(
        grid.floor,
        clearance=np.minimum(
            grid.floor.clearance, np.abs(grid.floor.origin + grid.floor.step * np.arange(80) - 4.0)[:, None]
        ),
    )
    assert Costmap(RoomGrid(closed), here.inverse(), NOBODY).plan(here, PlanarPose(6.0, 2.0, 0.0)) is None


def test_a_way_leads_round_people() -> None:
    here = PlanarPose(2.0, 3.0, 0.0)
    people = np.array([[4.0, 3.0]])
    way = Costmap(empty_room(), here.inverse(), people).plan(here, PlanarPose(6.0, 3.0, 0.0))
    assert way is not None and np.linalg.norm(way - people[0], axis=1).min() > 0.58


def test_a_plan_is_in_the_map_in_which_the_robot_believes_to_be() -> None:
    T_map_room = PlanarPose(3.0, -1.0, 1.2)
    here, goal = PlanarPose(2.0, 3.0, 0.5), PlanarPose(6.0, 3.0, 0.0)
    way = Costmap(empty_room(), here.inverse(), NOBODY).plan(T_map_room @ here, T_map_room @ goal)
    assert way is not None
    end = T_map_room @ goal
    np.testing.assert_allclose(way[-1], (end.x, end.y), atol=1e-9)


class NavigatedRobot:
    """A point robot that does what the navigator commands."""

    def __init__(self) -> None:
        self.navigator, self.pose, self.now_ns = Navigator(), PlanarPose(2.0, 2.0, 0.0), 0
        self.is_placed = True
        self.navigator.take_costmap(Costmap(empty_room(), self.pose.inverse(), NOBODY))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.05)):
            self.now_ns += 50_000_000
            self.navigator.take_odometry(self.pose)
            self.navigator.take_costmap(Costmap(empty_room(), self.pose.inverse(), NOBODY))
            if self.is_placed:
                self.navigator.take_map_odom(self.now_ns + 300_000_000, PlanarPose(0.0, 0.0, 0.0))
            self.command = self.navigator.tick(self.now_ns)
            if self.command is not None:
                step = self.command.speed_m_s * 0.05, self.command.turn_rad_s * 0.05
                self.pose = self.pose @ PlanarPose(step[0], 0.0, step[1])

    @property
    def status(self) -> GoalStatus:
        return self.navigator.statuses[GOAL_ID]


def test_a_navigator_arrives_within_its_tolerances() -> None:
    robot, goal = NavigatedRobot(), PlanarPose(5.0, 4.0, -2.0)
    robot.navigator.take_goal(GOAL_ID, goal)
    robot.run(30.0)
    assert robot.status is GoalStatus.SUCCEEDED
    assert robot.pose.distance_m(goal) <= 0.25 and abs(robot.pose.yaw - goal.yaw) <= 0.25 + 0.05
    assert robot.command is None


def test_a_navigator_keeps_to_the_speed_limit() -> None:
    robot = NavigatedRobot()
    robot.navigator.limit_speed(0.12)
    robot.navigator.take_goal(GOAL_ID, PlanarPose(5.0, 2.0, 0.0))
    robot.run(3.0)
    assert robot.command is not None and robot.command.speed_m_s == pytest.approx(0.12, abs=0.005)


def test_a_navigator_without_transform_stands_and_aborts() -> None:
    robot = NavigatedRobot()
    robot.navigator.take_goal(GOAL_ID, PlanarPose(5.0, 2.0, 0.0))
    robot.run(2.0)
    robot.is_placed = False
    robot.run(0.4)
    assert robot.status is GoalStatus.EXECUTING  # the last one is still valid, or bearably old
    robot.run(0.2)
    assert robot.command == CmdVel(0.0, 0.0)
    robot.run(0.4)
    assert robot.status is GoalStatus.ABORTED and robot.navigator.abort_code == 102


def test_a_navigator_gives_up_where_there_is_no_way() -> None:
    robot = NavigatedRobot()
    robot.navigator.take_goal(GOAL_ID, PlanarPose(20.0, 2.0, 0.0))
    robot.run(11.0)
    assert robot.status is GoalStatus.ABORTED and robot.navigator.abort_code == 203


def test_a_newer_goal_preempts_and_a_cancelled_one_ends() -> None:
    robot = NavigatedRobot()
    robot.navigator.take_goal(b"o" * 16, PlanarPose(5.0, 2.0, 0.0))
    robot.navigator.take_goal(GOAL_ID, PlanarPose(2.0, 5.0, 0.0))
    assert robot.navigator.statuses[b"o" * 16] is GoalStatus.ABORTED
    robot.navigator.cancel(b"o" * 16)
    assert robot.status is GoalStatus.EXECUTING
    robot.navigator.cancel(GOAL_ID)
    assert robot.status is GoalStatus.CANCELED


# ---------------------------------------------------------------- goals, starts, faults


def test_goals_are_two_to_six_metres_off_and_clear() -> None:
    grid = empty_room()
    draw = drawn_goals(grid, np.random.default_rng(0))
    for _ in range(20):
        goal = draw(START)
        assert 1.3 < START.distance_m(goal) <= 6.0 and grid.clearance(goal) >= 0.4


def test_a_room_too_small_for_a_goal_is_refused() -> None:
    tiny = RoomGrid(Floor(np.full((10, 10), 0.5), 0.1))
    with pytest.raises(UsageError, match="no free place 2 to 6 m"):
        drawn_goals(tiny, np.random.default_rng(0))(PlanarPose(0.5, 0.5, 0.0))


def test_a_robot_starts_clear_of_walls_and_people() -> None:
    grid, people = empty_room(), np.array([[4.0, 3.0]])
    for seed in range(10):
        pose = start_pose(grid, people, np.random.default_rng(seed))
        assert grid.clearance(pose) >= 0.4 and math.hypot(pose.x - 4.0, pose.y - 3.0) > 1.0


def test_goals_are_read_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / "goals.txt"
    file.write_text("# kitchen\n1.5 2\n\n3 -1.25 90  # door\n")
    first, second = read_goals(file)
    assert (first.x, first.y, first.yaw) == (1.5, 2.0, 0.0)
    assert (second.x, second.y) == (3.0, -1.25) and second.yaw == pytest.approx(math.pi / 2)


@pytest.mark.parametrize("text", ["1.5\n", "1 2 3 4\n", "a b\n", "nan 1\n"])
def test_a_bad_line_of_a_goals_file_is_named(tmp_path: Path, text: str) -> None:
    file = tmp_path / "goals.txt"
    file.write_text("0 0\n" + text)
    with pytest.raises(UsageError, match="line 2: expected X Y"):
        read_goals(file)


def test_faults_are_parsed() -> None:
    assert parse_fault("edge@20:5") == LoopFault("edge", 20.0, 5.0)
    assert parse_fault("bare-wall@7.5") == LoopFault("bare-wall", 7.5, 3.0)
    for bad in ("edge", "edge@", "fire@3", "edge@-1"):
        with pytest.raises(UsageError, match="kinds: edge, agent"):
            parse_fault(bad)


def test_poses_of_a_body_are_rigid() -> None:
    robot = base()
    drive_on(robot, 2.0)
    T = robot.body.part(0, 1_500_000_000).poses(np.arange(0, 1_500_000_000, 50_000_000) + START_NS)
    np.testing.assert_allclose(
        T[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2), np.eye(3)[None] + 0 * T[:, :3, :3], atol=1e-12
    )
    assert se3.rotation_angle(se3.inverse(T[0])[None] @ T[-1:])[0] > 0.3


def test_a_plan_round_a_person_is_not_stopped_by_that_person() -> None:
    """Else a robot would wait for ever before one who stands."""
    here, person = PlanarPose(2.0, 3.0, 0.0), np.array([[4.0, 3.0]])
    way = Costmap(empty_room(), here.inverse(), person).plan(here, PlanarPose(6.0, 3.0, 0.0))
    assert way is not None
    steps = np.diff(way, axis=0)
    yaws = np.arctan2(steps[:, 1], steps[:, 0])
    poses = [PlanarPose(x, y, yaw) for (x, y), yaw in zip(way.tolist(), yaws.tolist(), strict=False)]
    assert not any(is_person_ahead(pose, person) for pose in poses)
    assert is_person_ahead(PlanarPose(3.5, 3.0, 0.0), person)
    assert not is_person_ahead(PlanarPose(3.5, 3.0, math.pi), person)
