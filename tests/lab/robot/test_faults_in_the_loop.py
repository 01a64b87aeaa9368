"""A robot in the loop, without pictures: it arrives, and stops or goes on when something breaks."""

from __future__ import annotations

from dataclasses import replace

import pytest
from helpers.robot_loop import Drive

from share.lab.robot.faults import RIVAL, LoopFault, schedule_faults
from share.lab.robot.goals import REACHED_M
from share.lab.robot.simulate import usual_robot
from share.robot.planar import PlanarPose
from share.robot.settings import DrivingArea

pytestmark = pytest.mark.long

GOAL, NEAR = PlanarPose(4.0, 3.0, 0.5), PlanarPose(3.2, 2.5, 0.5)
SLOW = replace(usual_robot(), max_speed_m_s=0.15)


def alone(kind: str, seconds: float = 3.0, goals: int = 1, goal: PlanarPose = GOAL) -> Drive:
    """A robot that drives in a map of its own when a fault comes."""
    drive = Drive([goal] * goals, settings=SLOW, has_ann=False)
    drive.run_until(lambda: drive.speed_m_s > 0.1, 5.0)
    schedule_faults(drive.loop, [LoopFault(kind, 0.0, seconds)])
    return drive


def stops(drive: Drive, reason: str, within_s: float) -> None:
    """Expect that the robot stops for a reason and stands."""
    begun_s = drive.loop.now_ns / 1e9
    drive.run_until(
        lambda: any("is stopped" in text and reason in text for text in drive.texts), begun_s + within_s
    )
    drive.run_until(lambda: abs(drive.speed_m_s) < 0.01, begun_s + within_s + 1.0)
    drive.loop.run(drive.loop.now_ns / 1e9 + 1.0)
    assert abs(drive.speed_m_s) < 0.01
    assert not drive.giver.outcomes[0].says_reached


def arrives(drive: Drive) -> None:
    drive.run(40.0)
    [outcome] = drive.giver.outcomes
    assert outcome.is_reached and outcome.attempts == 1, drive.texts


def test_a_robot_arrives_where_a_wearer_points() -> None:
    drive = Drive([GOAL])
    drive.run(60.0)
    [outcome] = drive.giver.outcomes
    assert outcome.is_reached and 0.05 < outcome.error_m <= REACHED_M and outcome.error_rad < 0.35
    assert outcome.map_id is not None and outcome.map_id.startswith("ann-")
    assert drive.base.bumps == 0


@pytest.mark.slow
def test_a_map_that_joins_another_in_mid_drive_stops_the_robot_and_the_goal_is_given_again() -> None:
    drive = Drive([GOAL], ann_s=3.0)
    drive.run_until(lambda: drive.speed_m_s > 0.1, 3.0)
    drive.run(60.0)
    assert any("the map is now ann-" in text and "is stopped" in text for text in drive.texts)
    assert drive.giver.first_goals[0].map_id != drive.giver.outcomes[0].map_id
    assert drive.giver.outcomes[0].is_reached


def test_an_edge_that_is_gone_stops_the_robot() -> None:
    drive = alone("edge", seconds=60.0)
    stops(drive, "has received nothing from its edge for 5 s", within_s=9.0)


@pytest.mark.slow
def test_an_edge_that_comes_back_without_its_map_does_not_stop_a_robot_in_its_own() -> None:
    """The agent sends its keyframes again, of which the same map grows."""
    drive = alone("edge", seconds=1.0)
    arrives(drive)
    assert any("the edge has restarted" in text for text in drive.texts)


@pytest.mark.slow
def test_an_edge_that_comes_back_without_its_map_stops_a_robot_in_a_shared_one() -> None:
    """Its agents are in maps of their own until they join anew."""
    drive = Drive([PlanarPose(6.0, 4.0, 1.0)], settings=SLOW)
    drive.run_until(lambda: bool(drive.giver.outcomes) and drive.speed_m_s > 0.1, 40.0)
    assert str(drive.giver.outcomes[0].map_id).startswith("ann-")
    schedule_faults(drive.loop, [LoopFault("edge", 0.0, 1.0)])
    stops(drive, "the map", within_s=6.0)


def test_three_seconds_without_network_do_not_stop_the_robot() -> None:
    arrives(alone("network", seconds=3.0, goal=NEAR))


