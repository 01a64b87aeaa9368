"""Frames of agents for `share.lab.evaluate.simulation`, without a recording."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from helpers.edge_sim import Person

from share.geometry import se3
from share.lab.evaluate.simulation import TrackedFrame
from share.types import OdometryKeyframe

MS = 1_000_000


def tracked_frames(person: Person, seconds: float) -> Iterator[TrackedFrame]:
    """Yield 20 frames a second, every fifth a keyframe."""
    T_before = None
    for k in range(round(20 * seconds)):
        if k % 5:
            yield TrackedFrame(50 * k * MS, person.T_odom_body[-1], 0.5)
            continue
        T, view = person.step()
        T_last_body = T if T_before is None else se3.inverse(T_before) @ T
        candidate = OdometryKeyframe(T, T_last_body, person.cov, np.zeros(3), 0.0, view, T_before is None)
        T_before = T
        yield TrackedFrame(50 * k * MS, T, 0.5, candidate)
