"""Agents that may enter another map settle there before they are shown it.

Once the localisation gate is open, an agent's next keyframes are aligned with the images around it, from the
map's pose. They correct most of the error that remains: shown at once, the pose would move in the first
second (a wearer 12 mm off was 4 mm off one second later).
"""

from __future__ import annotations

from collections.abc import Collection

SETTLING_KEYFRAMES = 2  # of the agent, after the gate has opened
MAX_SOLUTIONS = 100  # of the map, thirty a second at most: an agent that stands still makes no keyframes


class Settling:
    """Segments that settle in a map, given by their indices; ordinals number the keyframes of a segment."""

    def __init__(self) -> None:
        # By segment: reference segment of the map, newest keyframe when the gate opened, solutions since.
        self._since: dict[int, tuple[int, int, int]] = {}

    def begin(self, segment: int, reference_segment: int, ordinal: int) -> None:
        """The gate of a map has opened for a segment with this newest keyframe."""
        self._since[segment] = reference_segment, ordinal, 0

    def is_settling(self, segment: int, reference_segment: int) -> bool:
        return segment in self._since and self._since[segment][0] == reference_segment

    def continues(self, segment: int, reference_segment: int, ordinal: int) -> bool:
        """Count a solution of the map with this newest keyframe of the segment. Return whether the segment
        still settles."""
        if not self.is_settling(segment, reference_segment):
            return False
        _, first_ordinal, solution_count = self._since[segment]
        if ordinal >= first_ordinal + SETTLING_KEYFRAMES or solution_count >= MAX_SOLUTIONS:
            del self._since[segment]
            return False
        self._since[segment] = reference_segment, first_ordinal, solution_count + 1
        return True

    def forget_all_but(self, segments: Collection[int]) -> None:
        """Forget all but these segments: the others have no keyframes."""
        self._since = {s: since for s, since in self._since.items() if s in segments}
