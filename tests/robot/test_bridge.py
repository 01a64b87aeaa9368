"""The robot bridge: map → odom at the pose's own time, and what stops the robot."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.robot_drive import SECOND, UNIX_NS, RobotDrive, solid

from share.geometry.se3 import from_rt, so3_exp
from share.protocol.common_events import PrintLine
from share.robot import robot_events as ev
from share.robot.bridge import LEAD_S
from share.robot.planar import PlanarPose, flattened
from share.robot.settings import DrivingArea, RobotSettings
from share.robot.wire_commands import robot_place
from share.runtime.robot_drive import DriveRecorder
from share.types import TrackState


@pytest.fixture
def drive() -> RobotDrive:
    drive = RobotDrive()
    drive.run(1.0)
    return drive


def under_way(drive: RobotDrive, **more: object) -> bytes:
    """Send a goal, and let the robot execute it."""
    goal_id = drive.goto(**more)
    drive.goals = [(goal_id, ev.GoalStatus.EXECUTING)]
    drive.run(0.2)
    return goal_id


def stopped_for(drive: RobotDrive, text: str) -> bool:
    reports = [report.text for report in drive.of(ev.GoalReport)]
    return bool(drive.of(ev.CancelGoal)) and any(
        one.startswith("stopping: ") and text in one for one in reports
    )


# ------------------------------------------------------------ map → odom


@pytest.mark.parametrize("ahead_ns", [0, 37_000_000, -400_000_000])
def test_map_odom_is_that_of_the_poses_own_time(ahead_ns: int) -> None:
    drive = RobotDrive(ahead_ns=ahead_ns)
    published = [e for e in drive.run(5.0) if isinstance(e, ev.PublishMapOdom)]
    errors = [one.T_map_odom.distance_m(drive.T_map_odom) for one in published]
    # what is left: the quickest odometry was 8 ms old, and the robot turns 0.2 rad/s at 0.2 m/s
    assert max(errors) < 0.003
    assert all(abs(one.T_map_odom.yaw - drive.T_map_odom.yaw) < 0.003 for one in published)


def test_map_odom_is_published_often_with_stamps_ahead(drive: RobotDrive) -> None:
    published = [e for e in drive.run(2.0) if isinstance(e, ev.PublishMapOdom)]
    assert len(published) >= 2 * 40
    stamps = np.array([one.stamp_ns for one in published])
    assert (np.diff(stamps) > 0).all()
    robot_ns = drive.now_ns + UNIX_NS + drive.ahead_ns
    assert LEAD_S - 0.03 < (stamps[-1] - robot_ns) / 1e9 <= LEAD_S


def test_height_and_tilt_are_left_out() -> None:
    tilt = from_rt(so3_exp(np.array([0.0, 0.3, 0.0])), np.zeros(3))  # nose down: the heading stays
    planar = flattened(solid(PlanarPose(1.0, -2.0, 2.5), z=0.3) @ tilt)
    assert (planar.x, planar.y, planar.yaw) == pytest.approx((1.0, -2.0, 2.5))


def test_a_late_datagram_is_ignored_and_an_agent_begun_anew_is_not(drive: RobotDrive) -> None:
    before = drive.bridge.report(drive.now_ns)["pose"]
    far = solid(PlanarPose(50.0, 50.0, 0.0))
    drive.handle(drive.pose(sequence=drive.sequence - 5, T_map_body=far))
    drive.is_tracked = False
    drive.run(0.1)
    assert np.hypot(*np.subtract(drive.bridge.report(drive.now_ns)["pose"], before)[:2]) < 0.1
    drive.sequence, drive.is_tracked = -1, True
    drive.sequence -= 500
    assert not [e for e in drive.run(1.0) if isinstance(e, PrintLine)]


def test_poses_of_another_agent_move_nothing(drive: RobotDrive) -> None:
    drive.handle(drive.pose(agent="eve", T_map_body=solid(PlanarPose(50.0, 50.0, 0.0))))
    assert not drive.of(ev.GoalReport)
    drive.run(0.1)
    x, y, _ = drive.bridge.report(drive.now_ns)["pose"]
    assert math.hypot(x, y) < 5


# ------------------------------------------------------------ what stops


def _lose(drive: RobotDrive) -> None:
    drive.state = TrackState.LOST


def _silence_agent(drive: RobotDrive) -> None:
    drive.is_tracked = False


def _silence_robot(drive: RobotDrive) -> None:
    drive.is_driven = False


def _make_unsure(drive: RobotDrive) -> None:
    drive.sigma_m = 0.3


def _forget_sigma(drive: RobotDrive) -> None:
    drive.sigma_m = None


def _start_amcl(drive: RobotDrive) -> None:
    drive.handle(ev.ForeignMapFrame("map"))


def _break_odometry(drive: RobotDrive) -> None:
    drive.T_odom_base = lambda now_ns: PlanarPose(math.nan, 0.0, 0.0)


def _set_clock(drive: RobotDrive) -> None:
    drive.ahead_ns = -90 * SECOND


def _simulate_clock(drive: RobotDrive) -> None:
    drive.ahead_ns = -UNIX_NS


def _second_robot(drive: RobotDrive) -> None:
    drive.handle(ev.RobotDiscovered(1, 2))


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        (_lose, "lost tracking"),
        (_silence_agent, "no pose for 0.5 s"),
        (_silence_robot, "no odometry for 0.5 s"),
        (_make_unsure, "sigma exceeds 0.1 m"),
        (_forget_sigma, "sends no covariance"),
        (_start_amcl, "another program publishes map → odom"),
        (_break_odometry, "not finite"),
        (_set_clock, "more than 1 s behind"),
        (_simulate_clock, "use_sim_time"),
        (_second_robot, "2 robots"),
    ],
)
def test_without_a_place_the_robot_stops_and_tf_too(drive: RobotDrive, fault, text: str) -> None:
    under_way(drive)
    fault(drive)
    drive.run(0.7)
    assert stopped_for(drive, text)
    lines = [line.text for line in drive.of(PrintLine) if text in line.text]
    assert len(lines) == 2  # the robot is stopped, and there is no map → odom; each once
    assert not [e for e in drive.run(0.5) if isinstance(e, ev.PublishMapOdom)]
    drive.goals = []
    drive.goto()
    assert drive.last_report.is_final and "refused" in drive.last_report.text


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({"T_odom_base": PlanarPose(1.7e308, -1.7e308, -0.48)}, "more than 100 km off"),
        ({"T_odom_base": PlanarPose(1e154, 0.0, 0.0)}, "more than 100 km off"),
        ({"T_odom_base": PlanarPose(0.0, 0.0, -1.7e308)}, "yaw of more than 1e+06 rad"),
        ({"speed_m_s": math.nan}, "not finite"),
        ({"speed_m_s": -1e300}, "more than 100 km off"),
        ({"stamp_ns": 10**40}, "a time of no clock"),
        ({"stamp_ns": -(10**40)}, "a time of no clock"),
    ],
)
def test_odometry_that_no_robot_has_stops_it(drive: RobotDrive, changed: dict[str, Any], text: str) -> None:
    under_way(drive)
    drive.is_driven = False
    wrong = replace(drive.odometry(), **changed)
    recorder = DriveRecorder(None)
    recorder.add(wrong, drive.now_ns)
    assert ", 0 of odometry," in recorder.text  # nor is it for a calibration
    drive.handle(wrong)
    drive.run(0.1)
    assert stopped_for(drive, text)
    place = robot_place(drive.bridge.report(drive.now_ns))
    assert place.map_id is None
    drive.is_driven = True
    drive.run(1.0)
    assert drive.bridge.report(drive.now_ns)["fault"] is None


def test_what_comes_back_is_published_again_but_no_goal_goes_on(drive: RobotDrive) -> None:
    goal_id = under_way(drive)
    drive.state = TrackState.LOST
    drive.run(0.3)
    drive.goals = [(goal_id, ev.GoalStatus.CANCELED)]
    drive.state = TrackState.OK
    drive.run(0.5)
    assert drive.last_report == ev.GoalReport(
        "ann", "stopped: bot has lost tracking (LOST)", is_final=True, goal_id=drive.last_report.goal_id
    )
    assert [e for e in drive.run(0.5) if isinstance(e, ev.PublishMapOdom)]
    assert len(drive.of(ev.SendGoal)) == 1


def test_a_join_of_maps_cancels_the_goal(drive: RobotDrive) -> None:
    under_way(drive)
    drive.map_id, drive.T_map_odom = "eve-2/0", PlanarPose(12.0, 3.0, -1.0)
    drive.run(0.2)
    assert stopped_for(drive, "the map is now eve-2/0, before ann-1/0")


def test_a_correction_that_moves_the_map_far_cancels_a_small_one_does_not(drive: RobotDrive) -> None:
    under_way(drive)
    drive.T_map_odom = PlanarPose(2.1, -1.0, 0.7)
    drive.run(0.5)
    assert not drive.of(ev.CancelGoal)
    drive.T_map_odom = PlanarPose(3.1, -1.0, 0.7)
    drive.run(0.2)
    assert stopped_for(drive, "a correction moved the map by")


def test_odometry_that_begins_anew_stops_the_robot_until_the_next_pose(drive: RobotDrive) -> None:
    under_way(drive)
    drive.T_odom_base = lambda now_ns: PlanarPose(0.0, 0.0, 0.0)
    drive.is_tracked = False
    drive.run(0.2)
    assert stopped_for(drive, "no odometry at the time of the pose")


def test_a_late_sample_of_odometry_is_ignored(drive: RobotDrive) -> None:
    late = drive.odometry()
    drive.run(0.2)
    drive.effects.clear()
    drive.handle(late)
    assert drive.bridge.report(drive.now_ns)["fault"] is None


def test_dead_man_the_edge_is_gone(drive: RobotDrive) -> None:
    under_way(drive)
    drive.has_edge = False
    drive.run(4.5)
    assert not drive.of(ev.CancelGoal)
    drive.run(1.0)
    assert stopped_for(drive, "received nothing from its edge for 5 s")
    assert [e for e in drive.run(0.5) if isinstance(e, ev.PublishMapOdom)]  # odometry goes on


def test_dead_man_the_commander_is_gone(drive: RobotDrive) -> None:
    under_way(drive)
    drive.handle(ev.CommanderLost("bob"))
    assert not drive.of(ev.CancelGoal)
    drive.handle(ev.CommanderLost("ann"))
    assert stopped_for(drive, "the link to ann is gone")


def test_too_fast_for_half_a_second_stops(drive: RobotDrive) -> None:
    under_way(drive)
    assert ev.LimitSpeed(0.2) in drive.effects
    drive.speed_m_s = 0.3
    drive.run(0.3)
    assert not drive.of(ev.CancelGoal)
    drive.run(0.5)
    assert stopped_for(drive, "0.30 m/s, 0.2 are allowed")


def test_a_stopped_goal_that_the_robot_never_got_ends(drive: RobotDrive) -> None:
    drive.goto()
    drive.state = TrackState.LOST
    drive.run(0.2)
    drive.handle(ev.StatusReceived(()))
    drive.run(1.0)
    assert not drive.last_report.is_final  # it may be on its way
    drive.run(4.2)
    assert drive.last_report.is_final and drive.last_report.text == (
        "stopped: bot has lost tracking (LOST); the robot's navigation never took the goal"
    )


# ------------------------------------------------------------ which goals are taken


def test_no_goal_without_permission() -> None:
    drive = RobotDrive(RobotSettings())
    drive.run(1.0)
    drive.goto()
    assert not drive.of(ev.SendGoal)
    assert "--allow-goals" in drive.last_report.text


@pytest.mark.parametrize(
    ("robot", "text"),
    [
        (ev.RobotDiscovered(0, 1), "is Nav2 running"),
        (ev.RobotDiscovered(0, 1, ("tb2",)), "--namespace tb2"),
        (ev.RobotDiscovered(2, 1), "2 robots answer"),
        (ev.RobotDiscovered(1, 1, is_fast_dds=False), "rmw_fastrtps_cpp"),
        (ev.RobotDiscovered(0, 0, has_participants=False), "simple discovery"),
    ],
)
def test_no_goal_without_one_robot(drive: RobotDrive, robot: ev.RobotDiscovered, text: str) -> None:
    drive.handle(robot)
    drive.goto()
    assert not drive.of(ev.SendGoal)
    assert text in drive.last_report.text


@pytest.mark.parametrize("more", [{"x": math.nan}, {"y": math.inf}, {"yaw": math.nan}, {"map_id": "eve-2/0"}])
def test_no_goal_that_means_no_place(drive: RobotDrive, more: dict) -> None:
    drive.goto(**more)
    assert not drive.of(ev.SendGoal)
    assert drive.last_report.is_final


def test_area() -> None:
    corners = ((-1.0, -3.0), (5.0, -3.0), (5.0, 3.0), (2.0, 0.5), (-1.0, 3.0))
    drive = RobotDrive(RobotSettings(allow_goals=True, area=DrivingArea(corners)))
    drive.run(1.0)
    drive.goto(2.0, 1.0)  # in the notch
    assert "the goal (x 2.00 y 1.00 m) is outside the area" in drive.last_report.text
    under_way(drive, x=3.0, y=0.0)
    assert drive.of(ev.SendGoal) and not drive.of(ev.CancelGoal)
    drive.T_map_odom = PlanarPose(2.0, -1.4, 0.7)
    for _ in range(60):  # creeps out
        drive.T_map_odom = PlanarPose(drive.T_map_odom.x - 0.06, -1.4, 0.7)
        drive.run(0.05)
    assert stopped_for(drive, "the robot (x ")


def test_area_of_another_map_is_none() -> None:
    area = DrivingArea(((-9.0, -9.0), (9.0, -9.0), (0.0, 9.0)), map_id="old-1/0")
    drive = RobotDrive(RobotSettings(allow_goals=True, area=area))
    drive.run(1.0)
    drive.goto()
    assert "draw it anew" in drive.last_report.text


def test_heading_of_a_goal_without_one_is_the_way_there(drive: RobotDrive) -> None:
    x, y, _ = drive.bridge.report(drive.now_ns)["pose"]
    drive.goto(x, y - 2)
    (sent,) = drive.of(ev.SendGoal)
    assert sent.T_map_base.yaw == pytest.approx(-math.pi / 2, abs=0.05)


# ------------------------------------------------------------ the robot's word


def test_a_goal_from_sent_to_reached(drive: RobotDrive) -> None:
    goal_id = drive.goto()
    drive.goals = [(b"x" * 16, ev.GoalStatus.SUCCEEDED), (goal_id, ev.GoalStatus.ACCEPTED)]
    drive.run(0.2)
    drive.goals[1] = (goal_id, ev.GoalStatus.EXECUTING)
    drive.run(0.2)
    drive.handle(ev.FeedbackReceived(goal_id, 0.75))
    drive.handle(ev.FeedbackReceived(b"y" * 16, 9.0))
    drive.goals[1] = (goal_id, ev.GoalStatus.SUCCEEDED)
    drive.run(0.2)
    texts = [report.text for report in drive.of(ev.GoalReport)]
    assert texts == ["sent to the robot: x 3.00 y 0.00 m", "accepted", "executing", "0.75 m to go", "reached"]
    assert drive.last_report.is_reached and not drive.of(ev.CancelGoal)


def test_a_refusal_counts_unless_the_status_contradicts_it(drive: RobotDrive) -> None:
    goal_id = drive.goto()
    drive.handle(ev.GoalAnswered(is_accepted=False))  # of an earlier goal, seconds late
    drive.goals = [(goal_id, ev.GoalStatus.EXECUTING)]
    drive.run(1.0)
    assert not drive.last_report.is_final
    drive.goals = []
    drive.handle(ev.StatusReceived(((goal_id, ev.GoalStatus.CANCELED),)))
    drive.goto()
    drive.handle(ev.GoalAnswered(is_accepted=False))
    drive.run(1.0)
    assert drive.last_report.is_final and "refuses" in drive.last_report.text


def test_no_answer_is_an_end_and_a_late_start_is_cancelled(drive: RobotDrive) -> None:
    goal_id = drive.goto()
    drive.run(5.5)
    assert drive.last_report.is_final and "no answer" in drive.last_report.text
    drive.effects.clear()
    drive.goals = [(goal_id, ev.GoalStatus.EXECUTING)]
    drive.run(0.3)
    assert drive.of(ev.CancelGoal) == [ev.CancelGoal(goal_id)]


def test_a_cancellation_is_repeated_until_the_robot_confirms_it(drive: RobotDrive) -> None:
    goal_id = under_way(drive)
    drive.handle(ev.CancelRequested("bob"))
    drive.run(4.0)
    assert 6 <= len(drive.of(ev.CancelGoal)) <= 9
    assert drive.last_report.text == "the robot does not confirm that it stops; stop it by hand"
    drive.goals = [(goal_id, ev.GoalStatus.CANCELED)]
    drive.run(0.2)
    assert drive.last_report == ev.GoalReport(
        "ann", "stopped: cancelled by bob", is_final=True, goal_id=drive.last_report.goal_id
    )


@pytest.mark.parametrize("has_reason", [True, False])
def test_a_goal_that_fails_says_why(drive: RobotDrive, has_reason: bool) -> None:
    goal_id = under_way(drive)
    drive.goals = [(goal_id, ev.GoalStatus.ABORTED)]
    drive.run(0.2)
    assert drive.of(ev.AskResult) == [ev.AskResult(goal_id)]
    if has_reason:
        drive.handle(ev.ResultReceived(9002, "no transform"))
    drive.run(1.5)
    text = "Nav2's error 9002, no transform" if has_reason else "without a reason"
    assert drive.last_report.is_final and text in drive.last_report.text


def test_two_commanders(drive: RobotDrive) -> None:
    under_way(drive, commander="ann")
    drive.goto(commander="bob")
    assert drive.last_report.commander == "bob" and "ann is sending the robot" in drive.last_report.text
    drive.goto(x=2.5, commander="ann")  # its own may be replaced
    assert len(drive.of(ev.SendGoal)) == 2


def test_another_programs_goal_is_left_alone(drive: RobotDrive) -> None:
    drive.goals = [(b"r" * 16, ev.GoalStatus.EXECUTING)]
    drive.run(0.2)
    drive.goto()
    assert not drive.of(ev.SendGoal) and not drive.of(ev.CancelGoal)
    assert "another program" in drive.last_report.text


def test_a_goal_of_a_bridge_that_died_is_cancelled() -> None:
    drive = RobotDrive()
    orphan = b"SHARE\x00\x00\x01" + b"z" * 8
    drive.goals = [(orphan, ev.GoalStatus.EXECUTING)]
    drive.run(1.0)
    assert ev.CancelGoal(orphan) in drive.effects


def test_navigation_that_was_restarted_has_no_goal(drive: RobotDrive) -> None:
    under_way(drive)
    drive.handle(ev.StatusReceived(()))
    assert drive.last_report.is_final and "restarted" in drive.last_report.text


def test_a_goal_that_was_stopped_and_never_taken_ends(drive: RobotDrive) -> None:
    drive.goto()
    drive.handle(ev.CancelRequested("bob"))
    drive.run(6.0)
    assert drive.last_report.text == "stopped: cancelled by bob; the robot's navigation never took the goal"
    assert drive.last_report.is_final
    goal_id = drive.goto(commander="bob")
    assert drive.of(ev.SendGoal)[-1].goal_id == goal_id
