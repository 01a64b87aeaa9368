"""The agent's pose in the map: T_map_odom without visible steps, and its expected error."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from share.geometry import se3
from share.geometry.se3 import compose_cov, inverse, position_sigma, rotation_sigma
from share.mapping.localisation_gate import body_motion, length_ahead
from share.metrics.local_error import WINDOW_S
from share.protocol import agent_events as ev
from share.protocol.agent_ledger import LedgerEntry
from share.protocol.correction_delay import CorrectionDelay
from share.protocol.edge_clock import exponential_average
from share.timing import SECOND_NS, seconds_to_ns
from share.types import F64, Correction, Keyframe
from share.wire import messages as m

# The body and what is so far ahead move by at most this speed relative to odometry: 1 mm a frame at 15 Hz;
# faster, but less than 3 mm, where the way is long.
_SPEED_M_S, _LONG_MOTION_S, _MAX_SPEED_M_S = 0.0148, 10.0, 0.044
JUMP_M = 1.0  # a longer way is a mistake of the map that was undone: the pose jumps
_SETTLED_M, _ARRIVED_M = 1e-3, 1e-6  # of the way left
_MAX_FRAME_S = 0.1  # a frame after a gap moves the pose no further than one after this time


class MapFrame:
    """The present T_map_odom (4, 4), which follows the corrections without visible steps.

    The remaining correction, a motion of the body, decays with a time constant, at a limited speed. A newer
    correction changes the target, never the present pose. A correction into another map, or by a long way,
    applies at once: the pose jumps.
    """

    def __init__(self, time_constant_s: float) -> None:
        self.map_id: str | None = None
        self._time_constant_s = time_constant_s
        self._target: F64 | None = None
        self._current: F64 | None = None
        self._cov: F64 = np.zeros((6, 6))  # of the target
        self._advanced_ns = 0
        self._unsettled_since_ns: int | None = None

    def advance(self, T_odom_body: F64, now_ns: int) -> float | None:
        """Move towards the newest correction; once a frame. Return the time, s, that it took to settle, if it
        has settled now."""
        elapsed_s, self._advanced_ns = max(0, now_ns - self._advanced_ns) / SECOND_NS, now_ns
        if self._current is None or self._target is None or self._current is self._target:
            return None
        xi = body_motion(self._current, self._target, T_odom_body)
        length_m = length_ahead(xi)
        if length_m <= _ARRIVED_M:
            self._current = self._target
            return None
        elapsed_s = min(elapsed_s, _MAX_FRAME_S)
        speed = min(max(_SPEED_M_S, length_m / _LONG_MOTION_S), _MAX_SPEED_M_S)
        share = min(-math.expm1(-elapsed_s / self._time_constant_s), speed * elapsed_s / length_m)
        moved = self._current @ T_odom_body @ se3.exp(share * xi)
        self._current = se3.orthonormal(moved @ inverse(T_odom_body))
        if self._unsettled_since_ns is None or (1 - share) * length_m > _SETTLED_M:
            return None
        since_ns, self._unsettled_since_ns = self._unsettled_since_ns, None
        return (now_ns - since_ns) / SECOND_NS

    @property
    def T_map_odom(self) -> F64 | None:
        """The present transform (4, 4); None before the first correction."""
        return self._current

    def sigma_cm(self, T_odom_body: F64) -> float:
        """Return the standard deviation of the body's map position due to T_map_odom, cm; 0 without a
        correction."""
        if self._target is None:
            return 0.0
        return 100 * position_sigma(self.cov(T_odom_body))

    def cov(self, T_odom_body: F64) -> F64:
        """Return the covariance (6, 6) of the body's pose in the map that is due to the newest correction,
        perturbed on the right."""
        return compose_cov(T_odom_body, self._cov, np.zeros((6, 6)))

    def apply(self, correction: Correction, T_odom_body: F64, now_ns: int) -> bool:
        """Set a new target. Return whether the pose jumps to it."""
        target, is_same_map = correction.T_map_odom, correction.map_id == self.map_id
        motion_m = (
            0.0 if self._current is None else length_ahead(body_motion(self._current, target, T_odom_body))
        )
        jumps = self._current is None or not is_same_map or motion_m > JUMP_M
        self._target, self._cov, self.map_id = target, correction.cov, correction.map_id
        if jumps or self._current is None:
            self._current, self._unsettled_since_ns = target, None
        elif motion_m <= _SETTLED_M:
            self._unsettled_since_ns = None  # a correction that was taken back
        elif self._unsettled_since_ns is None:
            self._unsettled_since_ns = now_ns
        return jumps

    def reset(self) -> None:
        """Forget the transform: odometry broke."""
        self._target = self._current = self._unsettled_since_ns = None


_MAX_SETTLED = 1000


class MapLocalisation:
    """Pose of one agent in odom and in the map. T_odom_body (4, 4): the newest; None before the first
    pose."""

    def __init__(self, blend_s: float) -> None:
        self.T_odom_body: F64 | None = None
        self.map_frame = MapFrame(blend_s)
        self.settle_s: deque[float] = deque(maxlen=_MAX_SETTLED)  # times in which corrections came into force
        self._segment = 0  # number of the odometry segment

    def begin_segment(self) -> None:
        """Start a new odometry segment. Its place in the map is unknown."""
        self.map_frame.reset()
        self._segment += 1

    def localise(
        self, frame: ev.FrameTracked, T_odom_body: F64, drift_cov: F64, now_ns: int
    ) -> ev.LocalisedPose:
        """Return the localised pose of a frame that has one. T_odom_body (4, 4). drift_cov (6, 6): of
        odometry since the newest correction."""
        self.T_odom_body = T_odom_body
        settled_s = self.map_frame.advance(T_odom_body, now_ns)
        if settled_s is not None:
            self.settle_s.append(settled_s)
        times = frame.index, frame.stamp_ns, frame.arrived_ns
        T_map_odom, map_id = self.map_frame.T_map_odom, self.map_frame.map_id
        return ev.LocalisedPose(
            *times,
            self._segment,
            T_odom_body,
            T_map_odom,
            map_id,
            frame.state,
            frame.cov,
            frame.velocity,
            frame.angular_velocity,
            None if T_map_odom is None else self.map_frame.cov(T_odom_body) + drift_cov,
        )

    def apply_correction(
        self, correction: Correction, entry: LedgerEntry | None, corrected_ms: float | None, now_ns: int
    ) -> ev.CorrectionApplied:
        """Apply a valid correction. entry, corrected_ms: from `KeyframeLedger.record_correction`."""
        T_odom_body = correction.T_map_odom if self.T_odom_body is None else self.T_odom_body
        jumps = self.map_frame.apply(correction, T_odom_body, now_ns)
        answered: tuple[int | None, int | None, int | None] = (None, None, None)
        if entry is not None:
            answered = (entry.keyframe.id, entry.frame_index, entry.keyframe.stamp_ns)
        where = (correction.map_id, correction.revision, jumps)
        return ev.CorrectionApplied(*answered, corrected_ms, *where)


def pose_update(
    localised: ev.LocalisedPose, last: LedgerEntry | None, first_of_segment: int, now_ns: int
) -> m.PoseUpdate:
    """Return the pose relative to the last acknowledged keyframe `last`, or in odom if that is of an earlier
    segment. first_of_segment: lowest keyframe id of the present one."""
    age_ms = min(max(0.0, (now_ns - localised.arrived_ns) / 1e6), m.MAX_POSE_AGE_MS)
    keyframe, T = -1, localised.T_odom_body
    if last is not None and last.keyframe.id >= first_of_segment:
        keyframe, T = last.keyframe.id, inverse(last.keyframe.T_odom_body) @ T
    sigma_m, sigma_rad = _sigmas(localised.map_cov)
    return m.PoseUpdate(localised.stamp_ns, localised.state, keyframe, T, age_ms, sigma_m, sigma_rad)


def _sigmas(map_cov: F64 | None) -> tuple[float | None, float | None]:
    """Return the sigmas of a pose in the map, m and rad; None where its covariance (6, 6) says nothing."""
    if map_cov is None or not np.isfinite(map_cov).all():
        return None, None
    sigma_m, sigma_rad = (min(of(map_cov), m.MAX_SIGMA) for of in (position_sigma, rotation_sigma))
    return sigma_m, sigma_rad


class SelfEvaluation:
    """Estimates the delay and error that the agent reports. `drift` grows with odometry and is reset by
    corrections. local_cm: of the newest frame, as in `DriftEstimator.expected_cm`."""

    def __init__(self) -> None:
        self.drift, self.delay = DriftEstimator(), CorrectionDelay()
        self.local_cm: float | None = None
        self._processing_ms: float | None = None  # average

    def add_processing_time(self, ms: float) -> None:
        """Add the time from a frame's arrival to its keyframe candidate, ms."""
        self._processing_ms = exponential_average(self._processing_ms, ms)

    def add_keyframe(self, keyframe: Keyframe, frame: ev.FrameTracked) -> None:
        """Add a keyframe made of a frame."""
        self.drift.add_keyframe(keyframe, frame.arrived_ns)
        self.delay.add_keyframe(keyframe.id, frame.arrived_ns)
        self.local_cm = frame.error_cm

    def evaluation(
        self, keyframe: int, rtt_ms: float | None, localisation: MapLocalisation, now_ns: int
    ) -> m.Evaluation | None:
        """Return the evaluation to send with `keyframe`, or between two if -1, within the bounds of the wire;
        None before the first keyframe and round trip."""
        if rtt_ms is None or (delay_ms := self.delay.ms(now_ns)) is None:
            return None
        T_odom_body = localisation.T_odom_body
        map_sigma_cm = 0.0 if T_odom_body is None else localisation.map_frame.sigma_cm(T_odom_body)
        drift_cm, error_cm = self.drift.expected_cm(self.local_cm, now_ns), None
        if drift_cm is not None:
            error_cm = min(math.hypot(drift_cm, map_sigma_cm), m.MAX_ERROR_CM)
        return m.Evaluation(
            keyframe,
            min(delay_ms, m.MAX_DELAY_MS),
            error_cm,
            track_ms=min(self._processing_ms or 0.0, m.MAX_DELAY_MS),
            rtt_ms=min(rtt_ms, m.MAX_DELAY_MS),
            ack_ms=min(self.delay.ack_ms(now_ns), m.MAX_DELAY_MS),
            drift_cm=min(drift_cm or 0.0, m.MAX_ERROR_CM),
        )


