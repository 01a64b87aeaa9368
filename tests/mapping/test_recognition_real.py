"""Recognition on real images: no false loop is accepted, and most true ones are.

True: cameras less than 1 m and 30 degrees apart. False: accepted with a pose that is wrong by more
than 0.25 m or 5 degrees.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from helpers.place_real import Seen, load

from share.config import PlaceConfig
from share.geometry import se3
from share.mapping.recognition.index import PlaceIndex
from share.mapping.recognition.verification import Verification, verify


@pytest.fixture(scope="module")
def euroc(shared_data: Path) -> Seen:
    return load(shared_data / "real" / "euroc_v1_01_keyframes")


@pytest.fixture(scope="module")
def kitchen(shared_data: Path) -> Seen:
    return load(shared_data / "real" / "redkitchen_0000_0499", step=25, upright=False)


def true_pairs(seen: Seen) -> set[tuple[int, int]]:
    metres, degrees = seen.relative()
    near = (metres < 1) & (degrees < 30) & ~np.eye(len(seen.sights), dtype=bool)
    return {(int(i), int(j)) for i, j in zip(*np.nonzero(near), strict=True)}


def accepted(seen: Seen, pairs: Iterable[tuple[int, int]]) -> dict[tuple[int, int], tuple[float, float]]:
    """Pairs (query, candidate) that verification accepts, with the error of their pose: m, deg."""
    out = {}
    for q, c in pairs:
        found = verify(seen.sights[q], seen.sights[c])
        if isinstance(found, Verification):
            apart = se3.inverse(se3.inverse(seen.T_world_body[c]) @ seen.T_world_body[q]) @ found.T_c_q
            out[q, c] = float(np.linalg.norm(apart[:3, 3])), float(np.degrees(se3.rotation_angle(apart)))
    return out


def false_ones(found: dict[tuple[int, int], tuple[float, float]]) -> list[tuple[int, int]]:
    return [pair for pair, (metres, degrees) in found.items() if metres > 0.25 or degrees > 5]


def candidates(index: PlaceIndex, seen: Seen) -> list[tuple[int, int]]:
    return [
        (q, c.id)
        for q, camera_view in enumerate(seen.sights)
        for c in index.query(camera_view.view.descriptors, PlaceConfig().candidates, exclude=[q])
        if c.id < 1000
    ]


def report(name: str, found: dict[tuple[int, int], tuple[float, float]], true: set[tuple[int, int]]) -> float:
    errors = np.array(list(found.values()))
    recall = len(true & found.keys()) / len(true)
    median = np.median(errors, axis=0)
    print(
        f"{name}: accepted {len(found)}, "
        f"false {len(false_ones(found))}, of {len(true)} true pairs {recall:.1%}, "
        f"error median {100 * median[0]:.1f} cm {median[1]:.2f} deg, worst {100 * errors[:, 0].max():.0f} cm"
    )
    return recall


@pytest.mark.long
def test_stereo_keyframes_query_and_verification(euroc: Seen, kitchen: Seen) -> None:
    """The other recording's views are in the index too, as distractors."""
    index = PlaceIndex()
    for i, camera_view in enumerate(euroc.sights):
        index.add(i, camera_view.view.descriptors)
    for i, camera_view in enumerate(kitchen.sights):
        index.add(1000 + i, camera_view.view.descriptors)
    true = true_pairs(euroc)
    found = accepted(euroc, candidates(index, euroc))
    assert false_ones(found) == []
    assert report("query + verification", found, true) >= 0.72
    places = {q for q, _ in true}
    assert len(places & {q for q, _ in found}) / len(places) >= 0.9
    errors = np.array(list(found.values()))
    assert np.median(errors, axis=0)[0] < 0.03


@pytest.mark.slow
def test_stereo_keyframes_every_pair(euroc: Seen) -> None:
    n = len(euroc.sights)
    found = accepted(euroc, ((q, c) for q in range(n) for c in range(q)))
    assert false_ones(found) == []
    assert report("every pair", found, {(q, c) for q, c in true_pairs(euroc) if c < q}) >= 0.82


@pytest.mark.long
def test_kitchen_every_pair(kitchen: Seen) -> None:
    n = len(kitchen.sights)
    found = accepted(kitchen, ((q, c) for q in range(n) for c in range(q)))
    assert false_ones(found) == []
    assert report("kitchen, every pair", found, {(q, c) for q, c in true_pairs(kitchen) if c < q}) >= 0.48


@pytest.mark.long
@pytest.mark.parametrize("every", [3, pytest.param(1, marks=pytest.mark.slow)])
def test_two_different_rooms_are_never_one(euroc: Seen, kitchen: Seen, every: int) -> None:
    for query in euroc.sights[::every]:
        for candidate in kitchen.sights[::every]:
            assert not isinstance(verify(query, candidate), Verification)
            assert not isinstance(verify(candidate, query), Verification)
