"""Goals over the wire: from a commander's machine through the edge's to the bridge's, and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.robot_drive import RobotDrive
from helpers.room_bench import Air, RoomBench, at

from share.protocol import room_events as ce
from share.protocol.command_service import GONE_S
from share.protocol.common_events import EdgeMessageReceived, PrintLine
from share.robot import robot_events as ev
from share.robot.goal_control import GOAL_PREFIX
from share.robot.settings import RobotSettings
from share.robot.wire_commands import LEASE_S, WireCommands
from share.wire import room_messages as room
from share.wire.codec import encode
from share.wire.room_messages import Permission

MAP, BOT = "ann-1/0", b"\0\0\0\0\0\0\0\x15"


class WiredRobot:
    """A driving robot with its bridge at an edge, and commanders."""

    def __init__(self, bench: RoomBench | None = None, settings: RobotSettings | None = None) -> None:
        self.bench = bench or RoomBench()
        self.drive, self.commands = RobotDrive(settings), WireCommands()
        self.taken, self.goals = 0, 0
        self.bench.correct(self.bench.agent("ann", 1), MAP, np.eye(4))
        self.bench.client("bot", 21, drives_robot=True)
        self.is_bridge_alive = self.is_navigating = self.is_confirming = True
        self.accepted: list[bytes] = []  # goals that the robot's navigation has
        self.run(0.5)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.02)):
            self.bench.run(0.02)
            effects = self.drive.run(0.02)
            if self.is_bridge_alive:
                for effect in effects:
                    self._take(effect)
                self._serve()

    def _serve(self) -> None:
        effects = self.bench.effects[BOT]
        while self.taken < len(effects):
            effect = effects[self.taken]
            self.taken += 1
            if isinstance(effect, ce.RobotCommanded):
                self._carry_out(*self.commands.take(effect.command, self._goal_id, self.bench.now_ns))
        self._carry_out(*self.commands.tick(self.bench.now_ns))
        place = self.commands.due_place(
            lambda: self.drive.bridge.report(self.drive.now_ns), self.bench.now_ns
        )
        if place is not None:
            self.bench.to_client(BOT, ce.MessageWanted(place))
        self._navigate()

    def _carry_out(self, events: list[ev.RobotEvent], states: list[room.CommandState]) -> None:
        for state in states:
            self.bench.to_client(BOT, ce.MessageWanted(state))
        for event in events:
            self.handle(event)

    def handle(self, event: ev.RobotEvent) -> None:
        begin = len(self.drive.effects)
        self.drive.handle(event)
        for effect in self.drive.effects[begin:]:
            self._take(effect)

    def _take(self, effect: ev.RobotEffect) -> None:
        if isinstance(effect, ev.GoalReport):
            state = self.commands.report(effect, self.bench.now_ns)
            if state is not None:
                self.bench.to_client(BOT, ce.MessageWanted(state))
        elif isinstance(effect, ev.SendGoal):
            self.accepted.append(effect.goal_id)

    def _navigate(self) -> None:
        """Nav2 accepts what it is sent, and cancels what it is asked to."""
        if not self.is_navigating:
            return
        cancelled = {one.goal_id for one in self.drive.of(ev.CancelGoal)} if self.is_confirming else set()
        goals = tuple(
            (goal, ev.GoalStatus.CANCELED if goal in cancelled else ev.GoalStatus.EXECUTING)
            for goal in self.accepted
        )
        self.handle(ev.StatusReceived(goals))

    def _goal_id(self) -> bytes:
        self.goals += 1
        return GOAL_PREFIX + self.goals.to_bytes(8, "big")

    def arrive(self) -> None:
        self.handle(ev.StatusReceived(((self.accepted[-1], ev.GoalStatus.SUCCEEDED),)))
        self.accepted.clear()

    def commander(self, name: str, run_id: int) -> bytes:
        peer = self.bench.client(name, run_id)
        self.run(0.1)
        return peer

    def goto(self, peer: bytes, command: int, x: float = 2.0, **more: object) -> None:
        goal = room.Goto(command, "bot", "", None, x, -1.0, 0.5)
        self.bench.to_client(peer, ce.MessageWanted(replace(goal, **more)))

    def cancel(self, peer: bytes, command: int) -> None:
        self.bench.to_client(peer, ce.MessageWanted(room.Cancel(command, "bot")))

    def last(self, peer: bytes, command: int) -> room.CommandState:
        states = [one.state for one in self.bench.of(peer, ce.CommandChanged) if one.state.command == command]
        return states[-1]

    @property
    def sent(self) -> list[ev.SendGoal]:
        return self.drive.of(ev.SendGoal)

    @property
    def has_goal(self) -> bool:
        return self.drive.bridge.has_goal


@pytest.fixture
def robot() -> WiredRobot:
    return WiredRobot()


def test_a_goal_goes_to_the_robot_once_and_its_result_comes_back(robot) -> None:
    ann = robot.commander("ann", 31)
    robot.goto(ann, 1)
    robot.run(2)
    assert len(robot.sent) == 1 and robot.has_goal
    assert robot.last(ann, 1) == room.CommandState(1, "bot", "ann", "executing")
    robot.arrive()
    robot.run(0.3)
    assert robot.last(ann, 1) == room.CommandState(1, "bot", "ann", "reached", True, True)
    assert robot.bench.clients[ann].is_idle
    commanded = "'ann' sends robot 'bot': to x 2.00 y -1.00 m"
    assert robot.bench.reasons("robot commanded") == [commanded]
    assert robot.bench.reasons("robot answered") == ["robot 'bot', sent by 'ann': reached"]


def test_its_place_comes_twice_a_second_and_five_times_with_a_goal(robot) -> None:
    ann = robot.bench.client("ann", 31, wants_robots=True)
    robot.run(0.5)

    def places(seconds: float) -> int:
        before = len(robot.bench.of(ann, ce.RobotSeen))
        robot.run(seconds)
        return len(robot.bench.of(ann, ce.RobotSeen)) - before

    assert places(5) in (9, 10)
    robot.goto(ann, 1)
    robot.run(1)
    assert places(5) in (24, 25)
    robot.arrive()
    robot.run(1)
    assert places(5) in (9, 10)


def test_who_may_not_command_gets_one_line_and_nothing_moves() -> None:
    robot = WiredRobot(RoomBench(rights={"eve": frozenset({Permission.OBJECTS})}))
    eve = robot.commander("eve", 32)
    robot.goto(eve, 1)
    robot.run(3)
    line = "refused: nobody may command robots here; start the edge with --allow commands"
    assert [one.state.text for one in robot.bench.of(eve, ce.CommandChanged)] == [line]
    assert not robot.sent and not robot.bench.of(BOT, ce.RobotCommanded)
    assert len(robot.bench.reasons("refused")) == 1


def test_anybody_may_stop_a_robot(robot) -> None:
    robot.bench.rights["eve"] = frozenset()
    ann, eve = robot.commander("ann", 31), robot.commander("eve", 32)
    robot.goto(ann, 1)
    robot.run(1)
    robot.cancel(eve, 1)
    robot.run(0.5)
    assert robot.last(ann, 1).text == "stopped: cancelled by 'eve'" and not robot.has_goal
    assert robot.last(eve, 1).is_reached


def test_of_two_commanders_the_second_is_refused_and_the_first_replaces_its_own(robot) -> None:
    ann, bob = robot.commander("ann", 31), robot.commander("bob", 32)
    robot.goto(ann, 5)
    robot.run(0.3)
    robot.goto(bob, 9)
    robot.run(0.3)
    assert robot.last(bob, 9).text == "refused: 'ann' is sending the robot; cancel that first"
    robot.goto(ann, 6, x=3.0)
    robot.run(0.5)
    assert robot.last(ann, 5).text == "replaced by a newer goal" and robot.last(ann, 5).is_final
    assert [one.T_map_base.x for one in robot.sent] == [2.0, 3.0]
    assert robot.last(ann, 6).text == "executing" and robot.has_goal


@pytest.mark.parametrize("seed", range(6))
def test_loss_doubles_and_disorder_begin_a_goal_once(seed: int) -> None:
    robot = WiredRobot(RoomBench(seed=seed))
    ann = robot.commander("ann", 31)
    robot.bench.air = Air(0.25, 0.4, 300)
    robot.goto(ann, 1)
    robot.run(6)
    assert len(robot.sent) == 1 and robot.has_goal
    robot.arrive()
    robot.run(4)
    assert robot.last(ann, 1).is_reached and len(robot.sent) == 1


def test_a_late_double_of_an_ended_goal_begins_nothing(robot) -> None:
    ann = robot.commander("ann", 31)
    robot.goto(ann, 1)
    robot.run(1)
    robot.arrive()
    robot.run(1)
    robot.bench.said(ann, room.Goto(1, "bot", "", None, 2.0, -1.0, 0.5))
    robot.bench.said(ann, room.Goto(0, "bot", "", None, 9.0, -1.0))  # sent before it, and overtaken
    robot.run(1)
    assert len(robot.sent) == 1 and not robot.has_goal


@pytest.mark.parametrize("who", ["commander", "edge", "network"])
def test_without_repetition_the_robot_stops(robot, who: str) -> None:
    ann = robot.commander("ann", 31)
    robot.goto(ann, 1)
    robot.run(2)
    assert robot.has_goal
    if who == "commander":
        del robot.bench.clients[ann]
    elif who == "edge":
        robot.bench.to_edge = lambda event: None
    else:
        robot.bench.air.loss = 1.0
    robot.run(LEASE_S - 0.6)
    assert robot.has_goal
    robot.run(1.2)
    assert not robot.has_goal
    assert robot.drive.of(ev.GoalReport)[-1].text == "stopped: the link to 'ann' is gone"


def test_two_seconds_without_network_do_not_stop_it(robot) -> None:
    ann = robot.commander("ann", 31)
    robot.goto(ann, 1)
    robot.run(2)
    robot.bench.air.loss = 1.0
    robot.run(2)
    robot.bench.air.loss = 0.0
    robot.run(2)
    assert robot.has_goal and len(robot.sent) == 1


def test_an_edge_that_is_restarted_does_not_stop_it(robot) -> None:
    ann = robot.commander("ann", 31)
    robot.goto(ann, 1)
    robot.run(1)
    robot.bench.restart_edge()
    robot.bench.correct(robot.bench.agent("ann", 1), MAP, np.eye(4))
    robot.run(3)
    assert robot.has_goal and len(robot.sent) == 1
    robot.arrive()
    robot.run(1)
    assert robot.last(ann, 1).is_reached


def test_a_bridge_that_is_restarted_does_not_begin_the_goal_again(robot) -> None:
    ann = robot.commander("ann", 31)
    robot.goto(ann, 1)
    robot.run(1)
    robot.commands = WireCommands()
    robot.run(1)
    assert robot.last(ann, 1).text == "stopped: the robot's bridge was restarted; give the goal again"
    assert len(robot.sent) == 1


def test_a_bridge_that_is_away_ends_nothing_and_its_return_does(robot) -> None:
    ann = robot.commander("ann", 31)
    robot.goto(ann, 1)
    robot.run(1)
    bridge, robot.is_bridge_alive = robot.bench.clients.pop(BOT), False
    robot.run(4)
    assert robot.last(ann, 1).text == "robot 'bot' is not connected" and not robot.last(ann, 1).is_final
    robot.bench.clients[BOT], robot.is_bridge_alive = bridge, True
    robot.run(2)
    assert robot.last(ann, 1).is_final and not robot.has_goal


def test_when_the_map_moves_the_goal_is_cancelled_over_the_wire_too(robot) -> None:
    ann = robot.commander("ann", 31)
    robot.goto(ann, 1, map_id=MAP)
    robot.run(1)
    robot.drive.map_id = "carl-3/0"
    robot.run(1)
    assert robot.last(ann, 1).is_final and "give the goal again" in robot.last(ann, 1).text


def test_a_goal_in_a_map_that_was_joined_is_re_expressed(robot) -> None:
    bench, T = robot.bench, at(10.0, -3.0, np.pi / 2)
    bob = bench.agent("bob", 2)
    bench.correct(bob, "bob-2/0", np.eye(4))
    bench.join(MAP, "bob-2/0", T)
    bench.correct(bob, MAP, T)
    commander = robot.commander("bob", 31)
    robot.goto(commander, 1, map_id="bob-2/0")
    robot.run(0.5)
    (sent,) = robot.sent
    assert (sent.T_map_base.x, sent.T_map_base.y) == pytest.approx((11.0, -1.0))
    assert sent.T_map_base.yaw == pytest.approx(0.5 + np.pi / 2)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"map_id": "eve-9/0"}, "it is in the map eve-9/0, the robot in ann-1/0"),
        ({"robot": "bob"}, "no robot 'bob' is connected: start its bridge with --edge; there is bot"),
    ],
)
def test_what_cannot_be_done_is_refused_in_a_line(robot, change, text) -> None:
    ann = robot.commander("ann", 31)
    robot.goto(ann, 1, **change)
    robot.run(0.5)
    assert robot.last(ann, 1).text == f"refused: {text}" and robot.last(ann, 1).is_final
    assert not robot.sent


def test_a_bridge_that_allows_no_goals_says_so() -> None:
    robot = WiredRobot(settings=RobotSettings())
    ann = robot.commander("ann", 31)
    robot.goto(ann, 1, robot=None)
    robot.run(0.5)
    assert robot.last(ann, 1).text.startswith("refused: goals are not allowed; start the bridge with")


def test_a_second_bridge_of_a_robot_is_refused_and_a_dead_one_is_replaced(robot) -> None:
    second = robot.bench.client("bot", 22, drives_robot=True)
    robot.run(1)
    assert not robot.bench.clients[second].is_connected
    assert "robot 'bot' has a bridge already" in robot.bench.reasons("refused")[0]
    del robot.bench.clients[BOT]
    robot.is_bridge_alive = False
    robot.run(9)
    assert robot.bench.clients[second].is_connected


def test_a_client_that_drives_no_robot_cannot_answer_for_one(robot) -> None:
    ann, eve = robot.commander("ann", 31), robot.commander("eve", 32)
    robot.goto(ann, 1)
    robot.run(0.5)
    robot.bench.said(eve, room.CommandState(1, "bot", "ann", "reached", True, True))
    robot.bench.said(eve, room.RobotPlace("bot", MAP, 0.0, 0.0, 0.0, ""))
    robot.run(0.3)
    assert not robot.last(ann, 1).is_final
    assert robot.bench.edge.report({})["robots"]["bot"]["pose"] != [0.0, 0.0, 0.0]


def test_commands_above_the_rate_are_not_passed_on(robot) -> None:
    ann = robot.commander("ann", 31)
    for n in range(500):
        robot.bench.said(ann, room.Goto(n, "bot", "", None, 2.0, -1.0))
    robot.run(0.1)
    assert len(robot.bench.of(BOT, ce.RobotCommanded)) <= 21


def test_those_that_want_robots_see_where_it_is_and_what_becomes_of_goals(robot) -> None:
    watcher, ann = robot.bench.client("w", 40, wants_robots=True), robot.commander("ann", 31)
    robot.goto(ann, 1)
    robot.run(2)
    places = [one.place for one in robot.bench.of(watcher, ce.RobotSeen)]
    assert 9 <= len(places) <= 11 and places[-1].robot == "bot" and places[-1].map_id == MAP
    assert places[-1].text == "to x 2.00 y -1.00 m for 'ann': executing"
    assert {one.state.commander for one in robot.bench.of(watcher, ce.CommandChanged)} == {"ann"}


def test_without_any_answer_a_command_ends() -> None:
    bench = RoomBench()
    ann = bench.client("ann", 31)
    bench.air.loss = 1.0
    bench.to_client(ann, ce.MessageWanted(room.Goto(1, "bot", "", None, 2.0, -1.0)))
    bench.run(11)
    (state,) = [one.state for one in bench.of(ann, ce.CommandChanged)]
    assert state.is_final and state.text == "no edge answers"


def test_the_bridge_of_another_robot_cannot_answer_for_one(robot) -> None:
    ann, eve = robot.commander("ann", 31), robot.bench.client("eve", 66, drives_robot=True)
    robot.run(0.1)
    robot.goto(ann, 1)
    robot.run(1)
    robot.bench.said(eve, room.CommandState(1, "bot", "ann", "reached", True, True))
    robot.run(4)
    assert robot.has_goal and not robot.last(ann, 1).is_final
    assert robot.bench.reasons("robot answered") == []


def test_a_goal_for_the_only_robot_goes_on_where_a_second_one_comes(robot) -> None:
    ann = robot.commander("ann", 31)
    robot.goto(ann, 1, robot=None)
    robot.run(1)
    robot.bench.client("other", 77, drives_robot=True)
    robot.run(4)
    assert robot.has_goal and robot.last(ann, 1).text == "executing"
    robot.bench.restart_edge()
    robot.bench.correct(robot.bench.agent("ann", 1), MAP, np.eye(4))
    robot.run(4)
    assert robot.has_goal
    robot.bench.to_client(ann, ce.MessageWanted(room.Cancel(2, None)))  # that of its goal
    robot.run(0.5)
    assert not robot.has_goal and robot.last(ann, 2).is_reached


def test_a_cancel_by_the_number_of_a_goal_stops_and_does_not_hold_it() -> None:
    robot = WiredRobot(RoomBench(rights={"ann": frozenset(Permission)}))
    ann = robot.commander("ann", 31)
    robot.goto(ann, 1)
    robot.run(1)
    del robot.bench.clients[ann]
    robot.bench.rights["ann"] = frozenset()
    other = robot.commander("ann", 99)
    for _ in range(10):
        robot.bench.said(other, room.Cancel(1, "bot"))
        robot.run(0.5)
    assert not robot.has_goal


def test_a_goal_that_waited_while_its_commander_went_away_begins_nothing(robot) -> None:
    """As where the bridge's process, or the edge's, was stopped: what waited in its queue comes late."""
    goal = room.Goto(1, "bot", "ann", None, 2.0, -1.0)
    for _ in range(5):
        robot._carry_out(*robot.commands.take(goal, robot._goal_id, robot.bench.now_ns))
    robot.run(4)
    assert not robot.sent
    late = robot.commands.take(replace(goal, has_begun=True), robot._goal_id, robot.bench.now_ns)
    assert late[1][0].is_final and not late[0]


def test_a_lease_that_ran_out_is_not_renewed_by_what_waited(robot) -> None:
    ann = robot.commander("ann", 31)
    robot.goto(ann, 1)
    robot.run(1)
    robot.is_bridge_alive = False  # stopped, for a minute
    robot.run(2)
    repetition, robot.taken = robot.taken, len(robot.bench.effects[BOT])
    assert robot.taken > repetition and robot.has_goal
    waiting = [one for one in robot.bench.effects[BOT][repetition:] if isinstance(one, ce.RobotCommanded)]
    del robot.bench.clients[ann]
    robot.run(60)
    robot.is_bridge_alive = True
    for one in waiting:
        robot._carry_out(*robot.commands.take(one.command, robot._goal_id, robot.bench.now_ns))
    robot.run(0.2)
    assert waiting and not robot.has_goal


def test_goals_that_are_not_confirmed_leave_room_for_others(robot) -> None:
    for n in range(200):
        robot.commands.take(room.Goto(n, "bot", "eve", None, 2.0, -1.0), robot._goal_id, robot.bench.now_ns)
    robot.goto(robot.commander("ann", 31), 1)
    robot.run(1)
    assert robot.has_goal


def test_a_cancel_is_done_once_the_robot_confirms_it(robot) -> None:
    ann, eve = robot.commander("ann", 31), robot.commander("eve", 32)
    robot.cancel(eve, 1)
    robot.run(0.5)
    assert robot.last(eve, 1).text == "no goal is under way" and robot.last(eve, 1).is_reached
    robot.goto(ann, 1)
    robot.run(1)
    robot.is_confirming = False
    robot.cancel(eve, 2)
    robot.run(2)
    assert not robot.last(eve, 2).is_final and robot.has_goal
    robot.is_confirming = True
    robot.run(0.3)
    assert robot.last(eve, 2) == room.CommandState(2, "bot", "eve", "cancelled", True, True)
    assert not robot.has_goal and robot.bench.clients[eve].is_idle


def test_a_cancel_that_the_robot_does_not_confirm_says_so(robot) -> None:
    ann, eve = robot.commander("ann", 31), robot.commander("eve", 32)
    robot.goto(ann, 1)
    robot.run(1)
    robot.is_confirming = False
    robot.cancel(eve, 1)
    robot.run(4)
    text = "not confirmed by the robot: stop it by hand"
    assert robot.last(eve, 1) == room.CommandState(1, "bot", "eve", text, True, False)
    robot.cancel(eve, 2)  # one more is answered at once
    robot.run(0.3)
    assert robot.last(eve, 2).text == text and not robot.last(eve, 2).is_reached
    assert robot.has_goal and robot.drive.of(ev.CancelGoal)


def test_what_a_cancel_cannot_stop_is_said(robot) -> None:
    eve, goal = robot.commander("eve", 32), bytes(16)
    robot.is_navigating = False
    for command, (driving, text) in enumerate(
        [
            (goal, "another program has sent the robot a goal; cancel it there"),
            (
                GOAL_PREFIX + goal[:8],
                "a goal that nobody follows is being cancelled; not confirmed by the robot",
            ),
        ]
    ):
        robot.handle(ev.StatusReceived(((driving, ev.GoalStatus.EXECUTING),)))
        robot.cancel(eve, command)
        robot.run(0.3)
        assert robot.last(eve, command).text.startswith(text)
        assert robot.last(eve, command).is_final and not robot.last(eve, command).is_reached


def test_a_flood_of_cancels_ends_and_holds_no_memory(robot) -> None:
    ann, eve = robot.commander("ann", 31), robot.commander("eve", 32)
    robot.goto(ann, 1)
    robot.run(1)
    robot.is_confirming = False
    for command in range(200):
        robot.bench.said(eve, room.Cancel(command, "bot"))
        robot.run(0.02)
    assert len(robot.commands._known) <= 64
    robot.cancel(eve, 500)
    robot.run(4)
    assert robot.last(eve, 500).is_final


def test_another_bridge_cannot_answer_a_commander_that_watches_robots(robot) -> None:
    ann = robot.bench.client("ann", 31, wants_robots=True)
    evil = robot.bench.client("evil", 66, drives_robot=True, wants_robots=True)
    robot.bench.said(evil, room.CommandState(1, None, "ann", "reached", True, True))  # before its time
    robot.run(0.1)
    robot.goto(ann, 1)
    robot.run(1)
    robot.bench.said(evil, room.CommandState(1, None, "ann", "reached", True, True))
    robot.bench.said(evil, room.CommandState(7, None, "bob", "reached", True, True))
    robot.run(4)
    assert robot.has_goal and not robot.bench.clients[ann].is_idle
    assert {one.state.robot for one in robot.bench.of(ann, ce.CommandChanged)} == {"bot"}
    robot.bench.said(evil, room.CommandState(2, None, "ann", "stopped: nothing", True))
    robot.cancel(ann, 2)
    robot.run(0.5)
    assert robot.last(ann, 2).text == "cancelled" and not robot.has_goal


def test_a_goal_for_the_only_robot_stays_its_own_where_an_evil_one_comes(robot) -> None:
    ann = robot.bench.client("ann", 31, wants_robots=True)
    robot.run(0.1)
    robot.goto(ann, 77, robot=None)
    robot.bench.run(0.1)  # passed on; the bridge has not answered
    evil = robot.bench.client("evil", 66, drives_robot=True, wants_robots=True)
    robot.bench.run(0.1)
    robot.bench.said(evil, room.CommandState(77, None, "ann", "1.20 m to go"))
    robot.run(1.5)
    assert robot.has_goal and not robot.bench.of(evil, ce.RobotCommanded)
    assert {one.state.robot for one in robot.bench.of(ann, ce.CommandChanged)} == {"bot"}


@pytest.mark.parametrize("robot_name", ["bot", None])
def test_an_edge_that_answers_for_another_robot_is_not_believed(robot, robot_name) -> None:
    ann = robot.commander("ann", 31)
    robot.goto(ann, 1, robot=robot_name)
    robot.run(1)
    forged = room.CommandState(1, "nobody", "ann", "reached", True, True)
    robot.bench.to_client(ann, EdgeMessageReceived(encode(forged)))
    robot.run(1)
    assert robot.has_goal and robot.last(ann, 1).text == "executing"
    lines = [one.text for one in robot.bench.of(ann, PrintLine) if "nobody" in one.text]
    assert lines == ["robot 'nobody' answers for 'bot'; ignored"]


def test_who_may_nothing_cannot_hide_what_others_command(robot) -> None:
    robot.bench.rights["eve"] = frozenset()
    ann, eve = robot.commander("ann", 31), robot.commander("eve", 32)
    for command in range(300):
        robot.bench.said(eve, room.Cancel(command, "bot"))
        robot.run(0.1)
    for command in range(3):
        robot.goto(ann, 2 * command, x=2.0 + command)
        robot.run(0.5)
        robot.cancel(ann, 2 * command + 1)
        robot.run(0.5)
    said = [line for line in robot.bench.reasons("robot commanded") if line.startswith("'ann' ")]
    assert len(said) == 6
    answered = [line for line in robot.bench.reasons("robot answered") if "sent by 'ann'" in line]
    assert len(answered) == 6
    assert len(robot.bench.reasons("robot commanded")) < 100  # of eve's 300


def test_a_goal_ends_where_the_bridge_is_gone_for_good(robot) -> None:
    ann = robot.commander("ann", 31)
    robot.goto(ann, 1)
    robot.run(1)
    del robot.bench.clients[BOT]
    robot.is_bridge_alive = False
    robot.run(3.5 + GONE_S - 1)
    assert robot.last(ann, 1).text == "robot 'bot' is not connected" and not robot.last(ann, 1).is_final
    robot.run(2)
    text = "given up: robot 'bot' has not been connected for 10 s; give the goal again"
    assert robot.last(ann, 1) == room.CommandState(1, "bot", "ann", text, True, False)
    assert robot.bench.clients[ann].is_idle


def test_a_commander_whose_link_is_refused_reads_why(robot) -> None:
    ann = robot.commander("ann", 31)
    robot.goto(ann, 1)
    robot.run(1)
    robot.bench.air.loss = 1.0
    robot.bench.to_client(ann, ce.LinkTroubled("refused: its key is not authorized\x1b" + "x" * 300))
    robot.run(11)
    state = robot.last(ann, 1)
    assert state.is_final and state.text.startswith("no edge answers: refused: its key is not authorized")


@pytest.mark.parametrize(
    ("kind", "arguments", "text"),
    [
        (room.RemoveObject, (1, 7.0), "object_id: has to be a whole number"),
        (room.RemoveObject, (True, 7), "request: has to be a whole number"),
        (room.Goto, (1, "bot", "", None, True, 2.0), "x: has to be a number, not bool"),
        (room.Goto, (1, "bot", "", None, 1.0, "2"), "y: has to be a number, not str"),
        (room.Goto, (1, "bot", "", None, 1.0, 2.0, 1j), "yaw: has to be a number, not complex"),
        (room.Cancel, (1.0, "bot"), "command: has to be a whole number"),
    ],
)
def test_what_cannot_be_sent_is_refused_by_its_type(kind, arguments, text) -> None:
    with pytest.raises(ValueError, match=text):
        kind(*arguments)


def test_other_real_numbers_are_sent_as_floats() -> None:
    goal = room.Goto(1, "bot", "", None, np.float32(1.5), np.int64(2), np.float64(0.5))
    assert room.RemoveObject(np.int64(1), np.int32(7)).object_id == 7
    assert encode(goal) == encode(room.Goto(1, "bot", "", None, 1.5, 2.0, 0.5))


def test_a_message_that_cannot_be_encoded_costs_itself_only(robot) -> None:
    ann = robot.commander("ann", 31)
    wrong = room.Goto(1, "bot", "", None, 1.0, 2.0)
    object.__setattr__(wrong, "x", object())
    with pytest.raises(AttributeError):
        robot.bench.to_client(ann, ce.MessageWanted(wrong))
    robot.goto(ann, 2)
    robot.run(1)
    assert robot.last(ann, 2).text == "executing" and robot.bench.clients[ann].is_connected