_MAX_MOTIONS = 100  # keyframes since the last answered one; the motion of older ones is merged


# how far a random walk ends from its start, beside its RMS about the aligned truth: sqrt(10) on a straight
# path, sqrt(6) without rotation; of 22 agents, 0.5 to 20 s, 2.6 to 3.3 (docs/understand/scheduling.md)
WALK_PER_LOCAL = 2.9


class DriftEstimator:
    """Expected drift of odometry since the newest keyframe that a correction answered. Times: agent's clock,
    ns."""

    def __init__(self) -> None:
        self._since_ns: int | None = None
        self._motions: deque[tuple[int, int, F64, F64]] = deque()  # keyframe id, time, T_last_this, cov
        self._cov: F64 | None = None  # of them all, once it is asked for

    def add_keyframe(self, keyframe: Keyframe, sent_ns: int) -> None:
        """Add a sent keyframe. One without a reference starts a segment with zero drift."""
        self._cov = None
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
        self._cov = None
        while self._motions and self._motions[0][0] <= keyframe:
            self._since_ns = self._motions.popleft()[1]

    def expected_cm(self, local_cm: float | None, now_ns: int) -> float | None:
        """Return the expected position error of the newest sent keyframe, cm; None before the first.

        local_cm: error of odometry within `WINDOW_S` (`share.metrics.local_error`), from which the drift of a
        random walk follows. None: use the covariances of odometry.
        """
        if self._since_ns is None:
            return None
        if local_cm is not None:
            age = max(0, now_ns - self._since_ns) / seconds_to_ns(WINDOW_S)
            return WALK_PER_LOCAL * local_cm * math.sqrt(age)
        return 100 * position_sigma(self.cov)

    @property
    def cov(self) -> F64:
        """The covariance (6, 6) of odometry from the newest keyframe that a correction answered to the newest
        sent one, perturbed on the right."""
        if self._cov is None:
            self._cov = np.zeros((6, 6))
            for _, _, T, added_cov in self._motions:
                self._cov = compose_cov(T, self._cov, added_cov)
        return self._cov
