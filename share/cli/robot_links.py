"""How `share robot goto`, `cancel` and `watch` reach a robot: by this machine's bridge, or over an edge."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from share.cli.room_options import news
from share.errors import ShareError, UsageError

if TYPE_CHECKING:
    from share.runtime.room_link import RoomLink
    from share.wire.room_messages import Cancel, CommandState, Goto, RobotPlace

_STOP_S = 1.0  # that an interrupted command waits for the robot's answer


@dataclass(frozen=True)
class GoalUpdate:
    """Progress of a goal, or of its cancellation."""

    text: str
    is_reached: bool


@dataclass(frozen=True)
class RobotNews:
    """A report of a robot. fields: for JSON. text: for a person; None: nothing. is_place: its position, which
    replaces the one shown before."""

    fields: dict[str, Any]
    text: str | None
    is_place: bool = False


class RobotLink(Protocol):
    """A way to a robot. A goal lives no longer than the iterator of its updates. All raise ShareError."""

    def goto(self, x: float, y: float, yaw: float | None, map_id: str | None) -> Iterator[GoalUpdate]:
        """Send the robot to x, y (m), yaw (rad), and yield the goal's progress up to its end."""

    def cancel(self) -> Iterator[GoalUpdate]:
        """Cancel the robot's goal, and yield the robot's answers."""

    def watch(self) -> Iterator[RobotNews]:
        """Yield the robot's position and the progress of goals."""


# ---------------------------------------------------------------- the bridge of this machine


class LocalRobot:
    """The robot whose bridge listens at `path`."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def goto(self, x: float, y: float, yaw: float | None, map_id: str | None) -> Iterator[GoalUpdate]:
        return self._updates({"do": "goto", "x": x, "y": y, "yaw": yaw, "map_id": map_id})

    def cancel(self) -> Iterator[GoalUpdate]:
        return self._updates({"do": "cancel"})

    def _updates(self, wish: dict[str, Any]) -> Iterator[GoalUpdate]:
        from share.runtime.robot_commands import ask_bridge

        for answer in ask_bridge(self._path, wish):
            yield GoalUpdate(str(answer.get("goal")), bool(answer.get("is_reached")))
            if answer.get("is_final"):
                return

    def watch(self) -> Iterator[RobotNews]:
        from share.runtime.robot_commands import ask_bridge

        for answer in ask_bridge(self._path, {"do": "watch"}):
            if "state" in answer:
                yield RobotNews(answer, state_text(answer["state"]), is_place=True)
            else:
                line = answer.get("line") or f"{answer.get('commander')}: {answer.get('goal')}"
                yield RobotNews(answer, str(line))
        raise ShareError("the bridge has ended")


def state_text(state: dict[str, Any]) -> str:
    """Return what a bridge reports of its robot, as one line."""
    if state["pose"] is None:
        return f"no place: {state['fault']}"
    where = f"{_place_text(*state['pose'])} in {state['map_id']}"
    goal = state["goal"]
    if goal is not None:
        return f"{where}; to x {goal['x']:.2f} y {goal['y']:.2f} m for {goal['commander']}: {goal['status']}"
    return where if state["refusal"] is None else f"{where}; no goals: {state['refusal']}"


def _place_text(x: float, y: float, yaw: float) -> str:
    return f"x {x:.2f} y {y:.2f} m, {math.degrees(yaw):.0f}°"


# ---------------------------------------------------------------- over an edge


class RobotAtEdge:
    """Robot `name` at an edge; the only one, and with `watch` all, if None. The link is closed at the end of
    what is yielded."""

    def __init__(self, room: RoomLink, name: str | None) -> None:
        self._room, self._name = room, name

    def goto(self, x: float, y: float, yaw: float | None, map_id: str | None) -> Iterator[GoalUpdate]:
        from share.wire.room_messages import Goto

        turned = None if yaw is None else math.remainder(yaw, 2 * math.pi)
        with closing(self._room):
            try:
                goal = Goto(next(self._room.numbers), self._name, "", map_id, x, y, turned)
            except ValueError as error:
                raise UsageError(str(error)) from None
            is_final = False
            try:
                for state in self._states(goal):
                    is_final = state.is_final
                    yield GoalUpdate(state.text, state.is_reached)
            finally:
                if not is_final and self._room.client.is_connected:
                    self._stop()

    def cancel(self) -> Iterator[GoalUpdate]:
        with closing(self._room):
            for state in self._states(self._cancel_message()):
                yield GoalUpdate(state.text, state.is_reached)

    def watch(self) -> Iterator[RobotNews]:
        from share.protocol.room_events import CommandChanged, RobotSeen

        with closing(self._room):
            for one in news(self._room, lambda: True):
                if isinstance(one, RobotSeen) and self._name in (None, one.place.robot):
                    yield _place_news(one.place)
                elif isinstance(one, CommandChanged) and self._name in (None, one.state.robot):
                    yield _command_news(one.state)

    def _states(self, command: Goto | Cancel) -> Iterator[CommandState]:
        """Send a command, and yield its states up to the final one, each once."""
        from share.protocol.room_events import CommandChanged, MessageWanted

        self._room.handle(MessageWanted(command))
        last: CommandState | None = None
        for one in news(self._room, lambda: True):
            is_of_command = isinstance(one, CommandChanged) and one.state.command == command.command
            if isinstance(one, CommandChanged) and is_of_command and one.state != last:
                last = one.state
                yield last
                if last.is_final:
                    return

    def _cancel_message(self) -> Cancel:
        from share.wire.room_messages import Cancel

        try:
            return Cancel(next(self._room.numbers), self._name)
        except ValueError as error:
            raise UsageError(str(error)) from None

    def _stop(self) -> None:
        from share.protocol.room_events import MessageWanted

        self._room.handle(MessageWanted(self._cancel_message()))
        end_s = time.monotonic() + _STOP_S
        while not self._room.client.is_idle and time.monotonic() < end_s:
            self._room.step(50)


def _place_news(place: RobotPlace) -> RobotNews:
    pose, where = None, "no place"
    if place.map_id is not None:
        pose = [place.x, place.y, place.yaw]
        where = f"{_place_text(place.x, place.y, place.yaw)} in {place.map_id}"
    state = {"pose": pose, "map_id": place.map_id, "text": place.text}
    text = f"{place.robot}: {where}" + (f"; {place.text}" if place.text else "")
    return RobotNews({"robot": place.robot, "state": state}, text, is_place=True)


def _command_news(state: CommandState) -> RobotNews:
    text = f"{state.robot}, sent by {state.commander}: {state.text}"
    fields = {"commander": state.commander, "goal": state.text}
    return RobotNews(fields, text if state.is_final else None)
