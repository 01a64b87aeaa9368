"""Probability of the merge gate, by hand and in draws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from share.config import ControlConfig
from share.scheduling.merge_gate import MergeGate

volumes = st.lists(st.floats(0, 1e3), max_size=40)


def gate_after(eagerness: float, window: int, *volumes: float) -> MergeGate:
    """A gate that has completed merges of these overlaps, m^3."""
    gate = MergeGate(ControlConfig(eagerness=eagerness, merges=window), "share")
    for volume in volumes:
        gate.record_merge(volume)
    return gate


@pytest.mark.parametrize(
    ("volume", "probability"), [(0.0, 1.0), (1.0, 0.8), (2.5, 0.5), (4.0, 0.2), (5.0, 0.0), (50.0, 0.0)]
)
def test_probability_by_hand(volume: float, probability: float) -> None:
    gate = gate_after(0.8, 3, 100.0, 2.0, 6.0, 4.0)  # the first is out of the window: mean 4
    assert gate.skip_probability(volume, same_map=True) == pytest.approx(probability, abs=1e-12)


@pytest.mark.parametrize(
    ("done", "same_map", "probability"),
    [((), True, 0.0), ((0.0, 0.0), True, 0.0), ((10.0,), True, 1.0), ((10.0,), False, 0.0)],
)
def test_nothing_is_skipped_without_completed_merges_or_between_two_maps(
    done: tuple[float, ...], same_map: bool, probability: float
) -> None:
    gate = gate_after(0.75, 20, *done)
    assert gate.skip_probability(0.0, same_map) == probability
    assert {bool(gate.skip_reason(0.0, same_map)) for _ in range(20)} == {probability == 1}


def test_merges_are_skipped_as_often_as_the_probability_says() -> None:
    gate = gate_after(0.8, 20, *range(1, 40))  # mean of the last 20: 29.5
    n = 50_000
    for volume in (5.0, 20.0, 36.0):
        p = gate.skip_probability(volume, same_map=True)
        skipped = sum(bool(gate.skip_reason(volume, same_map=True)) for _ in range(n))
        assert abs(skipped - n * p) <= 4.5 * np.sqrt(n * p * (1 - p))  # 7 in a million by chance


@given(volumes, st.floats(0, 1e3), st.floats(0, 1e3), st.floats(0, 5))
def test_the_probability_falls_with_the_overlap(
    done: list[float], one: float, other: float, eagerness: float
) -> None:
    gate = gate_after(eagerness, 20, *done)
    more, less = (gate.skip_probability(v, same_map=True) for v in (max(one, other), min(one, other)))
    assert 0 <= more <= less <= 1


@pytest.mark.parametrize(
    ("eagerness", "share"),
    [(0.75, 1 - 0.8834 / 2), (ControlConfig().eagerness, 1 - 0.3936 / 2)],  # 1.5
)
def test_share_of_uniformly_distributed_overlaps_that_pass(
    eagerness: float, share: float, rng: np.random.Generator
) -> None:
    """All beyond t = mean / eagerness, below it v / t of them: so the mean is (1/2 - t^2 / 6) / (1 - t / 2),
    and 1 - t / 2 pass. 0.75: the paper's merges per metre, 0.06 of 0.11."""
    gate, passed, n = gate_after(eagerness, 20), 0, 20_000
    for volume in rng.random(n).tolist():
        if not gate.skip_reason(volume, same_map=True):
            gate.record_merge(volume)
            passed += 1
    assert passed / n == pytest.approx(share, abs=0.02)
