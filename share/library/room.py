"""The shared room for a program: objects that all see, and robots that it may send."""

from __future__ import annotations

import contextlib
import logging
import math
import secrets
import threading
import time
from pathlib import Path

import numpy as np

from share.errors import ShareError, UsageError
from share.geometry.se3 import from_rt, so3_exp
from share.library.background import BackgroundRun
from share.library.checked_input import checked_kind
from share.net.keys import agent_keys
from share.protocol import room_events as ev
from share.runtime.room_link import RoomLink, no_answer
from share.wire.room_messages import (
    Cancel,
    CommandState,
    Goto,
    ObjectKind,
    PutObject,
    RemoveObject,
    RoomObject,
)

logger = logging.getLogger("share")

_MAX_GOALS = 64  # that are followed; the oldest is forgotten


class RobotGoal:
    """A goal on its way. text: what becomes of it. is_final: nothing follows. is_reached: the robot is
    there."""

    def __init__(self, room: RoomThread, command: int, robot: str | None) -> None:
        self.text, self.is_final, self.is_reached = "sent to the edge", False, False
        self._room, self._command, self._robot = room, command, robot

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it is final. Return whether the robot is there."""
        self._room._wait(lambda: self.is_final, timeout_s)
        return self.is_reached

    def cancel(self) -> None:
        """Stop the robot, whoever sent it."""
        self._room.stop_robot(self._robot)

    def _take(self, state: CommandState) -> None:
        self.text, self.is_final, self.is_reached = state.text, state.is_final, state.is_reached


class RoomThread(BackgroundRun):
    """A client of an edge: it sees the room's objects, and places, moves and removes them; it sends robots.
    Use it as a context manager. A robot that it has sent stops when it ends.

    Who may what: `share keys authorize … --objects --commands`; without keys `share edge --allow`.
    """

    def __init__(
        self, edge: str, name: str, *, keys: str | Path | None = None, server_key: str | None = None
    ) -> None:
        """keys, server_key: as of `share agent`. Raises ShareError."""
        if keys is not None and server_key is None:
            raise UsageError("keys: needs server_key, the public key of the edge")
        own = None if server_key is None else agent_keys(None if keys is None else Path(keys), server_key)
        checked_kind("edge", edge, str, "an address")
        checked_kind("name", name, str, "text")
        try:
            self._link = RoomLink(edge, name, own, print_line=logger.info, wants_objects=True)
        except ValueError as error:
            raise UsageError(str(error)) from None
        self._changed = threading.Condition()  # guards all below, and the link's state machine
        self._answers: dict[int, str] = {}
        self._goals: dict[int, RobotGoal] = {}
        self._inbox: list[ev.MessageWanted] = []
        self._objects: dict[int, RoomObject] = {}
        self._error: ShareError | None = None
        self._has_all, self._is_ending = False, False
        self._thread = threading.Thread(target=self._run, name="room", daemon=True)

    def start(self) -> None:
        """Connect, and return once all objects have come. Raises ShareError if the edge refuses, or does not
        answer for 10 s."""
        self._thread.start()
        try:
            if not self._wait(lambda: self._has_all, 10.0):
                raise no_answer(self._link)
        except ShareError:
            self.stop()
            raise

    def stop(self) -> None:
        """Stop the robots that it has sent, and leave."""
        self._is_ending = True
        self._link.wake()
        if self._thread.ident is not None:
            self._thread.join()

    # ------------------------------------------------------------ objects

    @property
    def objects(self) -> dict[int, RoomObject]:
        """The objects of the room, by id: `kind`, `owner`, `map_id`, `T_map_object` (4, 4)."""
        with self._changed:
            return dict(self._objects)

    def put(
        self,
        kind: str,
        position: tuple[float, float, float],
        yaw: float = 0.0,
        *,
        object_id: int | None = None,
        map_id: str | None = None,
        timeout_s: float = 10.0,
    ) -> int:
        """Place an object ("cube" or "marker"), or move that of `object_id`. Return its id.

        position: m in the map; yaw: rad. map_id: None: that of your agent, or the only one. Raises ShareError
        if it is refused, or not answered in time: then it is placed as soon as the edge answers.
        """
        _check_name("map_id", map_id)
        chosen = secrets.randbelow(2**31) if object_id is None else object_id
        message = placed(next(self._link.numbers), chosen, kind, position, yaw, map_id)
        self._ask(message, timeout_s)
        return chosen

    def remove(self, object_id: int, timeout_s: float = 10.0) -> None:
        """Remove an object, whoever placed it. Raises ShareError as `put`."""
        try:
            message = RemoveObject(next(self._link.numbers), object_id)
        except ValueError as error:
            raise UsageError(str(error)) from None
        self._ask(message, timeout_s)

    def _ask(self, message: PutObject | RemoveObject, timeout_s: float) -> None:
        self._post(ev.MessageWanted(message))
        if not self._wait(lambda: message.request in self._answers, timeout_s):
            raise ShareError(f"the edge did not answer for {timeout_s:g} s; it may still do as asked")
        if reason := self._answers.pop(message.request):
            raise ShareError(reason)

    # ------------------------------------------------------------ robots

    def goto(
        self,
        x: float,
        y: float,
        yaw: float | None = None,
        *,
        robot: str | None = None,
        map_id: str | None = None,
    ) -> RobotGoal:
        """Send a robot to a place: m, rad. robot: None: the only one; map_id: None: the robot's. Returns at
        once."""
        _check_name("robot", robot)
        _check_name("map_id", map_id)
        command = next(self._link.numbers)
        try:
            message = Goto(command, robot, "", map_id, x, y, yaw)
        except (ValueError, TypeError) as error:
            raise UsageError(str(error)) from None
        goal = RobotGoal(self, command, robot)
        with self._changed:
            self._goals[command] = goal
            if len(self._goals) > _MAX_GOALS:
                del self._goals[next(iter(self._goals))]
        self._post(ev.MessageWanted(message))
        return goal

    def stop_robot(self, robot: str | None = None) -> None:
        """Stop a robot, whoever sent it. Returns at once."""
        _check_name("robot", robot)
        try:
            message = Cancel(next(self._link.numbers), robot)
        except (ValueError, TypeError) as error:
            raise UsageError(str(error)) from None
        self._post(ev.MessageWanted(message))

    # ------------------------------------------------------------ the thread

    def _post(self, event: ev.MessageWanted) -> None:
        with self._changed:
            self._inbox.append(event)
        self._link.wake()

    def _wait(self, is_done: object, timeout_s: float | None) -> bool:
        """Wait until `is_done()`. Raises the error that ended the thread."""
        assert callable(is_done)
        with self._changed:
            self._changed.wait_for(lambda: is_done() or self._error is not None, timeout_s)
            if not is_done() and self._error is not None:
                raise self._error
            return bool(is_done())

    def _run(self) -> None:
        try:
            while not self._is_ending:
                self._step()
            self._stop_robots()
            self._link.close()
        except ShareError as error:
            self._error = error
            with contextlib.suppress(ShareError):
                self._link.close()
        with self._changed:
            if self._error is None:
                self._error = ShareError("this room has been left")
            self._changed.notify_all()

    def _step(self) -> None:
        with self._changed:
            events, self._inbox = self._inbox, []
        for event in events:
            self._link.handle(event)
        news = self._link.step(50)
        with self._changed:
            for one in news:
                match one:
                    case ev.RequestAnswered():
                        self._answers[one.request] = one.reason
                    case ev.CommandChanged() if one.state.command in self._goals:
                        self._goals[one.state.command]._take(one.state)
            self._objects, self._has_all = self._link.client.objects, self._link.client.has_all_objects
            self._changed.notify_all()

    def _stop_robots(self) -> None:
        """Stop what is under way, and wait a moment for the answer; without one the robot stops by itself."""
        for robot in {goal._robot for goal in self._goals.values() if not goal.is_final}:
            self._link.handle(ev.MessageWanted(Cancel(next(self._link.numbers), robot)))
        end_s = time.monotonic() + 1.0
        while not self._link.client.is_idle and time.monotonic() < end_s:
            self._step()


def _check_name(argument: str, value: str | None) -> None:
    """Raise UsageError if an argument that may be left out is no text."""
    checked_kind(argument, value, (str, type(None)), "a name, or None")


def placed(
    request: int,
    object_id: int,
    kind: str,
    position: tuple[float, float, float],
    yaw: float,
    map_id: str | None,
) -> PutObject:
    """Return the request to place an object. Raises UsageError for values that no room has."""
    try:
        x, y, z = (float(value) for value in position)
        if not all(map(math.isfinite, (x, y, z, yaw))):
            raise ValueError("position, yaw: are not finite")
        T = from_rt(so3_exp(np.array([0.0, 0.0, math.remainder(yaw, 2 * math.pi)])), np.array([x, y, z]))
        return PutObject(request, object_id, ObjectKind(kind), map_id, T)
    except (ValueError, TypeError) as error:
        raise UsageError(str(error)) from None
