"""How much one agent may make the mapper work, whatever runs it begins."""

from __future__ import annotations

from share.core.rate import Buckets
from share.types import Keyframe

# Of every keypoint the mapper's work is about the same, and of a keyframe without any as of so many
# (docs/robustness.md). An agent of the shipped settings sends keyframes of 500, at most 5 a second
# (control.rate_max_hz), and to a new edge at once what its ledger holds, 600. Twice that rate is taken in,
# and 700 at once.
_BARE = 250
_KEYFRAME = 500 + _BARE
_HZ, _BURST = 10.0 * _KEYFRAME, 700.0 * _KEYFRAME
_FOUNDING = 20  # times: what begins a stretch of odometry stays in the mapper for as long as it runs
_SAID = f"keyframes come with more than {_HZ / _KEYFRAME * 500:.0f} keypoints a second: the rest waits"
_SLACK, _AT_ONCE = 1.2, 10.0  # rates arrive a little uneven


class Allowance:
    """Of each name. most_hz: keyframes a second that an agent may send; None: any number."""

    def __init__(self, most_hz: float | None) -> None:
        self._work = Buckets(_BURST, _HZ)
        self._asked = Buckets(_AT_ONCE, None if most_hz is None else _SLACK * most_hz)

    def objection(self, name: str, keyframe: Keyframe, now_ns: int) -> str | None:
        """Why this keyframe is not taken in now; None: it is, and counts."""
        cost = (len(keyframe.view.uv) + _BARE) * (1 if keyframe.reference >= 0 else _FOUNDING)
        return None if self._work.of(name, now_ns).take(now_ns, cost=cost) else _SAID

    def is_extra(self, name: str, now_ns: int) -> bool:
        """Whether this keyframe, which is taken in, is more than its agent was ever asked for."""
        return not self._asked.of(name, now_ns).take(now_ns)
