"""Where odometry lies in the map, as an application may use it: without jumps."""

from __future__ import annotations

import numpy as np

from share.config import AgentConfig
from share.geometry import se3
from share.geometry.se3 import inverse
from share.protocol import agent_events as ev
from share.protocol.agent_ledger import LedgerEntry
from share.timing import SECOND_NS
from share.types import F64, Correction
from share.wire import messages as m


class BlendedMapFrame:
    """T_map_odom (4, 4) in force. Large changes are blended in along the geodesic of SE(3).

    How large a change is, is judged where the body is: a small turn moves what is far from the
    origin of odometry a long way.
    """

    def __init__(self, config: AgentConfig) -> None:
        self.map_id: str | None = None
        self._config = config
        self._target: F64 | None = None
        self._cov: F64 = np.zeros((6, 6))  # of the target
        self._blend_xi: F64 = np.zeros(6)  # from the target back to what was in force when the blend began
        self._blend_start_ns = 0

    def transform(self, now_ns: int) -> F64 | None:
        """T_map_odom at this time, None before the first correction."""
        if self._target is None:
            return None
        remaining = 1 - (now_ns - self._blend_start_ns) / (self._config.blend_s * SECOND_NS)
        if remaining <= 0 or not self._blend_xi.any():
            return self._target
        return self._target @ se3.exp(min(remaining, 1.0) * self._blend_xi)

    def sigma_cm(self, T_odom_body: F64) -> float:
        """cm, how unsure the body's place in the map is because that of odometry is; 0 without one."""
        if self._target is None:
            return 0.0
        cov = se3.compose_cov(T_odom_body, self._cov, np.zeros((6, 6)))
        return 100 * se3.position_sigma(cov)

    def apply(self, correction: Correction, T_odom_body: F64, now_ns: int) -> bool:
        """A new target from now on. Returns whether it lies in another map."""
        T_map_odom, map_id = correction.T_map_odom, correction.map_id
        current, same_map = self.transform(now_ns), map_id == self.map_id
        blend = current is not None and same_map and self._is_large(current, T_map_odom, T_odom_body)
        self._blend_xi = (
            se3.log(se3.inverse(T_map_odom) @ current) if blend and current is not None else np.zeros(6)
        )
        self._target, self._blend_start_ns, self.map_id = T_map_odom, now_ns, map_id
        self._cov = correction.cov
        return not same_map

    def reset(self) -> None:
        """Odometry broke: nothing is known until the next correction."""
        self._target = None

    def _is_large(self, T_old: F64, T_new: F64, T_odom_body: F64) -> bool:
        jump = se3.inverse(T_old @ T_odom_body) @ T_new @ T_odom_body
        shift, turn = np.linalg.norm(jump[:3, 3]), se3.rotation_angle(jump)
        return bool(shift > self._config.blend_jump_m or turn > self._config.blend_jump_rad)


# ---- Where an agent is: by its odometry, and by the map under it.


class MapLocalisation:
    """Of one agent. T_odom_body (4, 4): the newest, None before the first pose. frame: where odometry lies
    in the map."""

    def __init__(self, config: AgentConfig) -> None:
        self.T_odom_body: F64 | None = None
        self.map_frame = BlendedMapFrame(config)
        self._segment = 0  # of odometry, in the order in which they began

    def begin_segment(self) -> None:
        """Odometry begins anew, and nothing is known of where it lies."""
        self.map_frame.reset()
        self._segment += 1

    def localise(self, frame: ev.FrameTracked, T_odom_body: F64, now_ns: int) -> ev.LocalisedPose:
        """With the pose of a frame that has one."""
        self.T_odom_body = T_odom_body
        return ev.LocalisedPose(
            frame.index,
            frame.stamp_ns,
            frame.arrived_ns,
            self._segment,
            T_odom_body,
            self.map_frame.transform(now_ns),
            self.map_frame.map_id,
            frame.state,
        )

    def apply_correction(
        self, correction: Correction, entry: LedgerEntry | None, corrected_ms: float | None, now_ns: int
    ) -> ev.CorrectionApplied:
        """By one that is believed. entry: of the keyframe that it answers; corrected_ms: as there."""
        T_odom_body = correction.T_map_odom if self.T_odom_body is None else self.T_odom_body
        new_map = self.map_frame.apply(correction, T_odom_body, now_ns)
        return ev.CorrectionApplied(
            entry.keyframe.id if entry else None,
            entry.frame_index if entry else None,
            entry.keyframe.stamp_ns if entry else None,
            corrected_ms,
            correction.map_id,
            correction.revision,
            new_map,
        )


def pose_update(
    frame: ev.FrameTracked, T_odom_body: F64, last: LedgerEntry | None, first_of_segment: int
) -> m.PoseUpdate:
    """Relative to the last keyframe that the edge has, if it is of the present stretch. first_of_stretch: the
    lowest number that a keyframe of it may have."""
    if last is None or last.keyframe.id < first_of_segment:
        return m.PoseUpdate(frame.stamp_ns, frame.state, -1, T_odom_body)
    T_keyframe_body = inverse(last.keyframe.T_odom_body) @ T_odom_body
    return m.PoseUpdate(frame.stamp_ns, frame.state, last.keyframe.id, T_keyframe_body)
