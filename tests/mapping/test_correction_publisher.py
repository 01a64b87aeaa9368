"""The filter of corrections that are sent."""

from __future__ import annotations

import numpy as np

from share.geometry import se3
from share.mapping.corrections import CorrectionPublisher
from share.mapping.map_solving import AppliedSolution
from share.types import Correction


def correction(
    shift_m: float = 0.0, turn_deg: float = 0.0, map_id: str = "a/0", answers: int = -1
) -> Correction:
    T = se3.exp(np.array([0, 0, np.radians(turn_deg), shift_m, 0, 0]))
    return Correction(T, np.eye(6), map_id, 0, 0, answers)


def is_sent(publisher: CorrectionPublisher, agent: str, correction: Correction) -> bool:
    events = publisher.publish("a/0", AppliedSolution({agent: correction}, "solved"))
    return [event.correction for event in events] == [correction]


def test_corrections_that_move_odom_unnoticeably_are_not_sent() -> None:
    publisher = CorrectionPublisher()
    assert is_sent(publisher, "ann", correction())
    assert not is_sent(publisher, "ann", correction(shift_m=0.0009))
    assert not is_sent(publisher, "ann", correction(turn_deg=0.019))
    assert is_sent(publisher, "bob", correction())


def test_small_changes_add_up() -> None:
    publisher = CorrectionPublisher()
    sent = [is_sent(publisher, "ann", correction(shift_m=0.0004 * k)) for k in range(7)]
    assert sent == [True, False, False, True, False, False, True]


def test_an_answer_and_another_map_are_always_sent() -> None:
    publisher = CorrectionPublisher()
    is_sent(publisher, "ann", correction())
    assert is_sent(publisher, "ann", correction(answers=3))
    assert is_sent(publisher, "ann", correction(map_id="b/0"))
    assert is_sent(publisher, "ann", correction(turn_deg=0.021, map_id="b/0"))


def test_a_correction_that_is_held_back_is_reported_once_for_each_map() -> None:
    publisher = CorrectionPublisher()
    held_back = AppliedSolution({}, "solved", waiting_sigma_m={"ann": 0.12})
    (event,) = publisher.publish("b/0", held_back)
    assert (event.agent, event.event, event.correction) == ("ann", "correction held back", None)
    assert event.reason == "its position in map b/0 is known to 12 cm"
    assert publisher.publish("b/0", held_back) == []
    assert len(publisher.publish("c/0", held_back)) == 1
    publisher.remove_agent("ann")
    assert len(publisher.publish("b/0", held_back)) == 1
