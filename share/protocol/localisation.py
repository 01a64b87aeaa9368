"""The agent's pose in the map: T_map_odom without jumps, and the pose messages made with it."""

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

    The size of a change is judged at the body: far from the odometry origin a small rotation moves it far.
    """

    def __init__(self, config: AgentConfig) -> None:
        self.map_id: str | None = None
        self._config = config
        self._target: F64 | None = None
        self._cov: F64 = np.zeros((6, 6))  # of the target
        self._blend_xi: F64 = np.zeros(6)  # from the target to the transform in force when the blend began
        self._blend_start_ns = 0

    def transform(self, now_ns: int) -> F64 | None:
        """Return T_map_odom (4, 4) at `now_ns`; None before the first correction."""
        if self._target is None:
            return None
        remaining = 1 - (now_ns - self._blend_start_ns) / (self._config.blend_s * SECOND_NS)
        if remaining <= 0 or not self._blend_xi.any():
            return self._target
        return self._target @ se3.exp(min(remaining, 1.0) * self._blend_xi)

    def sigma_cm(self, T_odom_body: F64) -> float:
        """Return the standard deviation of the body's map position due to T_map_odom, cm; 0 without a
        correction."""
        if self._target is None:
            return 0.0
        cov = se3.compose_cov(T_odom_body, self._cov, np.zeros((6, 6)))
        return 100 * se3.position_sigma(cov)

    def apply(self, correction: Correction, T_odom_body: F64, now_ns: int) -> bool:
        """Set a new target. Return whether it is in another map."""
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
        """Forget the transform: odometry broke."""
        self._target = None

    def _is_large(self, T_old: F64, T_new: F64, T_odom_body: F64) -> bool:
        jump = se3.inverse(T_old @ T_odom_body) @ T_new @ T_odom_body
        shift, turn = np.linalg.norm(jump[:3, 3]), se3.rotation_angle(jump)
        return bool(shift > self._config.blend_jump_m or turn > self._config.blend_jump_rad)


class MapLocalisation:
    """Pose of one agent in odom and in the map. T_odom_body (4, 4): the newest; None before the first
    pose."""

    def __init__(self, config: AgentConfig) -> None:
        self.T_odom_body: F64 | None = None
        self.map_frame = BlendedMapFrame(config)
        self._segment = 0  # number of the odometry segment

    def begin_segment(self) -> None:
        """Start a new odometry segment. Its place in the map is unknown."""
        self.map_frame.reset()
        self._segment += 1

    def localise(self, frame: ev.FrameTracked, T_odom_body: F64, now_ns: int) -> ev.LocalisedPose:
        """Return the localised pose of a frame that has one. T_odom_body (4, 4)."""
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
        """Apply a valid correction. entry, corrected_ms: from `KeyframeLedger.record_correction`."""
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
    """Return the pose relative to the last acknowledged keyframe `last`, or in odom if that is of an earlier
    segment. first_of_segment: lowest keyframe id of the present one."""
    if last is None or last.keyframe.id < first_of_segment:
        return m.PoseUpdate(frame.stamp_ns, frame.state, -1, T_odom_body)
    T_keyframe_body = inverse(last.keyframe.T_odom_body) @ T_odom_body
    return m.PoseUpdate(frame.stamp_ns, frame.state, last.keyframe.id, T_keyframe_body)
