"""Who is kept out, and for how long: longer with each time. Pure: time comes as an argument."""

from __future__ import annotations

FIRST_S = 10.0
MOST_S = 600.0
_REMEMBERED = 256


class KeepOut:
    """By name: a key or an address. After MOST_S without an offence one begins anew."""

    def __init__(self) -> None:
        self._ends: dict[str, tuple[float, float]] = {}  # until when and for how long, oldest first

    def offend(self, who: str, now_s: float) -> float:
        """For how many seconds it is kept out from now."""
        until_s, lasted_s = self._ends.pop(who, (now_s, 0.0))
        forgiven = now_s > until_s + MOST_S
        lasts_s = (
            FIRST_S
            if forgiven or not lasted_s
            else lasted_s
            if now_s < until_s
            else min(2 * lasted_s, MOST_S)
        )
        if len(self._ends) >= _REMEMBERED:
            del self._ends[min(self._ends, key=lambda name: self._ends[name][0])]
        self._ends[who] = now_s + lasts_s, lasts_s
        return lasts_s

    def holds(self, who: str, now_s: float) -> bool:
        return who in self._ends and now_s < self._ends[who][0]
