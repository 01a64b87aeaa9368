import numpy as np
import pytest

from share.place.index import PlaceIndex
from share.types import U8


def noisy(descriptors: U8, rng: np.random.Generator, share: float = 0.08) -> U8:
    return descriptors ^ np.packbits(rng.random((len(descriptors), 256)) < share, axis=1)


def filled(n: int, rng: np.random.Generator) -> tuple[PlaceIndex, list[U8]]:
    places = [rng.integers(0, 256, (200, 32), np.uint8) for _ in range(n)]
    index = PlaceIndex(seed=3)
    for i, descriptors in enumerate(places):
        index.add(1000 + i, descriptors)
    return index, places


def test_finds_the_place_that_half_of_a_view_shows() -> None:
    rng = np.random.default_rng(0)
    index, places = filled(60, rng)
    assert len(index) == 60
    for i in (0, 17, 59):
        half = noisy(np.concatenate([places[i][:100], rng.integers(0, 256, (100, 32), np.uint8)]), rng)
        found = index.query(half, limit=3)
        assert found[0].id == 1000 + i
        assert found[0].score > 5 * found[1].score


def test_excluded_ones_stay_out_and_the_limit_holds() -> None:
    rng = np.random.default_rng(1)
    index, places = filled(20, rng)
    ids = [c.id for c in index.query(places[4], limit=5, exclude=[1004, 1000])]
    assert len(ids) == 5
    assert not {1004, 1000} & set(ids)


def test_what_is_everywhere_says_nothing() -> None:
    rng = np.random.default_rng(2)
    common = rng.integers(0, 256, (150, 32), np.uint8)
    index = PlaceIndex(seed=0)
    own = [rng.integers(0, 256, (20, 32), np.uint8) for _ in range(30)]
    for i in range(30):
        index.add(i, np.concatenate([common, own[i]]))
    found = index.query(np.concatenate([common, own[7]]), limit=30)
    assert found[0].id == 7
    assert found[0].score > 5 * found[1].score if len(found) > 1 else True


def test_answer_does_not_depend_on_how_segments_were_merged() -> None:
    """Against a dictionary of words counted by hand."""
    rng = np.random.default_rng(3)
    index, places = filled(37, rng)
    query = noisy(places[11], rng, 0.1)
    words = [set(enumerate_words(index, p)) for p in places]
    asked = enumerate_words(index, query)
    expected = np.zeros(37)
    for word in asked:
        holders = [
            sum(w == word for w in enumerate_words(index, p)) if word in s else 0
            for p, s in zip(places, words, strict=True)
        ]
        df = min(sum(holders), 37)
        expected += np.log(38 / (1 + df)) * np.array(holders)
    scores = {c.id - 1000: c.score for c in index.query(query, limit=37)}
    for i, value in scores.items():
        assert value == pytest.approx(expected[i] / np.sqrt(200))
    assert set(scores) == set(np.flatnonzero(expected))


def enumerate_words(index: PlaceIndex, descriptors: U8) -> list[int]:
    return index._words(descriptors).tolist()


def test_seed_decides_and_repeats() -> None:
    rng = np.random.default_rng(4)
    index, places = filled(10, rng)
    again, _ = filled(10, np.random.default_rng(4))
    assert index.query(places[3], 5) == again.query(places[3], 5)


def test_empty_index_and_empty_view() -> None:
    index = PlaceIndex(seed=0)
    assert index.query(np.zeros((5, 32), np.uint8), 5) == []
    index.add(1, np.zeros((0, 32), np.uint8))
    assert index.query(np.zeros((0, 32), np.uint8), 5) == []
    assert index.query(np.zeros((5, 32), np.uint8), 5) == []


@pytest.mark.parametrize(("tables", "bits"), [(0, 16), (4, 0), (4, 25)])
def test_impossible_tables_are_refused(tables: int, bits: int) -> None:
    with pytest.raises(ValueError, match="bits"):
        PlaceIndex(0, tables, bits)
