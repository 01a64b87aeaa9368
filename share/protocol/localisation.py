"""The agent's pose in the map: T_map_odom without jumps, and its expected error."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from share.geometry import se3
from share.geometry.se3 import compose_cov, inverse, position_sigma
from share.metrics.local_error import WINDOW_S
from share.protocol import agent_events as ev
from share.protocol.agent_ledger import LedgerEntry
from share.protocol.edge_clock import exponential_average
from share.timing import SECOND_NS, seconds_to_ns
from share.types import F64, Correction, Keyframe
from share.wire import messages as m

# A correction that moves the body further, or rotates it further, is blended in.
BLEND_JUMP_M, BLEND_JUMP_RAD = 0.05, 0.02


class BlendedMapFrame:
    """T_map_odom (4, 4) in force. Large changes are blended in along the geodesic of SE(3).

    The size of a change is judged at the body: far from the odometry origin a small rotation moves it far.
    """

    def __init__(self, blend_s: float) -> None:
        self.map_id: str | None = None
        self._blend_s = blend_s
        self._target: F64 | None = None
        self._cov: F64 = np.zeros((6, 6))  # of the target
        self._blend_xi: F64 = np.zeros(6)  # from the target to the transform in force when the blend began
        self._blend_start_ns = 0

    def transform(self, now_ns: int) -> F64 | None:
        """Return T_map_odom (4, 4) at `now_ns`; None before the first correction."""
        if self._target is None:
            return None
        remaining = 1 - (now_ns - self._blend_start_ns) / (self._blend_s * SECOND_NS)
        if remaining <= 0 or not self._blend_xi.any():
            return self._target
        return self._target @ se3.exp(min(remaining, 1.0) * self._blend_xi)

    def sigma_cm(self, T_odom_body: F64) -> float:
        """Return the standard deviation of the body's map position due to T_map_odom, cm; 0 without a
        correction."""
        if self._target is None:
            return 0.0
        return 100 * position_sigma(compose_cov(T_odom_body, self._cov, np.zeros((6, 6))))

    def apply(self, correction: Correction, T_odom_body: F64, now_ns: int) -> bool:
        """Set a new target. Return whether it is in another map."""
        T_map_odom, map_id = correction.T_map_odom, correction.map_id
        current, same_map = self.transform(now_ns), map_id == self.map_id
        self._blend_xi = np.zeros(6)
        if current is not None and same_map and _is_large(current, T_map_odom, T_odom_body):
            self._blend_xi = se3.log(inverse(T_map_odom) @ current)
        self._target, self._blend_start_ns, self.map_id = T_map_odom, now_ns, map_id
        self._cov = correction.cov
        return not same_map

    def reset(self) -> None:
        """Forget the transform: odometry broke."""
        self._target = None


def _is_large(T_old: F64, T_new: F64, T_odom_body: F64) -> bool:
    jump = inverse(T_old @ T_odom_body) @ T_new @ T_odom_body
    return bool(np.linalg.norm(jump[:3, 3]) > BLEND_JUMP_M or se3.rotation_angle(jump) > BLEND_JUMP_RAD)


class MapLocalisation:
    """Pose of one agent in odom and in the map. T_odom_body (4, 4): the newest; None before the first
    pose."""

    def __init__(self, blend_s: float) -> None:
        self.T_odom_body: F64 | None = None
        self.map_frame = BlendedMapFrame(blend_s)
        self._segment = 0  # number of the odometry segment

    def begin_segment(self) -> None:
        """Start a new odometry segment. Its place in the map is unknown."""
        self.map_frame.reset()
        self._segment += 1

    def localise(self, frame: ev.FrameTracked, T_odom_body: F64, now_ns: int) -> ev.LocalisedPose:
        """Return the localised pose of a frame that has one. T_odom_body (4, 4)."""
        self.T_odom_body = T_odom_body
        times = frame.index, frame.stamp_ns, frame.arrived_ns
        T_map_odom, map_id = self.map_frame.transform(now_ns), self.map_frame.map_id
        return ev.LocalisedPose(*times, self._segment, T_odom_body, T_map_odom, map_id, frame.state)

    def apply_correction(
        self, correction: Correction, entry: LedgerEntry | None, corrected_ms: float | None, now_ns: int
    ) -> ev.CorrectionApplied:
        """Apply a valid correction. entry, corrected_ms: from `KeyframeLedger.record_correction`."""
        T_odom_body = correction.T_map_odom if self.T_odom_body is None else self.T_odom_body
        new_map = self.map_frame.apply(correction, T_odom_body, now_ns)
        answered: tuple[int | None, int | None, int | None] = (None, None, None)
        if entry is not None:
            answered = (entry.keyframe.id, entry.frame_index, entry.keyframe.stamp_ns)
        where = (correction.map_id, correction.revision, new_map)
        return ev.CorrectionApplied(*answered, corrected_ms, *where)


def pose_update(
    frame: ev.FrameTracked, T_odom_body: F64, last: LedgerEntry | None, first_of_segment: int
) -> m.PoseUpdate:
    """Return the pose relative to the last acknowledged keyframe `last`, or in odom if that is of an earlier
    segment. first_of_segment: lowest keyframe id of the present one."""
    if last is None or last.keyframe.id < first_of_segment:
        return m.PoseUpdate(frame.stamp_ns, frame.state, -1, T_odom_body)
    T_keyframe_body = inverse(last.keyframe.T_odom_body) @ T_odom_body
    return m.PoseUpdate(frame.stamp_ns, frame.state, last.keyframe.id, T_keyframe_body)


class SelfEvaluation:
    """Estimates the delay and error that the agent reports with each keyframe. `drift` grows with odometry
    and is reset by corrections."""

    def __init__(self) -> None:
        self.drift = DriftEstimator()
        self._processing_ms: float | None = None  # average

    def add_processing_time(self, ms: float) -> None:
        """Add the time from a frame's arrival to its candidate, ms."""
        self._processing_ms = exponential_average(self._processing_ms, ms)

    def evaluation(
        self, keyframe: int, rtt_ms: float, local_cm: float | None, map_sigma_cm: float, now_ns: int
    ) -> m.Evaluation:
        """Return the evaluation to send with `keyframe`, within the bounds of the wire.

        local_cm: as in `DriftEstimator.expected_cm`. map_sigma_cm: as in `BlendedMapFrame.sigma_cm`."""
        error_cm = self.drift.expected_cm(local_cm, now_ns)
        if error_cm is not None:
            error_cm = min(math.hypot(error_cm, map_sigma_cm), m.MAX_ERROR_CM)
        return m.Evaluation(keyframe, min(rtt_ms + (self._processing_ms or 0.0), m.MAX_DELAY_MS), error_cm)


