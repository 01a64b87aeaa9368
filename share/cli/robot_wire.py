"""How `share robot goto`, `cancel` and `watch` reach a robot over an edge."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from contextlib import closing
from typing import TYPE_CHECKING, Any

import click

from share.cli.room_options import news
from share.cli.terminal import LiveLine
from share.errors import UsageError

if TYPE_CHECKING:
    from share.runtime.room_link import RoomLink
    from share.wire.room_messages import CommandState, RobotPlace

_STOP_S = 1.0  # that an interrupted command waits for the robot's answer


def goto_answers(
    room: RoomLink, robot: str | None, x: float, y: float, yaw: float | None, map_id: str | None
) -> Iterator[dict[str, Any]]:
    """Send a robot, and yield what becomes of it, as a local bridge says it. Stops the robot where it ends
    before. Raises ShareError."""
    from share.protocol.room_events import CommandWanted
    from share.wire.room_messages import Cancel, Goto

    with closing(room):
        turned = None if yaw is None else math.remainder(yaw, 2 * math.pi)
        try:
            goal = Goto(next(room.numbers), robot, "", map_id, x, y, turned)
        except ValueError as error:
            raise UsageError(str(error)) from None
        room.handle(CommandWanted(goal))
        is_final = False
        try:
            for state in _states(room, goal.command):
                is_final = state.is_final
                yield {"goal": state.text, "is_final": is_final, "is_reached": state.is_reached}
        finally:
            if not is_final and room.client.is_connected:
                room.handle(CommandWanted(Cancel(next(room.numbers), robot)))
                end_s = time.monotonic() + _STOP_S
                while not room.client.is_idle and time.monotonic() < end_s:
                    room.step(50)


def cancel_over_wire(room: RoomLink, robot: str | None) -> str:
    """Stop a robot; return what it says. Raises ShareError."""
    from share.errors import ShareError
    from share.protocol.room_events import CommandWanted
    from share.wire.room_messages import Cancel

    with closing(room):
        try:
            command = Cancel(next(room.numbers), robot)
        except ValueError as error:
            raise UsageError(str(error)) from None
        room.handle(CommandWanted(command))
        *_, last = _states(room, command.command)
    if not last.is_reached:
        raise ShareError(f"the robot was not told to stop: {last.text}")
    return last.text


def _states(room: RoomLink, command: int) -> Iterator[CommandState]:
    """Yield the states of a command up to the final one, each once."""
    from share.protocol.room_events import CommandChanged

    last: CommandState | None = None
    for one in news(room, lambda: True):
        if isinstance(one, CommandChanged) and one.state.command == command and one.state != last:
            last = one.state
            yield last
            if last.is_final:
                return


def watch_over_wire(room: RoomLink, robot: str | None, as_json: bool) -> None:
    """Show robots and what becomes of goals, until Ctrl-C."""
    from share.protocol.room_events import CommandChanged, RobotSeen

    live = LiveLine()
    with closing(room):
        for one in news(room, lambda: True):
            if isinstance(one, RobotSeen) and robot in (None, one.place.robot):
                if as_json:
                    click.echo(json.dumps({"robot": one.place.robot, "state": _place_fields(one.place)}))
                elif live.is_terminal:
                    live.write(_place_text(one.place))
                else:
                    live.print_line(_place_text(one.place))
            elif isinstance(one, CommandChanged) and robot in (None, one.state.robot):
                state = one.state
                if as_json:
                    click.echo(json.dumps({"commander": state.commander, "goal": state.text}))
                elif state.is_final:
                    live.print_line(f"{state.robot}, sent by {state.commander}: {state.text}")


def _place_fields(place: RobotPlace) -> dict[str, Any]:
    pose = None if place.map_id is None else [place.x, place.y, place.yaw]
    return {"pose": pose, "map_id": place.map_id, "text": place.text}


def _place_text(place: RobotPlace) -> str:
    where = "no place"
    if place.map_id is not None:
        where = f"x {place.x:.2f} y {place.y:.2f} m, {math.degrees(place.yaw):.0f}° in {place.map_id}"
    return f"{place.robot}: {where}" + (f"; {place.text}" if place.text else "")
