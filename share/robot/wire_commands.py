"""Commands that come to a robot's bridge over the wire: each begun once, held while it is repeated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from share.errors import printable
from share.robot import robot_events as ev
from share.timing import PeriodicTimer, seconds_to_ns
from share.wire.room_messages import (
    MAX_ANSWER_LENGTH,
    MAX_PLACE_M,
    Cancel,
    CommandState,
    Goto,
    RobotPlace,
)

LEASE_S = 3.0  # a goal that is not repeated for so long is given up: commander, edge or network are gone
_MAX_KNOWN = 64  # commands; the oldest final one is forgotten
_PROGRESS_S = 0.25  # between two reports on the way
_PLACE_S, _DRIVEN_PLACE_S = 0.5, 0.2  # between two places; while a goal is under way


@dataclass
class BridgeCommand:
    goal_id: bytes
    state: CommandState
    repeated_ns: int
    is_told: bool = True  # its state was sent
    is_begun: bool = True

    def is_held(self, now_ns: int) -> bool:
        """Whether its commander has repeated it in time."""
        return now_ns - self.repeated_ns <= seconds_to_ns(LEASE_S)


class WireCommands:
    """Turns commands into events of the bridge, and its reports into states. Commands go by kind, commander
    and number: each is used once. A cancellation is final once the bridge has said what became of the goal.

    A goal begins once its commander has heard of the bridge (`has_begun`): one that waited in a queue while
    its commander went away begins nothing.
    """

    def __init__(self) -> None:
        self._known: dict[tuple[type, str, int], BridgeCommand] = {}
        self._progress_timer = PeriodicTimer(_PROGRESS_S)
        self._place_ns: int | None = None  # when the last place was told

    def take(
        self, command: Goto | Cancel, make_goal_id: Callable[[], bytes], now_ns: int
    ) -> tuple[list[ev.RobotEvent], list[CommandState]]:
        """Return the events of a command, and the states to send. make_goal_id: makes the id of a goal."""
        key = type(command), command.commander, command.command
        if (known := self._known.get(key)) is not None:
            return self._repeat(known, command, now_ns)
        events: list[ev.RobotEvent] = []
        goal_id, text = b"", ""
        if isinstance(command, Cancel):
            goal_id = make_goal_id()
            events = [ev.CancelRequested(commander_text(command.commander), goal_id)]
        elif command.has_begun:
            text = "stopped: the robot's bridge was restarted; give the goal again"
        elif not self._make_room():
            text = "refused: too many goals under way"
        else:
            goal_id = make_goal_id()
        is_final = not goal_id
        state = CommandState(command.command, None, command.commander, text or "taken", is_final)
        self._make_room()
        is_begun = is_final or isinstance(command, Cancel)
        self._known[key] = BridgeCommand(goal_id, state, now_ns, is_begun=is_begun)
        return events, [state]

    def _repeat(
        self, known: BridgeCommand, command: Goto | Cancel, now_ns: int
    ) -> tuple[list[ev.RobotEvent], list[CommandState]]:
        """Hold a command that is known, unless that comes too late; begin it where it has not begun."""
        known.is_told = True
        if known.is_held(now_ns):
            known.repeated_ns = now_ns
        is_over = known.is_begun or known.state.is_final
        if is_over or not isinstance(command, Goto) or not command.has_begun:
            return [], [known.state]
        known.is_begun = True
        place = command.x, command.y, command.yaw, command.map_id
        return [ev.GotoRequested(commander_text(command.commander), known.goal_id, *place)], []

    def report(self, report: ev.GoalReport, now_ns: int) -> CommandState | None:
        """Take a report of the bridge; return the state to send now, if it is about a command of the wire."""
        known = next((one for one in self._known.values() if one.goal_id == report.goal_id != b""), None)
        if known is None:
            return None
        state, text = known.state, printable(report.text)[:MAX_ANSWER_LENGTH]
        if state.is_final:
            return None
        known.state = CommandState(
            state.command, None, state.commander, text, report.is_final, report.is_reached
        )
        is_step = report.is_final or state.text == "taken" or report.text in set(ev.GoalStatus)
        known.is_told = is_step or self._progress_timer.fire_if_due(now_ns)
        return known.state if known.is_told else None

    def tick(self, now_ns: int) -> tuple[list[ev.RobotEvent], list[CommandState]]:
        """Give up goals that are not repeated; return states on the way that were held back."""
        events: list[ev.RobotEvent] = []
        lost = [
            one
            for (kind, *_), one in self._known.items()
            if kind is Goto and not (one.state.is_final or one.is_held(now_ns))
        ]
        for known in lost:
            if known.is_begun:
                known.repeated_ns = now_ns  # said again where the robot goes on
                events.append(ev.CommanderLost(commander_text(known.state.commander)))
            else:
                text = f"stopped: the link to {commander_text(known.state.commander)} is gone"
                known.state, known.is_told = replace(known.state, text=text, is_final=True), False
        held = [known for known in self._known.values() if not known.is_told]
        if not held or not self._progress_timer.fire_if_due(now_ns):
            return events, []
        for known in held:
            known.is_told = True
        return events, [known.state for known in held]

    def due_place(self, report: Callable[[], dict[str, Any]], now_ns: int) -> RobotPlace | None:
        """Return where the robot is, twice a second, five times with a goal. report: of the bridge."""
        since_ns = None if self._place_ns is None else now_ns - self._place_ns
        if since_ns is not None and since_ns < seconds_to_ns(_DRIVEN_PLACE_S):
            return None
        state = report()
        if since_ns is not None and since_ns < seconds_to_ns(_PLACE_S) and state["goal"] is None:
            return None
        self._place_ns = now_ns
        return robot_place(state)

    def _make_room(self) -> bool:
        """Forget one of too many commands: the oldest final one, else one that never began, else a
        cancellation (a repeated one is answered anew). Return whether there is room."""
        if len(self._known) < _MAX_KNOWN:
            return True
        known = self._known.items()
        ended = [key for key, one in known if one.state.is_final]
        if not (ended := ended or [key for key, one in known if not one.is_begun or key[0] is Cancel]):
            return False
        del self._known[ended[0]]
        return True


def commander_text(name: str) -> str:
    """Return how the bridge names a commander of the wire: no local one has quotes."""
    return f"'{name}'"


def robot_place(report: dict[str, Any]) -> RobotPlace:
    """Return a bridge's report (`RobotBridge.report`) as a message."""
    pose, map_id, goal = report["pose"], report["map_id"], report["goal"]
    text = report["fault"] or report["refusal"] or ""
    if goal is not None:
        text = f"to x {goal['x']:.2f} y {goal['y']:.2f} m for {goal['commander']}: {goal['status']}"
    short = printable(text)[:MAX_ANSWER_LENGTH]
    if pose is None or map_id is None or not all(abs(value) <= MAX_PLACE_M for value in pose[:2]):
        return RobotPlace(None, None, 0.0, 0.0, 0.0, short)
    x, y, yaw = pose
    return RobotPlace(None, map_id, x, y, yaw, short)
