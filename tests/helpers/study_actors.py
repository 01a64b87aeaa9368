"""Who is in the room of a study, for tests: a headset's agent and a robot's, which only say that they track,
the robot's bridge, which drives straight to its goals, and a wearer who places cubes. All come back after the
edge's restart.

The map is a stored one (`study_map`), in which both agents' runs are known, so they are in it at once."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from pathlib import Path

import numpy as np
from helpers.hellos import hello_of
from helpers.map_changes import ANN, pose, small_map

from share import Room, ShareError
from share.geometry.se3 import from_rt, so3_exp
from share.lab.study.floor import SPOT_ID
from share.mapping.map_changes import MapChange, SaveObject, SaveRun
from share.net.transport import connect
from share.protocol.room_events import MessageWanted, RobotCommanded
from share.runtime.room_link import RoomLink
from share.store.map_store import MapStore
from share.types import AgentKind, TrackState
from share.wire.codec import encode
from share.wire.messages import Ping, PoseUpdate, Status
from share.wire.room_messages import Cancel, CommandState, Goto, ObjectKind, RobotPlace, RoomObject

MAP = f"{ANN}/0"
MARKER = 77
FLOOR = (0.5, -0.2, 0.3)  # x, y, yaw of the floor in the map
_KINDS = {"ann": (1, AgentKind.AR), "bob": (2, AgentKind.ROBOT)}


def _run(key: str) -> SaveRun:
    name = key.partition("-")[0]
    number, kind = _KINDS[name]
    return SaveRun(key, hello_of(name, number, kind, T=pose(3)), "")


def study_map(path: Path, has_marker: bool = True) -> None:
    """Write the map, with the floor's marker."""
    changes: list[MapChange] = [
        _run(one.run_key) if isinstance(one, SaveRun) else one for one in small_map(4)
    ]
    if has_marker:
        x, y, yaw = FLOOR
        T = from_rt(so3_exp(np.array([0.0, 0.0, yaw])), np.array([x, y, 0.0]))
        marker = RoomObject(1, 1, MARKER, ObjectKind.MARKER, "lead", MAP, T)
        changes.append(SaveObject(marker, MAP))
    with MapStore.open(path) as store:
        store.write(changes)


def in_map(x: float, y: float) -> tuple[float, float]:
    """A place of the floor in the map."""
    fx, fy, yaw = FLOOR
    return fx + math.cos(yaw) * x - math.sin(yaw) * y, fy + math.sin(yaw) * x + math.cos(yaw) * y


class StudyActors:
    """address: of the edge, which may come and go. speed_m_s: the robot's. reaches: whether it drives at
    all."""

    def __init__(self, address: str, speed_m_s: float = 3.0, reaches: bool = True) -> None:
        self.address, self.speed_m_s, self.reaches = address, speed_m_s, reaches
        self.at, self.is_bridge_dead = in_map(2.0, 2.0), False
        self._ended = threading.Event()
        self._threads = [threading.Thread(target=self._agent, args=(name,)) for name in _KINDS]
        self._threads.append(threading.Thread(target=self._robot))

    def __enter__(self) -> StudyActors:
        for one in self._threads:
            one.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        for one in self._threads:
            one.join()

    def place_cube(self, x: float, y: float, number: int) -> RoomObject | None:
        """The wearer places a cube on the floor. Return what shows it the spot. Raises ShareError without an
        edge."""
        with Room(self.address, "wearer") as room:
            shown = room.objects.get(SPOT_ID)
            room.put("cube", (*in_map(x, y), 0.1), object_id=number)
        return shown

    def _agent(self, name: str) -> None:
        number, kind = _KINDS[name]
        link = connect(self.address, number)
        hello, count = encode(hello_of(name, number, kind, T=pose(3))), 0
        while not self._ended.wait(0.1):
            now_ns = time.monotonic_ns()
            if count % 10 == 0:
                link.send(hello)
            link.send(encode(PoseUpdate(now_ns, TrackState.OK, -1, np.eye(4), 9.0, 0.01, 0.002)))
            if count % 5 == 0:
                link.send(encode(Status(TrackState.OK, 9.0, clock_error_ms=0.4)))
                link.send(encode(Ping(count, now_ns)))
            link.poll_connected()
            while link.receive(0) is not None:
                pass
            count += 1
        link.close()

    def _robot(self) -> None:
        """The bridge of bob: 5 places a second, and what becomes of its goals."""
        link = RoomLink(self.address, "bob", drives_robot=True)
        goal: Goto | None = None
        final: dict[int, CommandState] = {}
        told_s = stepped_s = time.monotonic()
        while not (self._ended.is_set() or self.is_bridge_dead):
            for effect in link.step(20):
                if not isinstance(effect, RobotCommanded):
                    continue
                command = effect.command
                if command.command in final:
                    link.handle(MessageWanted(final[command.command]))
                elif isinstance(command, Cancel):
                    done = CommandState(command.command, None, command.commander, "cancelled", True, True)
                    final[command.command] = done
                    link.handle(MessageWanted(done))
                    if goal is not None:
                        text = f"stopped: cancelled by '{command.commander}'"
                        stopped = CommandState(goal.command, None, goal.commander, text, True)
                        final[goal.command], goal = stopped, None
                        link.handle(MessageWanted(stopped))
                else:
                    if goal is None or goal.command != command.command:
                        state = CommandState(command.command, None, command.commander, "taken")
                        link.handle(MessageWanted(state))
                    goal = command
            now_s = time.monotonic()
            step_m, stepped_s = self.speed_m_s * (now_s - stepped_s), now_s
            if goal is not None and self.reaches:
                left_m = math.dist(self.at, (goal.x, goal.y))
                u = 1.0 if left_m <= step_m else step_m / left_m
                self.at = (
                    self.at[0] + u * (goal.x - self.at[0]),
                    self.at[1] + u * (goal.y - self.at[1]),
                )
                if u == 1.0:
                    done = CommandState(goal.command, None, goal.commander, "reached", True, True)
                    final[goal.command], goal = done, None
                    link.handle(MessageWanted(done))
            if now_s - told_s >= 0.2:
                told_s = now_s
                text = "" if goal is None else f"to x {goal.x:.2f} y {goal.y:.2f} m"
                link.handle(MessageWanted(RobotPlace(None, MAP, *self.at, 0.0, text)))
        with contextlib.suppress(ShareError):
            link.close()
