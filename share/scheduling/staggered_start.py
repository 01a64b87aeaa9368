"""When agents that begin together send their first keyframe: one after another, as the air takes them.

Twelve first keyframes at once make each other late, each by all of them; in turns, each by those before it.
An agent that joins alone starts at once.
"""

from __future__ import annotations

from share.timing import SECOND_NS, seconds_to_ns

UNKNOWN_KEYFRAME_S = 0.06  # default before any measurement: 30 kB at 5 Mbit/s
MAX_HOLD_S = 2.0  # longer, and a keyframe is stale: rather on a full air
_LEAST_SLOT_S = 0.002


class StaggeredStart:
    """Turns of one room. Times: the edge's clock, ns."""

    def __init__(self) -> None:
        self._free_ns = 0  # when the air is done with the first keyframes that have a turn

    def hold_ms(self, keyframe_s: float | None, now_ns: int) -> float:
        """Give an agent that begins its turn, and return how far off that is, ms. keyframe_s: how long a
        keyframe takes on the air; None: not measured yet."""
        slot_s = UNKNOWN_KEYFRAME_S if keyframe_s is None else max(keyframe_s, _LEAST_SLOT_S)
        turn_ns = min(max(now_ns, self._free_ns), now_ns + seconds_to_ns(MAX_HOLD_S))
        self._free_ns = turn_ns + seconds_to_ns(min(slot_s, MAX_HOLD_S))
        return 1e3 * (turn_ns - now_ns) / SECOND_NS
