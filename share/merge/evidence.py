"""What loops that tell one story are worth together.

Neighbouring views of one spot are one witness, not many, so places are counted. And copies match worse than
the place itself: of what two views should share if they stand as the loop says, they share less. A story
weighs its places times the square of that share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from share.config import MergeConfig
from share.merge.chart import Chart
from share.merge.join import Loop
from share.merge.places import distinct
from share.types import F64

_USUAL = 0.5  # found where nobody has looked: what most true loops have


@dataclass(frozen=True)
class Evidence:
    """Of a story, as seen from near: at how many places, the mean share that was found, and how many
    keyframes there are on either side, the lesser (one view can fool us many times)."""

    places: int = 0
    found: float = 0.0
    keyframes: int = 0

    @property
    def weight(self) -> float:
        return self.places * self.found**2

    def __str__(self) -> str:
        return f"{self.places} places (weight {self.weight:.2f})"


def near(loop: Loop, config: MergeConfig) -> bool:
    """Whether both views were from about the same spot: copies are told apart from near, if at all."""
    away, turned = loop.apart
    return away <= config.near_m and turned <= config.near_rad


def weigh(loops: Sequence[Loop], chart: Chart, config: MergeConfig) -> Evidence:
    """Places are counted on either side, the lesser; loops that were not seen from near say nothing."""
    seen = [loop for loop in loops if near(loop, config)]
    if not seen:
        return Evidence()
    sides: dict[int, list[F64]] = {}
    for loop in seen:
        for number in chart.ends(loop):
            sides.setdefault(chart.trails.nodes[number].stretch, []).append(chart.poses[number])
    count = min(places(poses, config) for poses in sides.values())
    told = [loop.found for loop in seen if loop.found is not None]
    found = float(np.mean(told)) if told else _USUAL
    keyframes = min(len({loop.a for loop in seen}), len({loop.b for loop in seen}))
    return Evidence(count, found, keyframes)


def places(poses: Sequence[F64], config: MergeConfig, enough: int | None = None) -> int:
    """How many places these poses (4, 4) are; counted no further than `enough`."""
    return distinct(np.array(poses), config.place_m, config.place_rad, enough)
