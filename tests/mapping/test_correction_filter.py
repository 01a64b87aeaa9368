"""Which corrections are sent."""

from __future__ import annotations

import numpy as np

from share.geometry import se3
from share.mapping.corrections import CorrectionFilter
from share.types import Correction


def correction(
    shift_m: float = 0.0, turn_deg: float = 0.0, map_id: str = "a/0", answers: int = -1
) -> Correction:
    T = se3.exp(np.array([0, 0, np.radians(turn_deg), shift_m, 0, 0]))
    return Correction(T, np.eye(6), map_id, 0, 0, answers)


def test_what_moves_nobody_is_not_sent() -> None:
    concern = CorrectionFilter()
    assert concern.should_send("ann", correction())
    assert not concern.should_send("ann", correction(shift_m=0.0009))
    assert not concern.should_send("ann", correction(turn_deg=0.019))
    assert concern.should_send("bob", correction())


def test_small_steps_add_up() -> None:
    concern = CorrectionFilter()
    sent = [concern.should_send("ann", correction(shift_m=0.0004 * k)) for k in range(7)]
    assert sent == [True, False, False, True, False, False, True]


def test_an_answer_and_another_map_are_always_sent() -> None:
    concern = CorrectionFilter()
    concern.should_send("ann", correction())
    assert concern.should_send("ann", correction(answers=3))
    assert concern.should_send("ann", correction(map_id="b/0"))
    assert concern.should_send("ann", correction(turn_deg=0.021, map_id="b/0"))
