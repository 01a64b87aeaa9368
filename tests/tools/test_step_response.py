"""How a controlled quantity answers a step."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.experiments import experiment

module = experiment("step_response")
reversals, step_response = module.reversals, module.step_response

T_S = np.arange(0, 40, 0.5)


def test_a_clean_step_settles_without_overshoot() -> None:
    values = np.where(T_S < 20, 1.5, 0.5)
    found = step_response(T_S, values, 20.0, 40.0, 0.1)
    assert (found.before, found.final) == (1.5, 0.5)
    assert (found.settle_s, found.overshoot, found.reversals) == (0.0, 0.0, 0)


def test_a_slow_fall_settles_once_it_stays_within_the_tolerance() -> None:
    values = np.where(T_S < 20, 1.0, np.exp(-np.maximum(T_S - 20, 0)))
    found = step_response(T_S, values, 20.0, 40.0, 0.1)
    assert found.settle_s == pytest.approx(2.5)
    assert found.overshoot == pytest.approx(0.0, abs=1e-6) and found.reversals == 0


def test_an_overshoot_is_what_lies_beyond_the_final_value() -> None:
    since = np.maximum(T_S - 20, 0)
    values = np.where(T_S < 20, 0.0, 1 + 0.4 * np.exp(-since) * np.cos(since) * (since > 0))
    found = step_response(T_S, values, 20.0, 40.0, 0.1)
    assert found.overshoot == pytest.approx(0.213, abs=0.01)


def test_what_never_settles_takes_all_the_time_and_turns_each_time() -> None:
    values = np.where(T_S < 20, 1.0, 1 + 0.5 * (-1.0) ** np.arange(len(T_S)))
    found = step_response(T_S, values, 20.0, 40.0, 0.1)
    assert found.settle_s >= 19.5
    assert found.reversals == 38


def test_small_moves_are_no_reversals() -> None:
    assert reversals(np.array([1.0, 1.04, 1.0, 1.04, 0.5, 0.45, 0.48, 2.0])) == 1
    assert reversals(np.array([])) == reversals(np.array([1.0])) == 0
