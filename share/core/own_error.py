"""What an agent tells the edge of its own delay and error with each keyframe."""

from __future__ import annotations

import math

from share.core.clock import smoothed
from share.core.drift import Drift
from share.core.map_frame import MapFrame
from share.types import F64
from share.wire.messages import MAX_DELAY_MS, MAX_ERROR_CM, Evaluation


class OwnError:
    """`drift` grows with odometry and is answered by corrections."""

    def __init__(self, tell_placement: bool) -> None:
        """tell_placement: what the map is unsure of this agent's place counts too."""
        self.drift = Drift()
        self._tell_placement = tell_placement
        self._processing_ms: float | None = None  # from a frame's arrival to its keyframe, of late

    def processed(self, ms: float) -> None:
        """A frame became a candidate so long after it came."""
        self._processing_ms = smoothed(self._processing_ms, ms)

    def evaluation(
        self,
        keyframe: int,
        rtt_ms: float,
        local_cm: float | None,
        T_odom_body: F64 | None,
        placed: MapFrame,
        now_ns: int,
    ) -> Evaluation:
        """local_cm: as for `Drift.expected_cm`. Bounded by what the wire carries."""
        error_cm = self.drift.expected_cm(local_cm, now_ns)
        if error_cm is not None and T_odom_body is not None and self._tell_placement:
            error_cm = math.hypot(error_cm, placed.spread_cm(T_odom_body))
        if error_cm is not None:
            error_cm = min(error_cm, MAX_ERROR_CM)
        delay_ms = min(rtt_ms + (self._processing_ms or 0.0), MAX_DELAY_MS)
        return Evaluation(keyframe, delay_ms, error_cm)
