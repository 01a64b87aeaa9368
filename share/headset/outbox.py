"""What one page is still to be sent: the newest of each thing. A slow page skips and never has a backlog."""

from __future__ import annotations

from typing import Any

MAX_REPLIES = 256  # answers that wait; a page with more does not read
POSES_S = 1 / 60  # between messages with poses: agents of 30 Hz do not keep step with each other
MAX_UNSEEN = 16  # messages with poses on their way: what waits in sockets and in the browser is out of reach


class Outbox:
    """Messages for one page. Times are monotonic, s."""

    def __init__(self) -> None:
        self.is_overfull = False
        self._replies: list[dict[str, Any]] = []
        self._objects: dict[int, dict[str, Any]] = {}
        self._removed: dict[int, str] = {}
        self._has_all = False
        self._robots: dict[str | None, dict[str, Any]] = {}
        self._poses: dict[str, dict[str, Any]] = {}
        self._poses_due_s = 0.0
        self._sent_poses = self._seen_poses = 0  # messages

    def reply(self, message: dict[str, Any]) -> None:
        """Add a message that must not be left out."""
        if len(self._replies) >= MAX_REPLIES:
            self.is_overfull = True
        else:
            self._replies.append(message)

    def put_poses(self, poses: list[dict[str, Any]]) -> None:
        for pose in poses:
            old = self._poses.get(pose["agent"], {})
            self._poses[pose["agent"]] = {"path": old["path"], **pose} if "path" in old else pose

    def mark_seen(self, count: int) -> None:
        """Note that the page has handled its first `count` messages with poses."""
        self._seen_poses = max(self._seen_poses, min(count, self._sent_poses))

    def put_object(self, one: dict[str, Any]) -> None:
        self._removed.pop(one["id"], None)
        self._objects[one["id"]] = one

    def remove_object(self, object_id: int, reason: str) -> None:
        self._objects.pop(object_id, None)
        self._removed[object_id] = reason

    def put_all_objects(self, objects: list[dict[str, Any]]) -> None:
        """Replace what the page has by these objects."""
        self._objects = {one["id"]: one for one in objects}
        self._removed, self._has_all = {}, True

    def put_robot(self, robot: dict[str, Any]) -> None:
        self._robots[robot["robot"]] = robot

    def take_replies(self) -> list[dict[str, Any]]:
        """Return the answers that wait."""
        out, self._replies = self._replies, []
        return out

    def take(self, now_s: float) -> list[dict[str, Any]]:
        """Return the messages to send now."""
        out = self.take_replies()
        if self._objects or self._removed or self._has_all:
            removed = [{"id": key, "reason": reason} for key, reason in self._removed.items()]
            objects = list(self._objects.values())
            message = {"type": "objects", "all": self._has_all, "objects": objects, "removed": removed}
            out.append(message)
            self._objects, self._removed, self._has_all = {}, {}, False
        if self._robots:
            out.append({"type": "robots", "robots": list(self._robots.values())})
            self._robots = {}
        if self._has_poses_to_send and now_s >= self._poses_due_s:
            self._poses_due_s = now_s + POSES_S
            self._sent_poses += 1
            out.append({"type": "poses", "n": self._sent_poses, "poses": list(self._poses.values())})
            self._poses = {}
        return out

    def wait_s(self, now_s: float) -> float | None:
        """Return after how long there is something to send; None: not by time alone."""
        return max(0.0, self._poses_due_s - now_s) if self._has_poses_to_send else None

    @property
    def _has_poses_to_send(self) -> bool:
        return bool(self._poses) and self._sent_poses - self._seen_poses < MAX_UNSEEN
