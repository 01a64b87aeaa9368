"""That poses come late is said, since nothing else shows it where no frame is left out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from share.core.own_status import LATE_S

_SAID_S = 1.0  # the first warning; the next at twice what was said
_MEND = (
    "consider agent.late_ms, by which frames that are late are left out, smaller images or a faster machine"
)


class Lateness:
    """Counts frames whose pose came more than LATE_S after their image, and says how late poses are, once and
    again where that doubles."""

    def __init__(self, say: Callable[[str], None], slow: str) -> None:
        """slow: who is to blame, such as "this machine"."""
        self._say, self._slow = say, slow
        self._next_s = _SAID_S
        self._frames, self._most_s = 0, 0.0

    def done(self, track_ms: float) -> None:
        """A frame is tracked, so long after its image came."""
        late_s = track_ms / 1e3
        self._frames += late_s > LATE_S
        self._most_s = max(self._most_s, late_s)
        if late_s >= self._next_s:
            self._next_s = 2 * late_s
            self._say(f"poses are {late_s:.1f} s late: {self._slow} is too slow for this source; {_MEND}")

    def report(self) -> dict[str, Any]:
        return {"frames_late": self._frames, "latest_s": round(self._most_s, 3)}
