"""Place recognition: an inverted index over hashed ORB descriptors.

Each of 8 hash functions reads 16 of a descriptor's 256 bits: a word. Two descriptors that differ in d bits
share a word with probability (1 - d/256)^16, so the tables form a vocabulary that needs no training.
Sources: bit-sampling locality-sensitive hashing, Indyk and Motwani, STOC 1998; tf-idf scoring, Sivic and
Zisserman, ICCV 2003.

A query reads the entries of rare words first and stops at 64 per stored keyframe, 128,000 in all: frequent
words say little, cost most, and mislead (stop words, Sivic and Zisserman). So query time hardly grows with
the map.

The newest keyframes are compared one by one. They are then written to a page, and four pages of similar size
are merged (a log-structured merge tree), a step with each `add` and `remove`, so that none takes long.
"""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from share.types import DESCRIPTOR_BYTES, F32, F64, I64, U8

TABLES = 8  # hash functions
HASH_BITS = 16  # descriptor bits that form a word in each table
SEED = 1  # of the choice of these bits
_MAX_UNPAGED = 32  # keyframes compared one by one
_MAX_DEAD_SHARE = 0.25  # removed keyframes of a page; beyond, it is rewritten
_ENTRIES_PER_KEYFRAME = 64  # entries that a query reads, per stored keyframe
_MIN_ENTRIES, _MAX_ENTRIES = 30_000, 128_000  # limits on all entries that a query reads
_PAGES_PER_MERGE = 4
_MAX_PAGES = 12  # beyond, the smallest two neighbours are merged


class PlaceCandidate(NamedTuple):
    """A similar keyframe. Scores compare within one query only."""

    id: int
    score: float


