"""Keyframes that wait to be taken into the map, of each name in turn: who sends many waits for itself."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")

_MOST_MS = 10.0  # that keyframes are taken in before one is looked up


class Turns(Generic[T]):
    """In order of arrival of each name."""

    def __init__(self) -> None:
        self._waiting: dict[str, deque[T]] = {}  # whose turn is next first

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    def add(self, name: str, what: T) -> None:
        self._waiting.setdefault(name, deque()).append(what)

    def next(self, spent_ms: float = 0.0) -> T | None:
        """What is taken in now. spent_ms: on those before it, since a keyframe was last looked up. None:
        there is nothing, or it is time to look one up."""
        if not self._waiting or spent_ms >= _MOST_MS:
            return None
        name = next(iter(self._waiting))
        queue = self._waiting.pop(name)
        what = queue.popleft()
        if queue:
            self._waiting[name] = queue
        return what
