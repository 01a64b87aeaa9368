"""Where a headset's own space is in the map, from pairs of poses of one head that both drift."""

import numpy as np
import pytest
from helpers.headset_reference import PairOutcome, PosePair, SpaceAlignment
from helpers.headset_wearer import HZ, T_body_viewer, wearer

from share.geometry import se3


def aligned(
    pairs: list[PosePair], alignment: SpaceAlignment
) -> tuple[list[SpaceAlignment], list[PairOutcome]]:
    states, outcomes = [], []
    for pair in pairs:
        alignment, outcome = alignment.after(pair)
        states.append(alignment)
        outcomes.append(outcome)
    return states, outcomes


def errors_at(states: list[SpaceAlignment], pairs: list[PosePair], truth: np.ndarray) -> np.ndarray:
    """Return how far the viewer is drawn from its place (N, 6), rad and m."""
    drawn = np.stack([s.T_map_local @ p.T_local_viewer for s, p in zip(states, pairs, strict=True)])
    return se3.log(se3.inverse(truth) @ drawn)


def test_drawn_within_a_centimetre_and_a_fifth_of_a_degree() -> None:
    errors, nees = [], []
    for seed in range(8):
        pairs, truth = wearer(seed)
        states, outcomes = aligned(pairs, SpaceAlignment(T_body_viewer))
        assert outcomes[0] is PairOutcome.STARTED and set(outcomes[1:]) == {PairOutcome.USED}
        found = errors_at(states, pairs, truth)[2 * HZ :]
        errors.append(found)
        covs = [s.cov_at(p.T_local_viewer) for s, p in zip(states, pairs, strict=True)][2 * HZ :]
        nees.append(np.mean([e @ np.linalg.solve(c, e) / 6 for e, c in zip(found, covs, strict=True)]))
    rotation, translation = (np.linalg.norm(part, axis=1) for part in np.split(np.concatenate(errors), 2, 1))
    assert np.degrees(np.median(rotation)) < 0.2 and np.median(translation) < 0.01
    assert np.percentile(translation, 95) < 0.02
    assert 0.2 < np.mean(nees) < 1.5


def test_a_single_wrong_pair_is_refused_and_changes_nothing() -> None:
    pairs, _ = wearer(20)
    states, _ = aligned(pairs[:100], SpaceAlignment(T_body_viewer))
    jump = np.array([0, 0, 0, 0.2, 0, 0])
    wrong = PosePair(
        pairs[100].time_s,
        "map",
        pairs[100].T_map_body @ se3.exp(jump),
        pairs[100].cov,
        pairs[100].T_local_viewer,
    )
    after, outcome = states[-1].after(wrong)
    assert outcome is PairOutcome.REFUSED and after.T_map_local is states[-1].T_map_local
    assert after.after(pairs[101])[1] is PairOutcome.USED


def test_a_space_that_was_recentred_unnoticed_is_found_again_within_a_second() -> None:
    pairs, truth = wearer(21)
    moved = se3.exp(np.array([0, 0, 0.5, 0.3, -0.2, 0]))
    later = [
        PosePair(
            p.time_s,
            p.map_id,
            p.T_map_body,
            p.cov,
            moved @ p.T_local_viewer if k >= 300 else p.T_local_viewer,
        )
        for k, p in enumerate(pairs)
    ]
    states, outcomes = aligned(later, SpaceAlignment(T_body_viewer))
    assert outcomes.count(PairOutcome.RESTARTED) == 1
    assert outcomes.index(PairOutcome.RESTARTED) <= 300 + HZ
    assert np.linalg.norm(errors_at(states, later, truth)[320:, 3:], axis=1).max() < 0.03


def test_another_map_and_a_reset_begin_anew() -> None:
    pairs, _ = wearer(22)
    states, _ = aligned(pairs[:10], SpaceAlignment(T_body_viewer))
    other = PosePair(1.0, "other", pairs[10].T_map_body, pairs[10].cov, pairs[10].T_local_viewer)
    after, outcome = states[-1].after(other)
    assert outcome is PairOutcome.STARTED and after.map_id == "other"
    assert after.forgotten().T_map_local is None


@pytest.mark.parametrize("axis", range(3))
def test_a_mount_that_is_two_degrees_off_contradicts_itself(axis: int) -> None:
    """The alignment that fits one direction of the head does not fit another."""
    error = np.zeros(6)
    error[axis] = np.radians(2)
    pairs, _ = wearer(23, mount_error=error)
    _, outcomes = aligned(pairs, SpaceAlignment(T_body_viewer))
    assert outcomes.count(PairOutcome.USED) < 0.9 * len(outcomes)