@pytest.mark.slow
def test_three_seconds_without_network_do_not_stop_a_robot_in_a_shared_map() -> None:
    """It is where its odometry says in the map that it had, and that is what the wearer meant."""
    drive = Drive([PlanarPose(6.0, 4.0, 1.0)], settings=SLOW, seconds=90.0)
    drive.run_until(lambda: bool(drive.giver.outcomes) and drive.speed_m_s > 0.1, 40.0)
    assert str(drive.giver.outcomes[0].map_id).startswith("ann-")
    schedule_faults(drive.loop, [LoopFault("network", 0.0, 3.0)])
    drive.run(90.0)
    [outcome] = drive.giver.outcomes
    assert outcome.is_reached and outcome.attempts == 1, drive.texts


def test_an_agent_that_is_killed_stops_the_robot() -> None:
    drive = alone("agent", seconds=60.0)
    stops(drive, "no pose for 0.5 s", within_s=1.0)


def test_an_agent_that_is_restarted_is_in_another_map_and_the_goal_is_not_gone_on_with() -> None:
    drive = alone("agent", seconds=1.0)
    stops(drive, "no pose for 0.5 s", within_s=1.0)
    drive.run_until(lambda: drive.texts[-1].startswith("map → odom is published"), 15.0)
    drive.loop.run(drive.loop.now_ns / 1e9 + 1.0)
    assert abs(drive.speed_m_s) < 0.01


def test_a_bare_wall_stops_the_robot() -> None:
    drive = alone("bare-wall", seconds=60.0)
    stops(drive, "has lost tracking", within_s=0.5)
    assert not drive.navigator_has_place


def test_a_bridge_that_is_killed_leaves_a_robot_that_stops() -> None:
    """`map → odom` ends with it, on which the navigation aborts."""
    drive = alone("bridge", seconds=60.0)
    drive.run_until(lambda: abs(drive.speed_m_s) < 0.01, drive.loop.now_ns / 1e9 + 2.0)
    assert drive.giver.outcomes[0].text == "the bridge has ended"


def test_a_bridge_that_is_restarted_cancels_what_its_forerunner_left() -> None:
    drive = alone("bridge", seconds=0.2)
    drive.run_until(
        lambda: "the robot was still driving to a goal that nobody follows; it is cancelled" in drive.texts,
        drive.loop.now_ns / 1e9 + 1.0,
    )
    drive.run_until(lambda: abs(drive.speed_m_s) < 0.01, drive.loop.now_ns / 1e9 + 1.0)


def test_a_second_commander_is_refused_and_the_robot_goes_on() -> None:
    drive = alone("rival", goal=NEAR)
    arrives(drive)
    assert any(text.startswith(f"{RIVAL}: refused: goal giver is sending the robot") for text in drive.texts)


def test_a_goal_outside_the_area_is_refused_and_nothing_moves() -> None:
    corners = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))  # in the robot's own map
    drive = Drive([GOAL], settings=replace(SLOW, area=DrivingArea(corners)), has_ann=False)
    drive.loop.run(3.0)
    assert any("is outside the area" in text and "refused" in text for text in drive.texts)
    assert drive.base.driven_m(0, drive.loop.now_ns) < 1e-6


def test_a_goal_outside_the_map_is_given_up_and_nothing_moves() -> None:
    """Without an area the bridge passes it on, and navigation finds no way."""
    drive = Drive([PlanarPose(30.0, 3.0, 0.5)], settings=SLOW, has_ann=False)
    drive.run(30.0)
    [outcome] = drive.giver.outcomes
    assert outcome.text == "the robot gave up (Nav2's error 203)" and not outcome.says_reached
    assert drive.base.driven_m(0, drive.loop.now_ns) < 1e-6


def test_a_robot_that_leaves_the_area_is_stopped() -> None:
    """A goal within a bent area, whose way leaves it: the navigator does not know the area here."""
    corners = ((-0.4, -0.4), (0.4, -0.4), (0.4, 0.6), (2.4, 0.6), (2.4, 1.6), (-0.4, 1.6))
    drive = Drive([GOAL], settings=replace(SLOW, area=DrivingArea(corners)), has_ann=False)
    drive.run_until(lambda: drive.speed_m_s > 0.1, 5.0)
    stops(drive, "is outside the area", within_s=8.0)
