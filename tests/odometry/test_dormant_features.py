"""Dormant features: what is kept, found again in the nearest keyframes, and forgotten."""

from dataclasses import replace

import numpy as np
import pytest

from share.geometry import se3
from share.geometry.camera import Camera
from share.odometry import state
from share.odometry.dormant_features import DormantFeatures
from share.odometry.feature_appearance import Appearance, empty_appearance
from share.odometry.state import FilterState, initial_state
from share.vision.patches import OFFSETS, Patches

CAMERA = Camera(640, 480, 400.0, 400.0, 320.0, 240.0, ())
KNOWN = 0.004  # 1/m: 2 % of the inverse depths below


def appearance_of(ids: np.ndarray) -> Appearance:
    """Appearance whose patches have the features' ids as gray levels."""
    n, s = len(ids), len(OFFSETS)
    gray = np.broadcast_to(ids[:, None, None], (n, 3, s)).astype(np.float32)
    zeros = [np.zeros((n, *shape), np.float32) for shape in ((), (2, 2), (4, s), (4, 4), (4,))]
    patch = Patches(zeros[0], zeros[1], gray, *zeros[2:])
    pairs = np.zeros((n, 2))
    return Appearance(
        patch, np.zeros((n, 2, 2)), pairs, np.ones(n), pairs.astype(np.float32), pairs, np.full(n, 9)
    )


def room(counts: list[int], sigma: float = KNOWN) -> FilterState:
    """A body that stood at x = 0, 0.1, ... m, with `counts` features ahead from each place."""
    s = initial_state(0, np.eye(4), *np.zeros((3, 3)), np.eye(4), np.ones(22))
    first = 0
    for k, count in enumerate(counts):
        s.T = se3.from_rt(np.eye(3), np.array([0.1 * k, 0.0, 0.0]))
        index = state.add_keyframe(s, k, np.zeros(3))
        ray = np.random.default_rng(k).uniform(-0.3, 0.3, (count, 2))
        ids = np.arange(first, first + count)
        state.add_features(s, ids, np.full(count, index), ray, np.full(count, 0.2), sigma * (1 + ids * 1e-3))
        first += count
    return s


def deactivate(dormant: DormantFeatures, s: FilterState, ids: list[int]) -> None:
    indices = np.flatnonzero(np.isin(s.feature_ids, ids))
    dormant.deactivate(s, appearance_of(s.feature_ids), indices)


def found_ids(dormant: DormantFeatures, s: FilterState) -> list[int]:
    found = dormant.nearby(s, CAMERA)
    if found is None:
        return []
    assert (found.appearance.patch.gray[:, 0] == found.ids).all(), "each has its own patch"
    own = np.searchsorted(s.feature_ids, found.ids)
    assert (found.anchor == s.anchor[own]).all() and (found.ray == s.ray[own]).all()
    return found.ids.tolist()


def test_the_nearest_keyframes_come_first_and_their_features_as_they_came():
    dormant, s = DormantFeatures(), room([3, 3])
    assert dormant.nearby(s, CAMERA) is None
    deactivate(dormant, s, [4])
    deactivate(dormant, s, [0, 2])
    deactivate(dormant, s, [3])
    assert found_ids(dormant, s) == [4, 3, 0, 2]


def test_rows_are_used_again_without_losing_a_feature():
    dormant, s = DormantFeatures(), room([20, 20])
    kept: set[int] = set()
    rng = np.random.default_rng(5)
    for _ in range(30):
        new = [int(i) for i in rng.permutation(40)[:7] if i not in kept]
        deactivate(dormant, s, new)
        gone = rng.permutation(sorted(kept))[:5].astype(np.int64)
        dormant.reactivate(gone)
        kept = (kept | set(new)) - set(gone.tolist())
        assert set(found_ids(dormant, s)) == kept


def test_features_of_dropped_keyframes_are_forgotten():
    dormant, s = DormantFeatures(), room([3, 3])
    deactivate(dormant, s, [0, 1, 5])
    assert dormant.has_features(np.array([0, 1, 7])).tolist() == [True, True, False]
    dormant.drop_keyframes(np.array([0]))
    assert dormant.has_features(np.array([0, 1])).tolist() == [False, True]
    assert found_ids(dormant, s) == [5]


def test_a_keyframe_keeps_its_most_certain_forty():
    dormant, s = DormantFeatures(), room([60])
    deactivate(dormant, s, list(range(60)))
    assert found_ids(dormant, s) == list(range(40))


@pytest.mark.parametrize(("age", "sigma", "is_kept"), [(9, KNOWN, True), (4, KNOWN, False), (9, 0.02, False)])
def test_only_features_seen_often_with_a_known_depth_are_kept(age, sigma, is_kept):
    dormant, s = DormantFeatures(), room([1], sigma)
    appearance = replace(appearance_of(s.feature_ids), age=np.array([age]))
    dormant.deactivate(s, appearance, np.array([0]))
    assert bool(found_ids(dormant, s)) == is_kept


def test_nothing_to_deactivate_changes_nothing():
    dormant, s = DormantFeatures(), room([2])
    dormant.deactivate(s, empty_appearance(), np.zeros(0, np.int64))
    assert dormant.nearby(s, CAMERA) is None
