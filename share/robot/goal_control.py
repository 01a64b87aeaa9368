"""One goal at a time, from request to final status. The robot's GoalStatusArray is authoritative.

Replies to a goal can come seconds late and do not say which goal they answer, so they only explain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from share.errors import printable
from share.protocol.common_events import PrintLine
from share.robot import robot_events as ev
from share.robot.planar import PlanarPose
from share.timing import PeriodicTimer, seconds_to_ns

GOAL_PREFIX = b"SHARE\x00\x00\x01"  # of the ids of all goals of SHARE: a bridge knows those of one that died
ACCEPT_S = 5.0  # without a status by then the robot has not taken the goal
_REFUSED_S = 0.5  # a refusal counts if no status contradicts it by then
_RESULT_S = 1.0  # wait so long for the reason of a failure
_REPEAT_S = 0.5  # of a cancellation that is not confirmed, and of the speed limit
_UNCONFIRMED_S = 3.0
UNCONFIRMED = "not confirmed by the robot: stop it by hand"


@dataclass(frozen=True)
class ActiveGoal:
    """A goal that was sent. map_id: in which map it is meant. Times: host, ns."""

    commander: str
    goal_id: bytes
    map_id: str
    T_map_base: PlanarPose
    sent_ns: int
    status: ev.GoalStatus = ev.GoalStatus.UNKNOWN
    refused_ns: int | None = None
    stopped_ns: int | None = None
    stop_reason: str = ""
    is_unconfirmed: bool = False  # and reported
    failed_ns: int | None = None


class GoalControl:
    """Sends one goal, follows its status, and stops it. Each call returns effects. `active` is None
    between."""

    def __init__(self) -> None:
        self.active: ActiveGoal | None = None
        self.is_driven_by_others = False  # another program's goal is under way
        self._has_orphans = False  # a goal of SHARE that nobody follows is
        self._cancels: list[ev.CancelRequested] = []  # that wait for the end of the goal under way
        self._cancel_timer, self._orphan_timer = PeriodicTimer(_REPEAT_S), PeriodicTimer(_REPEAT_S)

    def begin(self, goal: ActiveGoal, stamp_ns: int) -> list[ev.RobotEffect]:
        """Send a goal; one under way of the same commander is replaced by it."""
        effects: list[ev.RobotEffect] = []
        if self.active is not None:
            effects.append(_report(self.active, "replaced by a newer goal", is_final=True))
            effects += self._answer_cancels("not confirmed: a newer goal has come", is_reached=False)
        self.active = goal
        where = f"x {goal.T_map_base.x:.2f} y {goal.T_map_base.y:.2f} m"
        effects.append(ev.SendGoal(goal.goal_id, stamp_ns, goal.T_map_base))
        effects.append(_report(goal, f"sent to the robot: {where}"))
        return effects

    def stop(self, reason: str, now_ns: int) -> list[ev.RobotEffect]:
        """Stop the goal under way; nothing to do without one, or where it is being stopped."""
        if self.active is None or self.active.stopped_ns is not None:
            return []
        self.active = replace(self.active, stopped_ns=now_ns, stop_reason=reason)
        self._cancel_timer.postpone(now_ns + seconds_to_ns(_REPEAT_S))
        return [
            ev.CancelGoal(self.active.goal_id),
            _report(self.active, f"stopping: {reason}"),
        ]

    def take_cancel(self, event: ev.CancelRequested) -> list[ev.RobotEffect]:
        """Answer a wish to stop, which `stop` carries out, now or at the end of the goal under way."""
        self._cancels.append(event)
        if self.active is not None:
            return self._answer_cancels(UNCONFIRMED, False) if self.active.is_unconfirmed else []
        if self._has_orphans:
            return self._answer_cancels(
                f"a goal that nobody follows is being cancelled; {UNCONFIRMED}", False
            )
        if self.is_driven_by_others:
            return self._answer_cancels("another program has sent the robot a goal; cancel it there", False)
        return self._answer_cancels("no goal is under way", is_reached=True)

    def take_status(self, event: ev.StatusReceived, now_ns: int) -> list[ev.RobotEffect]:
        """Follow the robot's list of goals."""
        statuses = dict(event.goals)
        self.is_driven_by_others = any(
            not status.is_final and not goal_id.startswith(GOAL_PREFIX)
            for goal_id, status in event.goals
            if status is not ev.GoalStatus.UNKNOWN
        )
        effects = self._cancel_orphans(statuses, now_ns)
        goal = self.active
        if goal is None or goal.failed_ns is not None:
            return effects
        status = statuses.get(goal.goal_id)
        if status is None:
            if goal.status is not ev.GoalStatus.UNKNOWN:
                return effects + self._end("the robot's navigation was restarted")
            return effects
        if status is not goal.status:
            self.active = replace(goal, status=status)
            effects += self._on_new_status(self.active, status, now_ns)
        return effects

    def _on_new_status(self, goal: ActiveGoal, status: ev.GoalStatus, now_ns: int) -> list[ev.RobotEffect]:
        match status:
            case ev.GoalStatus.SUCCEEDED:
                return self._end("reached", is_reached=True)
            case ev.GoalStatus.CANCELED:
                return self._end(f"stopped: {goal.stop_reason or 'cancelled by another program'}")
            case ev.GoalStatus.ABORTED if goal.stopped_ns is not None:
                return self._end(f"stopped: {goal.stop_reason}")
            case ev.GoalStatus.ABORTED:
                self.active = replace(goal, failed_ns=now_ns)
                return [ev.AskResult(goal.goal_id)]
            case _:
                return [_report(goal, status)]

    def take_feedback(self, event: ev.FeedbackReceived) -> list[ev.RobotEffect]:
        """Tell the commander how far it is."""
        goal = self.active
        if goal is None or event.goal_id != goal.goal_id or not math.isfinite(event.distance_m):
            return []
        return [_report(goal, f"{event.distance_m:.2f} m to go")]

    def take_answer(self, event: ev.GoalAnswered, now_ns: int) -> None:
        """Remember a refusal: it may be that of the goal under way."""
        goal = self.active
        if goal is not None and not event.is_accepted and goal.status is ev.GoalStatus.UNKNOWN:
            self.active = replace(goal, refused_ns=now_ns)

    def take_result(self, event: ev.ResultReceived) -> list[ev.RobotEffect]:
        """End a goal that failed, with its reason."""
        if self.active is None or self.active.failed_ns is None:
            return []
        text = f", {printable(event.text)[:200]}" if event.text else ""
        return self._end(f"the robot gave up (Nav2's error {event.code}{text})")

    def tick(self, now_ns: int) -> list[ev.RobotEffect]:
        """Do what is due."""
        goal = self.active
        if goal is None:
            return []
        if goal.failed_ns is not None:
            is_late = now_ns - goal.failed_ns > seconds_to_ns(_RESULT_S)
            return self._end("the robot gave up, without a reason") if is_late else []
        if goal.stopped_ns is not None:
            waited_ns = now_ns - max(goal.sent_ns, goal.stopped_ns)
            if goal.status is ev.GoalStatus.UNKNOWN and waited_ns > seconds_to_ns(ACCEPT_S):
                text = f"stopped: {goal.stop_reason}; the robot's navigation never took the goal"
                answers = self._answer_cancels(f"{UNCONFIRMED} if it drives: it never took the goal", False)
                return [ev.CancelGoal(goal.goal_id), *answers, *self._end(text)]  # a late start is an orphan
            return self._repeat_cancel(goal, goal.stopped_ns, now_ns)
        if goal.status is ev.GoalStatus.UNKNOWN:
            if goal.refused_ns is not None and now_ns - goal.refused_ns > seconds_to_ns(_REFUSED_S):
                return self._end("the robot's navigation refuses the goal; is it active?")
            if now_ns - goal.sent_ns > seconds_to_ns(ACCEPT_S):
                # it may have arrived all the same: a status that comes later finds it an orphan
                cancel: ev.RobotEffect = ev.CancelGoal(goal.goal_id)
                return [cancel, *self._end(f"no answer from the robot's navigation in {ACCEPT_S:g} s")]
        return []

    def _repeat_cancel(self, goal: ActiveGoal, stopped_ns: int, now_ns: int) -> list[ev.RobotEffect]:
        if not self._cancel_timer.fire_if_due(now_ns):
            return []
        effects: list[ev.RobotEffect] = [ev.CancelGoal(goal.goal_id)]
        if now_ns - stopped_ns > seconds_to_ns(_UNCONFIRMED_S) and not goal.is_unconfirmed:
            self.active = replace(goal, is_unconfirmed=True)
            text = "the robot does not confirm that it stops; stop it by hand"
            effects += [PrintLine(text), _report(goal, text)]
            effects += self._answer_cancels(UNCONFIRMED, is_reached=False)
        return effects

    def _cancel_orphans(self, statuses: dict[bytes, ev.GoalStatus], now_ns: int) -> list[ev.RobotEffect]:
        """Cancel goals of SHARE that nobody follows: of a bridge that died, or given up for want of an
        answer."""
        own = None if self.active is None else self.active.goal_id
        orphans = [
            goal_id
            for goal_id, status in statuses.items()
            if goal_id.startswith(GOAL_PREFIX) and goal_id != own and status in _UNDER_WAY
        ]
        self._has_orphans = bool(orphans)
        if not orphans or not self._orphan_timer.fire_if_due(now_ns):
            return []
        text = "the robot was still driving to a goal that nobody follows; it is cancelled"
        return [PrintLine(text), *(ev.CancelGoal(goal_id) for goal_id in orphans)]

    def _end(self, text: str, is_reached: bool = False) -> list[ev.RobotEffect]:
        assert self.active is not None
        report = _report(self.active, text, is_final=True, is_reached=is_reached)
        is_stopped = self.active.stopped_ns is not None and not is_reached
        self.active = None
        answer = "cancelled" if is_stopped else f"the goal had ended: {text}"
        return [report, *self._answer_cancels(answer, is_reached=True)]

    def _answer_cancels(self, text: str, is_reached: bool) -> list[ev.RobotEffect]:
        """Tell all who wait for the end of the goal."""
        waiting, self._cancels = self._cancels, []
        return [
            ev.GoalReport(one.commander, text, is_final=True, is_reached=is_reached, goal_id=one.cancel_id)
            for one in waiting
            if one.cancel_id
        ]


_UNDER_WAY = (ev.GoalStatus.ACCEPTED, ev.GoalStatus.EXECUTING)


def _report(goal: ActiveGoal, text: str, is_final: bool = False, is_reached: bool = False) -> ev.GoalReport:
    return ev.GoalReport(goal.commander, text, is_final, is_reached, goal.goal_id)
