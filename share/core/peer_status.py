"""What an agent last said of its own state, and how old that is by the edge's clock."""

from __future__ import annotations

from typing import Any

from share.core.rate import SECOND_NS, seconds
from share.types import TrackState
from share.wire.messages import Status

SILENT_S = 0.7  # an agent says something twice a second; after this what it said is not shown as its state
SILENT = "SILENT"
_UNHEARD = "not heard since the map was taken up again"


class PeerStatus:
    """Fed with what the agent says; `report` is true of the moment that it is asked for."""

    def __init__(self) -> None:
        self.state = TrackState.INITIALISING
        self._reason = ""
        self._age_ms: float | None = None  # of the newest pose, when `_at_ns` was
        self._at_ns = 0
        self._has_left = False

    def told(self, status: Status, now_ns: int) -> None:
        self.state, self._reason, self._has_left = status.state, status.reason, False
        self._age_ms, self._at_ns = status.pose_age_ms, now_ns

    def posed(self, state: TrackState, now_ns: int) -> None:
        """A pose has come. It is about as old as the newest was when the agent last said how old that was."""
        if state is not self.state:
            self._reason = ""
        self.state, self._has_left = state, False
        if state.has_pose:
            self._at_ns = now_ns

    def left(self) -> None:
        """It said bye: its silence is no news."""
        self._has_left = True

    def report(self, now_ns: int, heard_ns: int | None) -> dict[str, Any]:
        """Plain data. state: SILENT where nothing was heard for SILENT_S. pose_age_ms: None if never told.
        heard_ns: when the agent was last heard; None: not in this life of the edge."""
        if heard_ns is None:
            return {"state": SILENT, "reason": _UNHEARD, "pose_age_ms": None, "heard_s": None}
        silent_ns = max(0, now_ns - heard_ns)
        since_ms = max(0, now_ns - self._at_ns) / 1e6
        silent = silent_ns > seconds(SILENT_S) and not self._has_left
        reason = f"silent for {silent_ns / SECOND_NS:.1f} s; its last state was {self.state}"
        return {
            "state": SILENT if silent else str(self.state),
            "reason": reason if silent else self._reason,
            "pose_age_ms": None if self._age_ms is None else round(self._age_ms + since_ms, 1),
            "heard_s": round(silent_ns / SECOND_NS, 3),
        }
