"""The merge gate's probability, exact and in draws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from share.config import ControlConfig
from share.scheduling.merge_gate import MergeGateState

volumes = st.lists(st.floats(0, 1e3), max_size=40)


def after(gate: MergeGateState, *volumes: float) -> MergeGateState:
    for volume in volumes:
        gate = gate.after_merge(volume)
    return gate


@pytest.mark.parametrize(
    ("volume", "probability"), [(0.0, 1.0), (1.0, 0.8), (2.5, 0.5), (4.0, 0.2), (5.0, 0.0), (50.0, 0.0)]
)
def test_probability_by_hand(volume: float, probability: float) -> None:
    gate = after(
        MergeGateState(eagerness=0.8, window=3), 100.0, 2.0, 6.0, 4.0
    )  # the first is forgotten: mean 4
    assert gate.skip_probability(volume, same_map=True) == pytest.approx(probability, abs=1e-12)


def test_nothing_is_skipped_without_anything_to_compare_or_between_maps() -> None:
    gate = MergeGateState(0.75, 20)
    assert not gate.should_skip(0.0, same_map=True, draw=0.0)
    assert not after(gate, 0.0, 0.0).should_skip(0.0, same_map=True, draw=0.0)
    assert after(gate, 10.0).should_skip(0.0, same_map=True, draw=0.9999999)
    assert not after(gate, 10.0).should_skip(0.0, same_map=False, draw=0.0)


def test_draws_skip_as_often_as_they_should(rng: np.random.Generator) -> None:
    gate = after(MergeGateState(0.8, 20), *range(1, 40))  # mean of the last 20: 29.5
    n = 100_000
    for volume in (5.0, 20.0, 36.0):
        p = gate.skip_probability(volume, same_map=True)
        skipped = sum(gate.should_skip(volume, True, draw) for draw in rng.random(n).tolist())
        assert abs(skipped - n * p) <= 4.5 * np.sqrt(n * p * (1 - p))  # 7 in a million by chance


@given(volumes, st.floats(0, 1e3), st.floats(0, 1e3), st.floats(0, 5))
def test_it_is_a_probability_that_falls_with_overlap(
    done: list[float], one: float, other: float, eagerness: float
) -> None:
    gate = after(MergeGateState(eagerness, 20), *done)
    assert len(gate.overlap_volumes) == min(20, len(done))
    more, less = (gate.skip_probability(v, same_map=True) for v in (max(one, other), min(one, other)))
    assert 0 <= more <= less <= 1


@pytest.mark.parametrize(
    ("eagerness", "part"),
    [(0.75, 1 - 0.8834 / 2), (ControlConfig().eagerness, 1 - 0.3936 / 2)],  # 1.5
)
def test_how_many_of_evenly_spread_overlaps_pass(
    eagerness: float, part: float, rng: np.random.Generator
) -> None:
    """All beyond t = mean / eagerness, below it v / t of them: so the mean is (1/2 - t^2 / 6) / (1 - t / 2),
    and 1 - t / 2 pass. 0.75: the paper's merges per metre, 0.06 of 0.11."""
    gate, passed, n = MergeGateState(eagerness, 20), 0, 20_000
    for volume, draw in rng.random((n, 2)).tolist():
        if not gate.should_skip(volume, True, draw):
            gate, passed = gate.after_merge(volume), passed + 1
    assert passed / n == pytest.approx(part, abs=0.02)