class PlaceIndex:
    """Index of keyframes by their descriptors. Ids are any distinct integers.

    seed: of the choice of each table's bits.
    """

    def __init__(self, seed: int = SEED) -> None:
        rng = np.random.default_rng(seed)
        size = 8 * DESCRIPTOR_BYTES
        self._sampled_bits = np.stack([rng.choice(size, HASH_BITS, replace=False) for _ in range(TABLES)])
        self._word_counts = np.zeros(TABLES << HASH_BITS, np.int32)
        self._pages: list[IndexPage] = []
        self._unpaged: dict[int, U32] = {}  # words of the newest keyframes
        self._merge: Iterator[int] | None = None

    def __len__(self) -> int:
        return len(self._unpaged) + sum(int(page.is_alive.sum()) for page in self._pages)

    @property
    def nbytes(self) -> int:
        arrays = [array for page in self._pages for array in (page.starts, page.slots)]
        return sum(array.nbytes for array in (*arrays, *self._unpaged.values(), self._word_counts))

    def add(self, id: int, descriptors: U8) -> None:
        """Add keyframe `id` with its descriptors (N, 32)."""
        self.add_words(id, self.words(descriptors))

    def add_words(self, id: int, words: U32) -> None:
        """Add keyframe `id` with the words of its descriptors."""
        np.add.at(self._word_counts, words, np.int32(1))  # another dtype is 30 times slower
        self._unpaged[id] = words
        if len(self._unpaged) == _MAX_UNPAGED:
            self._pages.append(
                build_page(list(self._unpaged), list(self._unpaged.values()), len(self._word_counts))
            )
            self._unpaged.clear()
        self._continue_merge()

    def remove(self, id: int) -> None:
        """Remove keyframe `id`. Raises KeyError if it is not stored."""
        if id in self._unpaged:
            np.add.at(self._word_counts, self._unpaged.pop(id), np.int32(-1))
            return
        for page in self._pages:
            row = np.flatnonzero((page.ids == id) & page.is_alive)
            if len(row):
                page.is_alive[row] = False
                self._continue_merge()
                return
        raise KeyError(f"keyframe {id} is not in the index")

    def query(self, descriptors: U8, limit: int, exclude: Collection[int] = ()) -> list[PlaceCandidate]:
        """Up to `limit` stored keyframes that share words with descriptors (N, 32), best first.

        A shared word scores log(n / df).
        """
        return self.query_words(self.words(descriptors), limit, exclude) if len(descriptors) else []

    def query_words(self, words: U32, limit: int, exclude: Collection[int] = ()) -> list[PlaceCandidate]:
        """As `query`, with the words (N,) of the descriptors."""
        if not len(self):
            return []
        distinct, weights = self._weight_words(words)
        parts = [(page.ids, page.sizes, page.votes(distinct, weights)) for page in self._pages]
        parts.append(self._unpaged_votes(distinct, weights))
        ids, sizes, votes = (np.concatenate(column) for column in zip(*parts, strict=True))
        scores = votes / np.sqrt(np.maximum(1, sizes))
        scores[np.isin(ids, list(exclude))] = 0.0
        ranked = _best(scores, limit)
        return [PlaceCandidate(int(ids[i]), float(scores[i])) for i in ranked if scores[i] > 0]

    def _weight_words(self, view_words: U32) -> tuple[I64, F64]:
        """Distinct words of a view within the budget of entries, and their weights."""
        words, term_counts = np.unique(view_words.astype(np.int64), return_counts=True)
        word_counts = self._word_counts[words]
        rare_first = np.argsort(word_counts, kind="stable")
        n = len(self)
        is_within_budget = np.cumsum(word_counts[rare_first]) <= np.clip(
            _ENTRIES_PER_KEYFRAME * n, _MIN_ENTRIES, _MAX_ENTRIES
        )
        chosen = np.sort(rare_first[is_within_budget & (word_counts[rare_first] > 0)])
        return words[chosen], term_counts[chosen] * np.log((1 + n) / (1 + np.minimum(word_counts[chosen], n)))

    def _unpaged_votes(self, words: I64, weights: F64) -> tuple[I64, I64, F64]:
        """Ids, sizes and votes of the newest keyframes."""
        word_weights: F32 = np.zeros(len(self._word_counts), np.float32)
        word_weights[words] = weights
        views = self._unpaged.values()
        votes = np.array([word_weights[w].sum() for w in views], np.float64)
        return np.array(list(self._unpaged), np.int64), np.array([len(w) for w in views], np.int64), votes

    def _continue_merge(self) -> None:
        """Go on with the merge that runs, or the next one, by some `_ENTRIES_PER_STEP`."""
        entries = 0
        while entries < _ENTRIES_PER_STEP:
            if self._merge is None and (pages := self._next_pages()):
                self._merge = self._merge_run(*pages)
            if self._merge is None:
                return
            step = next(self._merge, None)
            if step is None:
                self._merge = None
            entries += step or 0

    def _next_pages(self) -> tuple[int, int] | None:
        """First and number of the pages to merge next: one with many removed keyframes, and a neighbour of
        similar size; the newest of similar size; or the smallest two neighbours where there are many."""
        sizes = [int(page.is_alive.sum()) for page in self._pages]
        for index, page in enumerate(self._pages):
            if sizes[index] < (1 - _MAX_DEAD_SHARE) * len(page):
                first = max(0, min(index, len(sizes) - 2))
                pair = sizes[first : first + 2]
                is_pair = len(pair) == 2 and max(pair) <= 2 * min(pair) and sum(pair) <= MAX_PAGE_KEYFRAMES
                return (first, 2) if is_pair else (index, 1)
        for first in range(len(sizes) - _PAGES_PER_MERGE, -1, -1):
            run = sizes[first : first + _PAGES_PER_MERGE]
            if sum(run) <= MAX_PAGE_KEYFRAMES and run[0] <= 2 * run[-1]:
                return first, _PAGES_PER_MERGE
        size, first = min((sum(sizes[i : i + 2]), i) for i in range(max(1, len(sizes) - 1)))
        return (first, 2) if len(sizes) > _MAX_PAGES and size <= MAX_PAGE_KEYFRAMES else None

    def _merge_run(self, first: int, count: int) -> Iterator[int]:
        """Put one page in place of `count`, and subtract the words of keyframes that it dropped. Yields the
        entries of each step. Pages that come meanwhile are behind them."""
        pages = self._pages[first : first + count]
        merged = yield from merge_in_steps(pages)
        if sum(map(len, pages)) > len(merged):
            dropped = sum(page.word_counts() for page in pages) - merged.word_counts()
            self._word_counts -= dropped.astype(np.int32)
        self._pages[first : first + count] = [merged] if len(merged) else []

    def words(self, descriptors: U8) -> U32:
        """Words (N * TABLES,) of descriptors (N, 32): table number and sampled bits in one integer."""
        sampled = np.unpackbits(descriptors, axis=1)[:, self._sampled_bits].astype(np.float32)
        values = sampled @ (2.0 ** np.arange(HASH_BITS)).astype(np.float32)  # exact up to 24 bits
        words: U32 = (
            values.astype(np.uint32) + (np.arange(TABLES, dtype=np.uint32) << np.uint32(HASH_BITS))
        ).ravel()
        return words


U32 = NDArray[np.uint32]

_SLOT_BITS = 13  # word and slot are sorted as one uint32: TABLES * 2^HASH_BITS is at most 2^19
MAX_PAGE_KEYFRAMES = 1 << _SLOT_BITS
_DROPPED = np.uint16((1 << 16) - 1)  # no slot
_ENTRIES_PER_STEP = 200_000  # of a merge, about


