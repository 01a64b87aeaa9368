"""How long each step of processing takes in a simulated room: drawn from quantiles of what was measured."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

MS_NS = 1_000_000


@dataclass(frozen=True)
class Delay:
    """Lognormal delay, ms, through two measured quantiles: half of all draws are below `p50`, 95 % below
    `p95`. It has no tail to speak of, so nothing follows from it about rare long delays."""

    p50: float
    p95: float

    def draw_ns(self, normal: float) -> int:
        """Return a delay, ns, for `normal`, a draw from the standard normal distribution."""
        sigma = math.log(max(1.0, self.p95 / self.p50)) / 1.645
        return round(self.p50 * math.exp(sigma * normal) * MS_NS)


@dataclass(frozen=True)
class MeasuredDelay:
    """Measured delay, ms: `ms` are quantiles at equal steps, from the minimum to the maximum."""

    ms: tuple[float, ...]

    def draw_ns(self, normal: float) -> int:
        """Return a delay, ns, for `normal`, a draw from the standard normal distribution."""
        below = 0.5 * (1 + math.erf(normal / math.sqrt(2)))
        return round(float(np.interp(below * (len(self.ms) - 1), range(len(self.ms)), self.ms)) * MS_NS)


# Keyframe work after a frame, ms; none after half of the frames. Measured on 1,301 frames of four recordings.
_SLICES = MeasuredDelay((*[0.0] * 11, 0.45, 2.2, 2.7, 3.5, 4.0, 4.7, 5.3, 5.6, 5.9, 8.2))


@dataclass(frozen=True)
class ProcessingDelays:
    """Delays of each processing step. Defaults: docs/lab/scheduling-figures.md.

    Agent: `frame`: from a frame to its published pose; `keyframe`: from there until its keyframe may be sent;
    `finish_keyframe`: slice of keyframe work that may follow any frame. Edge: `receive`: a message at the
    front; the rest: steps of mapper and solver. Those of images (`describe`, `align_*`, `verify_images_*`)
    were measured as CPU time in two emulated sessions of 640x480 px, 222 to 1,539 steps each; `index` for 16
    random views of 800 features, with their insertion.
    """

    frame: Delay = Delay(4.3, 5.4)
    keyframe: Delay = Delay(3.9, 4.7)
    finish_keyframe: Delay | MeasuredDelay = _SLICES
    receive: Delay = Delay(0.3, 1.0)
    add: Delay = Delay(0.4, 0.8)
    query: Delay = Delay(3.0, 5.0)
    verify_accepted: Delay = Delay(4.0, 6.0)
    verify_refused: Delay = Delay(2.0, 5.0)
    describe: Delay = Delay(5.8, 8.1)
    index: Delay = Delay(11.0, 33.0)
    align_accepted: Delay = Delay(4.8, 6.9)
    align_refused: Delay = Delay(4.0, 9.0)
    verify_images_accepted: Delay = Delay(16.7, 24.0)
    verify_images_refused: Delay = Delay(1.6, 9.3)
    check_loop: Delay = Delay(1.3, 10.0)
    solve: Delay = Delay(14.0, 32.0)
    apply_solution: Delay = Delay(2.2, 4.0)
