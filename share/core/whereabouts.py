"""Where an agent is: by its odometry, and by the map under it."""

from __future__ import annotations

from share.config import AgentConfig
from share.core import events as ev
from share.core.ledger import Entry
from share.core.map_frame import MapFrame
from share.geometry.se3 import inverse
from share.types import F64, Correction
from share.wire import messages as m


class Whereabouts:
    """Of one agent. T_odom_body (4, 4): the newest, None before the first pose. frame: where odometry lies
    in the map."""

    def __init__(self, config: AgentConfig) -> None:
        self.T_odom_body: F64 | None = None
        self.frame = MapFrame(config)
        self._stretch = 0  # of odometry, in the order in which they began

    def break_off(self) -> None:
        """Odometry begins anew, and nothing is known of where it lies."""
        self.frame.forget()
        self._stretch += 1

    def localised(self, frame: ev.FrameTracked, T_odom_body: F64, now_ns: int) -> ev.Localised:
        """With the pose of a frame that has one."""
        self.T_odom_body = T_odom_body
        return ev.Localised(
            frame.index,
            frame.stamp_ns,
            frame.arrived_ns,
            self._stretch,
            T_odom_body,
            self.frame.at(now_ns),
            self.frame.map_id,
            frame.state,
        )

    def correct(
        self, correction: Correction, entry: Entry | None, corrected_ms: float | None, now_ns: int
    ) -> ev.CorrectionApplied:
        """By one that is believed. entry: of the keyframe that it answers; corrected_ms: as there."""
        T_odom_body = correction.T_map_odom if self.T_odom_body is None else self.T_odom_body
        new_map = self.frame.correct(correction, T_odom_body, now_ns)
        return ev.CorrectionApplied(
            entry.keyframe.id if entry else None,
            entry.frame if entry else None,
            entry.keyframe.stamp_ns if entry else None,
            corrected_ms,
            correction.map_id,
            correction.revision,
            new_map,
        )


def pose_update(
    frame: ev.FrameTracked, T_odom_body: F64, last: Entry | None, first_of_stretch: int
) -> m.PoseUpdate:
    """Relative to the last keyframe that the edge has, if it is of the present stretch. first_of_stretch: the
    lowest number that a keyframe of it may have."""
    if last is None or last.keyframe.id < first_of_stretch:
        return m.PoseUpdate(frame.stamp_ns, frame.state, -1, T_odom_body)
    T_keyframe_body = inverse(last.keyframe.T_odom_body) @ T_odom_body
    return m.PoseUpdate(frame.stamp_ns, frame.state, last.keyframe.id, T_keyframe_body)
