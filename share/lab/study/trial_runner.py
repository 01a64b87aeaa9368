"""One trial carried out: the state machine, the room, the log and the researcher's terminal, in one loop."""

from __future__ import annotations

import contextlib
import math
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Protocol

from share.devices.host import free_disk_bytes
from share.errors import ShareError
from share.files.writing import write_errors
from share.lab.study import trial_events as te
from share.lab.study import trial_machine as tm
from share.lab.study.floor import SPOT_ID, STUDY_NAME, StudyFloor, find_markers, floor_of
from share.lab.study.readiness import Readiness, RoomState, check_room
from share.lab.study.study_log import StudyLog
from share.lab.study.study_room import StudyRoom
from share.protocol.room_events import CommandChanged, ObjectChanged, RobotSeen
from share.wire.room_messages import ObjectKind, RobotPlace, RoomObject

_STEP_MS = 50
_CHECK_S = 1.0
_GONE_S = 2.0  # without a word of the robot's bridge its place is not known
_END_S = 3.0  # for what is asked for at the end of a trial
_MOVED_M = 0.03  # of a cube on the floor; less is none
_TURNED_RAD = 0.03  # of the floor's marker; less is none
_REMOVED = -1  # id of a marker that is gone


class TrialInterruptedError(ShareError):
    """A trial was broken off; what is done is kept."""


class Researcher(Protocol):
    """The terminal of who leads the trial."""

    def say(self, text: str) -> None: ...

    def poll(self) -> str | None:
        """Return a line that was typed since, without its end; None: none."""
        ...

    def forget_typed(self) -> None:
        """Forget what was typed ahead of a question."""

    @property
    def wants_end(self) -> bool:
        """Whether Ctrl-C was pressed, or q typed, or nothing can be typed any more."""
        ...

    @property
    def end_reason(self) -> str:
        """Why it is to end."""
        ...


@dataclass(frozen=True)
class TrialHeader:
    """What `begin` says. fields: participant, place, condition, plan."""

    fields: dict[str, Any]
    last_s: float  # of the trial's clock where it goes on


