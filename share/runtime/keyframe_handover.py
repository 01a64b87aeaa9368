"""Keyframes on their way into the mapper's process: names take turns, and few are under way at once.

A pipe keeps its order, so what is in it waits for all that was sent before: a flood of one agent's keyframes
would delay those of all others by seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from share.protocol.edge_events import AddKeyframe
from share.protocol.keyframe_intake import FairQueue

_MAX_IN_FLIGHT = 32  # keyframes sent to the mapper and not added yet: some 30 ms of its work


@dataclass(frozen=True)
class KeyframesAdded:
    """The mapper has added so many keyframes."""

    count: int


class KeyframeHandover:
    """Sends keyframes to the mapper by `send`."""

    def __init__(self, send: Callable[[AddKeyframe], None]) -> None:
        self._send, self._waiting, self._in_flight_count = send, FairQueue[AddKeyframe](), 0

    def add(self, effect: AddKeyframe) -> None:
        name = effect.key.rpartition("-")[0]  # `new_run_key`
        self._waiting.add(name, effect)
        self._send_waiting()

    def record_added(self, added: KeyframesAdded) -> None:
        self._in_flight_count -= added.count
        self._send_waiting()

    def flush(self) -> None:
        """Send all that waits: the mapper is about to end."""
        while (effect := self._waiting.take_next()) is not None:
            self._send(effect)

    def _send_waiting(self) -> None:
        while self._in_flight_count < _MAX_IN_FLIGHT and (effect := self._waiting.take_next()) is not None:
            self._in_flight_count += 1
            self._send(effect)
