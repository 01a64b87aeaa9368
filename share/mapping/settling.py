"""Agents that may enter another map settle there before they are shown it.

Once the localisation gate is open, an agent's next keyframes are aligned with the images around it, from the
map's pose. They correct most of the error that remains: shown at once, the pose would move in the first
second (a wearer 12 mm off was 4 mm off one second later). Who makes no keyframes meanwhile, standing still or
on a machine that lags, has nothing to settle by and enters after some time.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

SETTLING_KEYFRAMES = 2  # of the agent, after the gate has opened: 0.6 to 1 s of a walk
MAX_SETTLING_S = 1.5


class _Begun(NamedTuple):
    """When the gate opened: in which map, the segment's newest keyframe, and the time."""

    reference_segment: int
    ordinal: int
    time_s: float


class Settling:
    """Segments that settle in a map, given by their indices; ordinals number the keyframes of a segment."""

    def __init__(self) -> None:
        self._now_s = 0.0
        self._begun: dict[int, _Begun] = {}

    def begin(self, segment: int, reference_segment: int, ordinal: int) -> None:
        """The gate of a map has opened for a segment with this newest keyframe."""
        self._begun[segment] = _Begun(reference_segment, ordinal, self._now_s)

    def is_settling(self, segment: int, reference_segment: int) -> bool:
        return segment in self._begun and self._begun[segment].reference_segment == reference_segment

    def continues(self, segment: int, reference_segment: int, ordinal: int) -> bool:
        """Return whether the segment, with this newest keyframe in a solution of the map, still settles."""
        if not self.is_settling(segment, reference_segment):
            return False
        if ordinal < self._begun[segment].ordinal + SETTLING_KEYFRAMES:
            return True
        del self._begun[segment]
        return False

    def end_overdue(self, now_s: float) -> list[int]:
        """Note the time (s, of any clock that goes on). Return the segments that have settled for too long;
        they no longer do."""
        self._now_s = now_s
        overdue = [s for s, begun in self._begun.items() if now_s - begun.time_s >= MAX_SETTLING_S]
        for segment in overdue:
            del self._begun[segment]
        return overdue

    def forget_all_but(self, segments: Collection[int]) -> None:
        """Forget all but these segments: the others have no keyframes."""
        self._begun = {s: begun for s, begun in self._begun.items() if s in segments}