class TrialRunner:
    """Carries out one trial in a room. Raises TrialInterruptedError where it ends early."""

    def __init__(
        self, room: StudyRoom, log: StudyLog, researcher: Researcher, machine: tm.TrialMachine
    ) -> None:
        self._room, self._log, self._researcher, self._machine = room, log, researcher, machine
        self._robot: tuple[float, RobotPlace] | None = None  # when it came
        self._robot_name: str | None = None  # of the trial's, once it has begun
        self._command: int | None = None
        self._marker_id: int | None = None
        self._cubes: dict[int, te.Place | None] = {}  # on the floor
        self._called_cubes: set[int] = set()
        self._floor_before: StudyFloor | None = None  # where the marker was last
        self._began_s = time.monotonic()
        self._offset_s = 0.0
        self._shown: te.CalledSpot | None = None

    # ------------------------------------------------------------ before

    def wait_until_ready(self) -> list[str]:
        """Show what is not well until all is, and Enter is pressed. Return what was not, if Enter came twice
        all the same."""
        shown: dict[str, str] = {}
        has_warned, was_well = False, False
        checks: list[Readiness] = []
        due_s = time.monotonic() + _CHECK_S  # the robot's place comes first
        self._researcher.forget_typed()
        while True:
            self._take_news(_STEP_MS)
            self._end_if_broken()
            if time.monotonic() >= due_s and self._room.knows_objects:
                due_s = time.monotonic() + _CHECK_S
                checks = check_room(self._state())
                for one in checks:
                    if _is_news(one, shown):
                        self._researcher.say(one.line)
                    shown[one.name] = one.line
                is_well = all(one.is_well for one in checks)
                if is_well and not was_well:
                    self._researcher.say("all is well: Enter begins the trial")
                was_well = is_well
            if not self._is_enter("begins") or not checks:
                continue
            bad = [one.name for one in checks if not one.is_well]
            if len(find_markers(self._room.objects)) != 1:
                self._researcher.say("no spot can be shown without the floor's one marker; see above")
            elif not bad or has_warned:
                return bad
            else:
                has_warned = True
                self._researcher.forget_typed()
                self._researcher.say(f"not well: {', '.join(bad)}; Enter again begins all the same")

    def _is_enter(self, does: str) -> bool:
        """Return whether Enter alone was pressed since; another line is answered. does: what Enter does."""
        typed = self._researcher.poll()
        if typed is None or not (text := typed.strip()):
            return typed is not None
        self._researcher.say(f"Enter alone {does}, q and Enter ends; '{text:.40}' does nothing")
        return False

    def _state(self) -> RoomState:
        report, trouble = self._room.report()
        age_s = None if self._robot is None else time.monotonic() - self._robot[0]
        with write_errors(self._log.path.parent):
            _, free = free_disk_bytes(self._log.path.parent)
        return RoomState(report, trouble, self._room.objects, age_s, free)

    # ------------------------------------------------------------ the trial

    def run(self, header: TrialHeader, unwell: list[str]) -> None:
        """Carry it through."""
        self._marker_id = find_markers(self._room.objects)[0].object_id
        self._began_s, self._offset_s = time.monotonic(), header.last_s
        self._floor_before = self._floor
        self._place_cubes()
        self._researcher.forget_typed()
        report, _ = self._room.report()
        sealed = {} if report is None else report.get("config", {})
        begin = {
            "event": "begin",
            "t_s": round(self._now_s(), 3),
            **header.fields,
            "judge": "map",
            "utc": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "edge": self._room.out.name,
            "config_sha256": sealed.get("sealed_sha256"),
            "unwell": unwell,
        }
        try:
            self._log.append(begin)
            self._carry_out(self._machine.begin(self._now_s()))
            if self._robot is None:
                self._handle(te.RobotGone())
            else:
                self._take_robot(self._robot[1])
            while not self._machine.is_over:
                self._step()
        except BaseException:
            self._room.stop_robot()
            raise
        finally:
            self._leave()
        if self._machine.stage is tm.TrialStage.BROKEN:
            raise TrialInterruptedError(self._machine.broken_reason)

    def _now_s(self) -> float:
        return self._offset_s + time.monotonic() - self._began_s

    def _step(self) -> None:
        self._take_news(_STEP_MS)
        reason = self._researcher.end_reason if self._researcher.wants_end else self._room.broken()
        if reason is not None:
            self._handle(te.TrialBroken(reason))
            return
        if self._is_enter("calls the robot"):
            self._handle(te.CallPressed())
        self._handle(te.TimePassed())

    def _handle(self, event: te.TrialEvent) -> None:
        self._carry_out(self._machine.handle(event, self._now_s()))

    def _carry_out(self, effects: list[te.TrialEffect]) -> None:
        for effect in effects:
            match effect:
                case te.WriteLine():
                    self._log.append(effect.fields)
                case te.SayLine():
                    self._researcher.say(effect.text)
                case te.ShowSpot():
                    self._shown = effect.called
                    self._remove_cubes()
                    self._show_spot()
                case te.SendRobot():
                    self._send(effect.place)
                case te.StopRobot():
                    self._room.stop_robot()

    @property
    def _floor(self) -> StudyFloor | None:
        return floor_of(self._room.objects, self._marker_id)

    def _show_spot(self) -> None:
        floor = self._floor
        if floor is not None and self._shown is not None:
            self._room.show_spot(floor, self._shown.place)

    def _remove_cubes(self) -> None:
        """Take away the cubes that have called: an edge takes 16 objects of a wearer."""
        for number in self._called_cubes & self._room.objects.keys():
            self._room.remove(number)
        self._called_cubes.clear()

    def _send(self, place: te.Place) -> None:
        floor = self._floor
        if floor is None:
            report = te.GoalReported("refused: the floor's marker is gone; place it again", True, False)
            self._handle(report)
            return
        self._command = self._room.send_robot(floor, place, self._robot_name)

    # ------------------------------------------------------------ news of the room

    def _take_news(self, timeout_ms: int) -> None:
        for one in self._room.step(timeout_ms):
            match one:
                case RobotSeen() if self._robot_name in (None, one.place.robot):
                    self._robot = time.monotonic(), one.place
                    self._take_robot(one.place)
                case CommandChanged() if one.state.command == self._command and self._command is not None:
                    self._handle(te.GoalReported(one.state.text, one.state.is_final, one.state.is_reached))
                case ObjectChanged():
                    self._take_object(one)
        if self._robot is not None and time.monotonic() - self._robot[0] > _GONE_S:
            self._robot = None
            self._handle(te.RobotGone())

    def _take_robot(self, place: RobotPlace) -> None:
        floor = self._floor
        if self._marker_id is not None:  # the trial has begun, with this robot
            self._robot_name = place.robot
        self._handle(te.RobotPlaced(None if floor is None else floor.robot(place, self._now_s())))

    def _take_object(self, change: ObjectChanged) -> None:
        one = change.changed
        if self._marker_id is None or one.owner == STUDY_NAME:  # before the trial
            return
        if one.object_id == self._marker_id and one.removed:
            self._marker_id = _REMOVED
            self._handle(te.FloorMoved(None))
        elif self._marker_id in (one.object_id, _REMOVED) and one.kind is ObjectKind.MARKER:
            self._marker_id = one.object_id
            self._note_floor()
            self._place_cubes()
            self._show_spot()
        elif one.kind is ObjectKind.CUBE:
            self._take_cube(one)

    def _take_cube(self, cube: RoomObject) -> None:
        if cube.removed:
            self._cubes.pop(cube.object_id, None)
            self._handle(te.CubeTaken(cube.object_id))
            return
        floor = self._floor
        place, is_new = None if floor is None else floor.cube(cube), cube.object_id not in self._cubes
        before = self._cubes.get(cube.object_id)
        self._cubes[cube.object_id] = place or before
        # one that goes with its map does not move on the floor, before or after the floor's marker does
        if is_new or (place is not None and (before is None or math.dist(place, before) > _MOVED_M)):
            self._called_cubes.add(cube.object_id)
            self._handle(te.CubeSeen(place, cube.object_id))

    def _note_floor(self) -> None:
        """Tell the trial where the marker moved within its map: in another one it has gone with its map."""
        before, now = self._floor_before, self._floor
        self._floor_before = now or before
        if before is None or now is None or before.map_id != now.map_id:
            return
        T = before.T_map_floor.inverse() @ now.T_map_floor
        moved_m = math.hypot(T.x, T.y)
        if moved_m > _MOVED_M or abs(T.yaw) > _TURNED_RAD:
            self._handle(te.FloorMoved(moved_m))

    def _place_cubes(self) -> None:
        """Note where cubes lie on the floor, that or whose map has moved."""
        floor = self._floor
        for number, one in self._room.objects.items():
            if one.kind is ObjectKind.CUBE and one.owner != STUDY_NAME and floor is not None:
                self._cubes[number] = floor.cube(one) or self._cubes.get(number)

    def _end_if_broken(self) -> None:
        if self._researcher.wants_end:
            raise TrialInterruptedError(f"{self._researcher.end_reason}, before it began")
        if (reason := self._room.broken()) is not None:
            raise TrialInterruptedError(reason)

    def _leave(self) -> None:
        """Take the shown spot away, and wait a moment until that and the robot's stop are answered."""
        if self._room.broken() is not None:
            return
        with contextlib.suppress(ShareError):
            self._remove_cubes()
            self._room.remove(SPOT_ID)
            end_s = time.monotonic() + _END_S
            while not self._room.is_idle and time.monotonic() < end_s:
                self._room.step(_STEP_MS)


def _is_news(check: Readiness, shown: dict[str, str]) -> bool:
    """Whether a line differs from the one before by more than numbers."""
    return _without_numbers(check.line) != _without_numbers(shown.get(check.name, ""))


def _without_numbers(text: str) -> str:
    return "".join(c for c in text if not c.isdigit() and c not in "-.")
