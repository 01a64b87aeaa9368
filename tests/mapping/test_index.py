from collections import Counter
from collections.abc import Generator

import numpy as np
import pytest

from share.mapping.recognition import index as index_module
from share.mapping.recognition.index import IndexPage, PlaceIndex, build_page, merge_in_steps
from share.types import U8


def noisy(descriptors: U8, rng: np.random.Generator, share: float = 0.08) -> U8:
    return descriptors ^ np.packbits(rng.random((len(descriptors), 256)) < share, axis=1)


def filled(n: int, rng: np.random.Generator) -> tuple[PlaceIndex, list[U8]]:
    places = [rng.integers(0, 256, (200, 32), np.uint8) for _ in range(n)]
    index = PlaceIndex(seed=3)
    for i, descriptors in enumerate(places):
        index.add(1000 + i, descriptors)
    return index, places


def merged(pages: list[IndexPage]) -> IndexPage:
    steps = merge_in_steps(pages)
    while True:
        try:
            next(steps)
        except StopIteration as end:
            page: IndexPage = end.value
            return page


def test_a_half_overlapping_view_is_found() -> None:
    rng = np.random.default_rng(0)
    index, places = filled(60, rng)
    assert len(index) == 60
    for i in (0, 17, 59):
        half = noisy(np.concatenate([places[i][:100], rng.integers(0, 256, (100, 32), np.uint8)]), rng)
        found = index.query(half, limit=3)
        assert found[0].id == 1000 + i
        assert found[0].score > 5 * found[1].score


def test_exclusions_and_limit_hold() -> None:
    rng = np.random.default_rng(1)
    index, places = filled(20, rng)
    ids = [c.id for c in index.query(places[4], limit=5, exclude=[1004, 1000])]
    assert len(ids) == 5
    assert not {1004, 1000} & set(ids)


def test_descriptors_common_to_all_views_do_not_count() -> None:
    rng = np.random.default_rng(2)
    common = rng.integers(0, 256, (150, 32), np.uint8)
    index = PlaceIndex(seed=0)
    own = [rng.integers(0, 256, (20, 32), np.uint8) for _ in range(30)]
    for i in range(30):
        index.add(i, np.concatenate([common, own[i]]))
    found = index.query(np.concatenate([common, own[7]]), limit=30)
    assert found[0].id == 7
    assert found[0].score > 5 * found[1].score if len(found) > 1 else True


@pytest.mark.parametrize("n", [37, 64, 300])
def test_the_result_does_not_depend_on_the_page_of_a_keyframe(n: int) -> None:
    """Compared with counted words; descriptors are random, so that no word is too frequent."""
    rng = np.random.default_rng(3)
    index, places = filled(n, rng)
    query = noisy(places[11], rng, 0.1)
    held = [Counter(index.words(p).tolist()) for p in places]
    total = Counter[int]()
    for words in held:
        total.update(words)
    asked = index.words(query).tolist()
    score = [sum(np.log((1 + n) / (1 + min(total[w], n))) * h[w] for w in asked) for h in held]
    found = {c.id - 1000: c.score for c in index.query(query, limit=n)}
    for i, value in found.items():
        assert value == pytest.approx(score[i] / np.sqrt(200 * 8), rel=1e-5)
    assert set(found) == set(np.flatnonzero(np.array(score) > 0))


def test_removed_keyframes_are_not_found_and_take_no_memory() -> None:
    rng = np.random.default_rng(5)
    index, places = filled(600, rng)
    full = index.nbytes
    for i in range(600):
        if i % 10:
            index.remove(1000 + i)
    assert len(index) == 60
    assert index.nbytes < 0.6 * full
    assert index.query(noisy(places[590], rng), 1)[0].id == 1590
    assert 1591 not in {c.id for c in index.query(noisy(places[591], rng), 60)}
    fewer = PlaceIndex(seed=3)
    for i in range(0, 600, 10):
        fewer.add(1000 + i, places[i])
    query = noisy(places[590], rng)
    again = {c.id: c.score for c in fewer.query(query, 60)}
    assert {c.id: c.score for c in index.query(query, 60)} == pytest.approx(again, rel=0.3)


