"""How much one agent may make the mapper work, whatever runs it begins."""

from __future__ import annotations

from share.core.rate import TokenBucket
from share.types import Keyframe

# Of every keypoint the mapper's work is about the same, and of a keyframe without any as of so many
# (docs/robustness.md). An agent of the shipped settings sends keyframes of 500, at most 5 a second
# (control.rate_max_hz), and to a new edge at once what its ledger holds, 600. Twice that rate is taken in,
# and 700 at once.
_BARE = 250
_KEYFRAME = 500 + _BARE
_HZ, _BURST = 10.0 * _KEYFRAME, 700.0 * _KEYFRAME
_SAID = f"keyframes come with more than {_HZ / _KEYFRAME * 500:.0f} keypoints a second: the rest waits"


class Allowance:
    """Of each name."""

    def __init__(self) -> None:
        self._of_name: dict[str, TokenBucket] = {}

    def objection(self, name: str, keyframe: Keyframe, now_ns: int) -> str | None:
        """Why this keyframe is not taken in now; None: it is, and counts."""
        if name not in self._of_name:
            self._of_name = {who: kept for who, kept in self._of_name.items() if not kept.is_full(now_ns)}
            self._of_name[name] = TokenBucket(_BURST, _HZ)
        cost = len(keyframe.view.uv) + _BARE
        return None if self._of_name[name].take(now_ns, cost=cost) else _SAID
