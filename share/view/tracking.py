"""The live room of `share track --view`: one agent, in the frame of its odometry."""

from __future__ import annotations

from typing import Any

import numpy as np

from share.geometry.camera import Rig
from share.geometry.se3 import inverse
from share.mapping.loops import KeyframeKey
from share.odometry.track_result import TrackResult
from share.types import AgentKind, OdometryKeyframe
from share.view import events as ev
from share.view import sources
from share.view.feed import ViewFeed

# By the wall clock: a recording is tracked faster than it was made.
_POSES_S, _REPORT_S = 0.05, 0.5


class TrackedAgent:
    """Sends the poses and keyframes of one tracked agent to a feed."""

    def __init__(self, feed: ViewFeed, name: str, rig: Rig) -> None:
        self._feed, self._run, self._rig = feed, name, rig
        self._segment, self._keyframes = -1, 0
        self._newest: OdometryKeyframe | None = None
        self._last_pose_s, self._last_report_s = -_POSES_S, -_REPORT_S
        feed.add_event(sources.run_event(name, name, AgentKind.AR, rig))

    def add(
        self, result: TrackResult, candidate: OdometryKeyframe | None, track_ms: float, now_s: float
    ) -> None:
        """Add a frame. track_ms: until its pose was there. now_s: monotonic."""
        if result.new_segment:
            self._newest = None
        if candidate is not None:
            self._add_keyframe(candidate)
        if result.T_odom_body is not None and now_s - self._last_pose_s >= _POSES_S:
            self._last_pose_s = now_s
            T, id_ = result.T_odom_body, -1
            if self._newest is not None:
                T, id_ = inverse(self._newest.T_odom_body) @ T, self._keyframes - 1
            self._feed.add_event(ev.PoseArrived(self._run, result.state, id_, T, track_ms))
        if now_s - self._last_report_s >= _REPORT_S:
            self._last_report_s = now_s
            self._feed.add_report({"agents": {self._run: self._report(result, track_ms)}})

    def _report(self, result: TrackResult, track_ms: float) -> dict[str, Any]:
        """Return the agent's entry as in edge.json, as far as there is one without an edge."""
        return {
            "run": self._run,
            "kind": str(AgentKind.AR),
            "state": str(result.state),
            "gone": False,
            "keyframes": self._keyframes,
            "pose_ms": track_ms,
        }

    def _add_keyframe(self, candidate: OdometryKeyframe) -> None:
        begins, self._newest = self._newest is None, candidate
        points = sources.points_in_body(candidate.view, candidate.image, self._rig)
        key, jpeg = KeyframeKey(self._run, self._keyframes), candidate.image.jpeg.tobytes()
        self._keyframes += 1
        self._feed.add_event(ev.KeyframeArrived(key, begins, candidate.T_odom_body, points, jpeg))
        if begins:
            self._segment += 1
            place = ev.CorrectionArrived(self._run, f"odom {self._segment}", np.eye(4), key.id)
            self._feed.add_event(place)