@dataclass(frozen=True, eq=False)
class IndexPage:
    """Up to 8192 keyframes: ids (n,), number of words of each (n,), and which are not removed (n,).

    The keyframes with word w are slots[starts[w] : starts[w + 1]], indices below n.
    """

    ids: I64
    sizes: I64
    is_alive: NDArray[np.bool_]
    starts: U32
    slots: NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.ids)

    def votes(self, words: I64, weights: F64) -> F64:
        """Sum of the weights (W,) of the given words (W,) in each keyframe, (n,); 0 for removed ones."""
        start, end = self.starts[words].astype(np.int64), self.starts[words + 1].astype(np.int64)
        count = end - start
        entries = np.repeat(start - np.cumsum(count) + count, count) + np.arange(count.sum())
        votes = np.bincount(self.slots[entries], np.repeat(weights, count), len(self))
        return np.where(self.is_alive, votes, 0.0)

    def word_counts(self) -> I64:
        """Number of entries of each word, (words,)."""
        starts = self.starts.astype(np.int64)
        return starts[1:] - starts[:-1]


def build_page(ids: Sequence[int], views: Sequence[U32], vocabulary: int) -> IndexPage:
    """Build a page from keyframes by their words, each (N,) below `vocabulary`."""
    keys = np.concatenate([words << _SLOT_BITS | np.uint32(slot) for slot, words in enumerate(views)])
    keys.sort()
    starts = np.zeros(vocabulary + 1, np.uint32)
    np.cumsum(np.bincount(keys >> _SLOT_BITS, minlength=vocabulary), out=starts[1:])
    slots = (keys & (MAX_PAGE_KEYFRAMES - 1)).astype(np.uint16)
    sizes = np.array([len(words) for words in views])
    return IndexPage(np.array(ids, np.int64), sizes, np.ones(len(ids), bool), starts, slots)


def merge_in_steps(pages: Sequence[IndexPage]) -> Generator[int, None, IndexPage]:
    """Merge pages in steps of some milliseconds, dropping removed keyframes. Yields the entries of each.

    Keyframes that are removed meanwhile are removed ones of the result.
    """
    kept = [np.flatnonzero(page.is_alive) for page in pages]
    sizes = np.concatenate([page.sizes[slots] for page, slots in zip(pages, kept, strict=True)])
    new_slots, first_slot = [], 0
    for page, slots in zip(pages, kept, strict=True):
        new_slot: NDArray[np.uint16] = np.full(len(page), _DROPPED, np.uint16)
        new_slot[slots] = np.arange(first_slot, first_slot + len(slots), dtype=np.uint16)
        new_slots.append(new_slot)
        first_slot += len(slots)
    starts: U32 = np.zeros_like(pages[0].starts)
    out = np.empty(int(sizes.sum()), np.uint16)
    yield _ENTRIES_PER_STEP // 2  # for the arrays
    filled, bounds = 0, _step_bounds(pages)
    for low, high in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        words, of_block = _entries(pages, new_slots, low, high)
        count = np.bincount(words, minlength=high - low)
        out[filled : filled + len(of_block)] = of_block
        starts[low + 1 : high + 1] = filled + np.cumsum(count)
        filled += len(of_block)
        yield len(of_block)
    ids = np.concatenate([page.ids[slots] for page, slots in zip(pages, kept, strict=True)])
    is_alive = np.concatenate([page.is_alive[slots] for page, slots in zip(pages, kept, strict=True)])
    return IndexPage(ids, sizes, is_alive, starts, out)


def _step_bounds(pages: Sequence[IndexPage]) -> I64:
    """Ascending words, the first and last included, between which there are about as many entries as a step
    has."""
    entries: I64 = np.sum([page.starts.astype(np.int64) for page in pages], axis=0)
    inner = np.searchsorted(entries, np.arange(_ENTRIES_PER_STEP, entries[-1], _ENTRIES_PER_STEP))
    return np.unique(np.concatenate([[0], inner, [len(entries) - 1]]))


def _entries(
    pages: Sequence[IndexPage], new_slots: Sequence[NDArray[np.uint16]], low: int, high: int
) -> tuple[NDArray[np.intp], NDArray[np.uint16]]:
    """Words (N,), counted from `low`, and new slots (N,) of the entries of words low .. high - 1, by word."""
    words, slots = [], []
    for page, new_slot in zip(pages, new_slots, strict=True):
        starts = page.starts[low : high + 1].astype(np.int64)
        of_page = new_slot[page.slots[starts[0] : starts[-1]]]
        is_kept = of_page != _DROPPED
        words.append(np.repeat(np.arange(high - low), np.diff(starts))[is_kept])
        slots.append(of_page[is_kept])
    all_words, all_slots = np.concatenate(words), np.concatenate(slots)
    order = np.argsort(all_words, kind="stable")
    return all_words[order], all_slots[order]


def _best(scores: F64, limit: int) -> I64:
    """Indices of the `limit` best scores, best first, of equal ones the first."""
    if 0 < limit < len(scores):
        worst = np.partition(scores, -limit)[-limit]
        among = np.flatnonzero(scores >= worst)
    else:
        among = np.arange(len(scores))
    return among[np.argsort(-scores[among], kind="stable")][:limit]