def test_removed_keyframes_can_be_added_again() -> None:
    rng = np.random.default_rng(6)
    index, places = filled(130, rng)
    for i in (3, 129):  # on a page, and among the newest
        index.remove(1000 + i)
        with pytest.raises(KeyError, match="not in the index"):
            index.remove(1000 + i)
        index.add(1000 + i, places[i])
        assert index.query(places[i], 1)[0].id == 1000 + i
    assert len(index) == 130


def test_merged_pages_equal_one_page_of_the_remaining_keyframes() -> None:
    rng = np.random.default_rng(8)
    vocabulary = 300_000  # merged in several steps
    common = rng.integers(0, vocabulary, 500, np.uint32)
    views = [np.append(rng.choice(common, n), [0, vocabulary - 1]).astype(np.uint32) for n in range(120)]
    pages = [build_page(range(i, j), views[i:j], vocabulary) for i, j in ((0, 70), (70, 80), (80, 120))]
    dead = [0, 5, 69, *range(70, 80), 119]
    for page in pages:
        page.is_alive[np.isin(page.ids, dead)] = False
    left = [i for i in range(120) if i not in dead]
    one, whole = merged(pages), build_page(left, [views[i] for i in left], vocabulary)
    for name in ("ids", "sizes", "is_alive", "starts", "slots"):
        np.testing.assert_array_equal(getattr(one, name), getattr(whole, name), name, strict=True)


def test_frequent_words_are_not_read() -> None:
    """A view whose every word is in every keyframe is not found."""
    index = PlaceIndex(seed=0)
    same = np.random.default_rng(7).integers(0, 256, (200, 32), np.uint8)
    for i in range(100):
        index.add(i, same)
    assert index.query(same, 5) == []


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


def test_words_of_removed_keyframes_are_not_counted() -> None:
    """Otherwise they would count as frequent, and not be read."""
    rng = np.random.default_rng(8)
    _, places = filled(8, rng)
    views = [noisy(places[i % 8], rng) for i in range(320)]
    removed = set(rng.permutation(320)[:200].tolist())
    index, only = PlaceIndex(seed=3), PlaceIndex(seed=3)
    for i, view in enumerate(views):
        index.add(i, view)
        if i not in removed:
            only.add(i, view)
    for i in removed:
        index.remove(i)
    assert len(index) == len(only) == 120
    for place in places:
        scores, expected = ({c.id: c.score for c in one.query(place, 120)} for one in (index, only))
        assert scores == pytest.approx(expected, rel=0.14)  # a page keeps some until it is rewritten


@pytest.mark.slow
def test_a_query_reads_no_more_of_a_large_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """Entries, where all words are frequent."""
    rng, read = np.random.default_rng(9), Counter[int]()
    votes = IndexPage.votes

    def counted(page: IndexPage, words: np.ndarray, weights: np.ndarray) -> np.ndarray:
        read[len(index)] += int((page.starts[words + 1] - page.starts[words]).astype(np.int64).sum())
        return votes(page, words, weights)

    monkeypatch.setattr(IndexPage, "votes", counted)
    things = rng.integers(0, 256, (60, 32), np.uint8)
    index = PlaceIndex(seed=0)
    for count in (2000, 12_000):
        for i in range(len(index), count):
            index.add(i, things[rng.integers(60, size=20)])
        assert index.query(things[:20], 5)
    assert 0 < read[12_000] <= 1.5 * read[2000]


def test_no_addition_takes_long_while_pages_are_merged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Entries that are merged with one keyframe; all are found meanwhile."""
    rng, steps = np.random.default_rng(10), [0]
    merge = index_module.merge_in_steps

    def counted(pages: list[IndexPage]) -> Generator[int, None, IndexPage]:
        work = merge(pages)
        while True:
            try:
                entries = next(work)
            except StopIteration as end:
                page: IndexPage = end.value
                return page
            steps[-1] += entries
            yield entries

    monkeypatch.setattr(index_module, "merge_in_steps", counted)
    monkeypatch.setattr(index_module, "_ENTRIES_PER_STEP", 20_000)
    index = PlaceIndex(seed=0)
    places = [rng.integers(0, 256, (100, 32), np.uint8) for _ in range(700)]
    for i, place in enumerate(places):
        index.add(i, place)
        steps.append(0)
        if i % 97 == 96:
            assert index.query(place, 1)[0].id == i and len(index) == i + 1
            assert index.query(places[i // 2], 1)[0].id == i // 2
    assert max(steps) < 3 * 20_000 < 0.1 * sum(steps)
