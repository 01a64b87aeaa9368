"""How a controlled quantity answers a step: when it settles, how far it overshoots, how often it turns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.types import F64

TURN = 0.05  # smaller moves are no reversal


@dataclass(frozen=True)
class StepResponse:
    """before, final: mean over the last third before the step, and of the time after it. settle_s: after
    the step, until the value stays within the tolerance of final. overshoot: beyond final, away from before;
    where both are within the tolerance, the largest deviation. reversals: changes of direction."""

    before: float
    final: float
    settle_s: float
    overshoot: float
    reversals: int


def step_response(t_s: F64, values: F64, step_s: float, end_s: float, tolerance: float) -> StepResponse:
    """Return the response of values (N,) at rising times (N,) to a step, until `end_s`."""
    earlier, later = t_s < step_s, (t_s >= step_s) & (t_s < end_s)
    ahead, after, after_s = values[earlier], values[later], t_s[later] - step_s
    before = float(ahead[-max(1, len(ahead) // 3) :].mean()) if len(ahead) else float("nan")
    final = float(after[-max(1, len(after) // 3) :].mean())
    off = np.abs(after - final)
    outside = np.flatnonzero(off > tolerance)
    settled = 0 if not len(outside) else int(outside[-1]) + 1
    settle_s = float(after_s[settled]) if settled < len(after_s) else float(end_s - step_s)
    change = final - before
    moved = np.abs(change) > tolerance
    overshoot = max(0.0, float((np.sign(change) * (after - final)).max())) if moved else float(off.max())
    return StepResponse(before, final, settle_s, overshoot, reversals(after))


def reversals(values: F64) -> int:
    """Return how often values (N,) change their direction; moves up to TURN do not count."""
    turns, direction, extreme = 0, 0, float(values[0]) if len(values) else 0.0
    for value in values.tolist():
        move = value - extreme
        if abs(move) > TURN and np.sign(move) != direction:
            turns += direction != 0
            direction, extreme = int(np.sign(move)), value
        elif move * direction > 0:
            extreme = value
    return turns