_MAX_MOTIONS = 100  # keyframes since the last answered one; the motion of older ones is merged


class DriftEstimator:
    """Expected drift of odometry since the newest keyframe that a correction answered. Times: agent's clock,
    ns."""

    def __init__(self) -> None:
        self._since_ns: int | None = None
        self._motions: deque[tuple[int, int, F64, F64]] = deque()  # keyframe id, time, T_last_this, cov

    def add_keyframe(self, keyframe: Keyframe, sent_ns: int) -> None:
        """Add a sent keyframe. One without a reference starts a segment with zero drift."""
        if keyframe.reference < 0 or self._since_ns is None:
            self._motions.clear()
            self._since_ns = sent_ns
            return
        self._motions.append((keyframe.id, sent_ns, keyframe.T_ref_body, keyframe.cov))
        if len(self._motions) > _MAX_MOTIONS:
            _, _, _, cov = self._motions.popleft()
            second, second_ns, T, added_cov = self._motions.popleft()
            self._motions.appendleft((second, second_ns, T, compose_cov(T, cov, added_cov)))

    def correct(self, keyframe: int) -> None:
        """Drop the drift up to this keyframe, which a correction answers."""
        while self._motions and self._motions[0][0] <= keyframe:
            self._since_ns = self._motions.popleft()[1]

    def expected_cm(self, local_cm: float | None, now_ns: int) -> float | None:
        """Return the expected position error of the newest sent keyframe, cm; None before the first.

        local_cm: error of odometry within `WINDOW_S` (`share.metrics.local_error`), scaled as a random walk.
        None: use the covariances of odometry.
        """
        if self._since_ns is None:
            return None
        if local_cm is not None:
            return local_cm * math.sqrt(min(1.0, max(0, now_ns - self._since_ns) / seconds_to_ns(WINDOW_S)))
        cov = np.zeros((6, 6))
        for _, _, T, added_cov in self._motions:
            cov = compose_cov(T, cov, added_cov)
        return 100 * position_sigma(cov)
