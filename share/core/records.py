"""What the edge writes down: a decision, its reason, and when; what a peer can cause at any rate, seldom."""

from __future__ import annotations

from typing import Any

from share.core.edge_events import Record
from share.core.throttle import Throttle

_HZ, _BURST = 1.0, 20.0  # records of one kind that one agent can cause,
_LASTING_HZ, _LASTING_BURST = 1 / 60, 200.0  # and those if it goes on causing them


class Records:
    """began_ns: times count from here; None: from the first event."""

    def __init__(self, began_ns: int | None) -> None:
        self._began_ns = began_ns
        self._throttle, self._lasting = Throttle(_HZ, _BURST), Throttle(_LASTING_HZ, _LASTING_BURST)

    def begin(self, now_ns: int) -> None:
        """An event has come."""
        self._began_ns = now_ns if self._began_ns is None else self._began_ns

    def since_began_s(self, now_ns: int) -> float:
        assert self._began_ns is not None
        return round((now_ns - self._began_ns) * 1e-9, 6)

    def of(self, now_ns: int, what: str, agent: str | None, reason: str, **fields: Any) -> Record:
        head = {"t_s": self.since_began_s(now_ns), "event": what, "agent": agent, "reason": reason}
        return Record(head | fields)

    def seldom(self, now_ns: int, what: str, agent: str | None, reason: str, **fields: Any) -> Record | None:
        """None where so many of this kind and agent have just been written; the next one counts them."""
        held_back = self._throttle.admit((what, agent), now_ns)
        if held_back is None:
            return None
        held_back = self._lasting.admit((what, agent), now_ns, held_back)
        if held_back is None:
            return None
        more = f" (and {held_back} more since the last line)" if held_back else ""
        return self.of(now_ns, what, agent, f"{reason}{more}", **fields)
