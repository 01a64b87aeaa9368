"""A client of Nav2's action NavigateToPose by DDS: goal, cancellation, status, feedback, reason of a failure.

The robot's replies do not say which request they answer, in a form that Cyclone can read; so the status
topic decides (`goal_control`), and replies only explain.
"""

from __future__ import annotations

import math
from typing import Any

from share.robot import robot_events as ev
from share.robot import ros_types as types
from share.robot.ros_topics import RosTopics, taken

_ACTION = "navigate_to_pose/_action"


class NavigateClient:
    """has_error_code: whether results are known to have a reason; Humble's have none."""

    def __init__(self, topics: RosTopics) -> None:
        self.has_error_code = False
        self._goal = topics.writer(
            f"{_ACTION}/send_goalRequest", types.SendGoalRequest, depth=10, prefix="rq"
        )
        self._cancel = topics.writer(
            f"{_ACTION}/cancel_goalRequest", types.CancelGoalRequest, depth=10, prefix="rq"
        )
        self._ask = topics.writer(
            f"{_ACTION}/get_resultRequest", types.GetResultRequest, depth=10, prefix="rq"
        )
        self._answers = topics.reader(f"{_ACTION}/send_goalReply", types.SendGoalResponse, prefix="rr")
        self._results = topics.reader(f"{_ACTION}/get_resultReply", types.GetResultResponse, prefix="rr")
        self._status = topics.reader(f"{_ACTION}/status", types.GoalStatusArray, latched=True)
        self._feedback = topics.reader(f"{_ACTION}/feedback", types.NavigateFeedbackMessage)

    def poll(self) -> list[ev.RobotEvent]:
        """Return what has come; never waits."""
        events: list[ev.RobotEvent] = [
            ev.StatusReceived(
                tuple(
                    (bytes(goal.goal_info.goal_id.uuid), ev.GoalStatus.of_ros(goal.status))
                    for goal in message.status_list
                )
            )
            for message in taken(self._status, types.GoalStatusArray)
        ]
        for one in taken(self._feedback, types.NavigateFeedbackMessage)[-1:]:
            events.append(ev.FeedbackReceived(bytes(one.goal_id.uuid), one.feedback.distance_remaining))
        events += [
            ev.GoalAnswered(bool(one.accepted)) for one in taken(self._answers, types.SendGoalResponse)
        ]
        if self.has_error_code:
            events += [
                ev.ResultReceived(int(one.result.error_code), one.result.error_msg)
                for one in taken(self._results, types.GetResultResponse)
            ]
        return events

    def send(self, goal: ev.SendGoal) -> None:
        pose = types.RosPose(
            types.RosPoint(goal.T_map_base.x, goal.T_map_base.y, 0.0), _heading(goal.T_map_base.yaw)
        )
        stamped = types.RosPoseStamped(types.RosHeader(types.ros_time(goal.stamp_ns), "map"), pose)
        self._goal.write(types.SendGoalRequest(_uuid(goal.goal_id), types.NavigateGoal(stamped, "")))

    def cancel(self, goal_id: bytes) -> None:
        """Ask the robot to give up this goal, and no other."""
        self._cancel.write(types.CancelGoalRequest(types.GoalInfo(_uuid(goal_id), types.RosTime())))

    def ask_result(self, goal_id: bytes) -> None:
        if self.has_error_code:
            self._ask.write(types.GetResultRequest(_uuid(goal_id)))

    def servers(self) -> list[Any]:
        """Return the publishers of status, one for each navigation server."""
        handles = self._status.get_matched_publications()
        found = [self._status.get_matched_publication_data(handle) for handle in handles]
        return [one for one in found if one is not None]

    @property
    def is_matched(self) -> bool:
        """Whether the server's ends of goal and cancellation are known."""
        return bool(self._goal.get_matched_subscriptions()) and bool(self._cancel.get_matched_subscriptions())

    def user_data(self) -> tuple[bytes | None, bytes | None]:
        """Return the user data of the publishers of results and of feedback; None before they are found."""
        return _user_data(self._results), _user_data(self._feedback)


def _user_data(reader: Any) -> bytes | None:
    for handle in reader.get_matched_publications():
        if (data := reader.get_matched_publication_data(handle)) is not None:
            return b"".join(policy.data for policy in data.qos if type(policy).__name__ == "Userdata")
    return None


def _uuid(goal_id: bytes) -> Any:
    return types.RosUUID(list(goal_id))


def _heading(yaw: float) -> Any:
    return types.RosQuaternion(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
