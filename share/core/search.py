"""Which candidates for a keyframe's place are tried: as many as are worth it, fewer while others wait."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

from share.config import Config


class Effort(NamedTuple):
    """enough: verified candidates after which the rest is left alone. While others wait one is, and no more
    than `hurried` are tried."""

    enough: int
    hurried: int

    @classmethod
    def of(cls, config: Config) -> Effort:
        return cls(config.place.enough, config.edge.hurry_candidates)


class Search:
    """For the place of keyframe `number`; candidates: best first. What comes to wait meanwhile hurries it."""

    def __init__(self, number: int, candidates: Iterable[int], effort: Effort) -> None:
        self.number = number
        self._left, self._effort = deque(candidates), effort
        self._tried = self._verified = 0

    def next(self, in_a_hurry: bool) -> int | None:
        """The candidate to try now; None when there are no more, or enough."""
        most = self._effort.hurried if in_a_hurry else self._tried + 1
        enough = 1 if in_a_hurry else self._effort.enough
        if not self._left or self._tried >= most or self._verified >= enough:
            return None
        self._tried += 1
        return self._left.popleft()

    def verified(self) -> None:
        """The last one is it."""
        self._verified += 1
