"""Place recognition: an inverted index over hashed ORB descriptors.

Each of 8 hash functions reads 16 of a descriptor's 256 bits: a word. Two descriptors that differ in d bits
share a word with probability (1 - d/256)^16, so the tables form a vocabulary that needs no training.
Sources: bit-sampling locality-sensitive hashing, Indyk and Motwani, STOC 1998; tf-idf scoring, Sivic and
Zisserman, ICCV 2003.

A query reads the entries of rare words first and stops at 64 per stored keyframe, 400,000 in all: frequent
words say little, cost most, and mislead (stop words, Sivic and Zisserman). So query time hardly grows with
the map.

The newest keyframes are compared one by one. They are then written to a page, and four pages of similar size
are merged (a log-structured merge tree, up to a maximum page size, so that no `add` takes long).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from share.types import F32, F64, I64, U8

TABLES = 8  # hash functions
HASH_BITS = 16  # descriptor bits that form a word in each table
SEED = 1  # of the choice of these bits
_MAX_UNPAGED = 64  # keyframes compared one by one
_MAX_DEAD_SHARE = 0.25  # removed keyframes of a page; beyond, it is rewritten
_ENTRIES_PER_KEYFRAME = 64  # entries that a query reads, per stored keyframe
_MIN_ENTRIES, _MAX_ENTRIES = 30_000, 400_000  # limits on all entries that a query reads
_PAGES_PER_MERGE = 4


class PlaceCandidate(NamedTuple):
    """A similar keyframe. Scores compare within one query only."""

    id: int
    score: float


class PlaceIndex:
    """Index of keyframes by their descriptors. Ids are any distinct integers.

    tables * 2^bits <= MAX_WORDS; seed: of the choice of each table's bits.
    """

    def __init__(self, seed: int = SEED, tables: int = TABLES, bits: int = HASH_BITS) -> None:
        rng = np.random.default_rng(seed)
        self._sampled_bits = np.stack([rng.choice(256, bits, replace=False) for _ in range(tables)])
        self._word_counts = np.zeros(tables << bits, np.int32)
        self._pages: list[IndexPage] = []
        self._unpaged: dict[int, U32] = {}  # words of the newest keyframes

    def __len__(self) -> int:
        return len(self._unpaged) + sum(int(page.is_alive.sum()) for page in self._pages)

    @property
    def nbytes(self) -> int:
        arrays = [array for page in self._pages for array in (page.starts, page.slots)]
        return sum(array.nbytes for array in (*arrays, *self._unpaged.values(), self._word_counts))

    def add(self, id: int, descriptors: U8) -> None:
        """Add keyframe `id` with its descriptors (N, 32)."""
        words = self.words(descriptors)
        np.add.at(self._word_counts, words, np.int32(1))  # another dtype is 30 times slower
        self._unpaged[id] = words
        if len(self._unpaged) == _MAX_UNPAGED:
            self._pages.append(
                build_page(list(self._unpaged), list(self._unpaged.values()), len(self._word_counts))
            )
            self._unpaged.clear()
            self._merge_pages(_PAGES_PER_MERGE)

    def remove(self, id: int) -> None:
        """Remove keyframe `id`. Raises KeyError if it is not stored."""
        if id in self._unpaged:
            np.add.at(self._word_counts, self._unpaged.pop(id), np.int32(-1))
            return
        for page_index, page in enumerate(self._pages):
            row = np.flatnonzero((page.ids == id) & page.is_alive)
            if len(row):
                page.is_alive[row] = False
                if page.is_alive.mean() < 1 - _MAX_DEAD_SHARE:
                    self._compact_page(page_index)
                return
        raise KeyError(f"keyframe {id} is not in the index")

    def query(self, descriptors: U8, limit: int, exclude: Collection[int] = ()) -> list[PlaceCandidate]:
        """Up to `limit` stored keyframes that share words with descriptors (N, 32), best first.

        A shared word scores log(n / df).
        """
        if not len(self) or not len(descriptors):
            return []
        words, weights = self._weight_words(descriptors)
        parts = [(page.ids, page.sizes, page.votes(words, weights)) for page in self._pages]
        parts.append(self._unpaged_votes(words, weights))
        ids, sizes, votes = (np.concatenate(column) for column in zip(*parts, strict=True))
        scores = votes / np.sqrt(np.maximum(1, sizes))
        scores[np.isin(ids, list(exclude))] = 0.0
        ranked = np.argsort(-scores, kind="stable")[:limit]
        return [PlaceCandidate(int(ids[i]), float(scores[i])) for i in ranked if scores[i] > 0]

    def _weight_words(self, descriptors: U8) -> tuple[I64, F64]:
        """Distinct words of the view within the budget of entries, and their weights."""
        words, term_counts = np.unique(self.words(descriptors).astype(np.int64), return_counts=True)
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

    def _merge_pages(self, count: int) -> None:
        """Merge the newest `count` adjacent pages that fit in one, the first at most twice the last."""
        for first in range(len(self._pages) - count, -1, -1):
            pages = self._pages[first : first + count]
            if sum(map(len, pages)) <= MAX_PAGE_KEYFRAMES and len(pages[0]) <= 2 * len(pages[-1]):
                self._replace_pages(first, pages, merge_pages(pages))
                return

    def _compact_page(self, page_index: int) -> None:
        """Drop the removed keyframes of a page."""
        page = self._pages[page_index]
        self._replace_pages(page_index, [page], page.compact())
        self._merge_pages(2)

    def _replace_pages(self, first: int, old: list[IndexPage], new: IndexPage) -> None:
        """Put `new` in place of pages `old`, and subtract the words of dropped keyframes."""
        if sum(map(len, old)) > len(new):
            self._word_counts -= (sum(page.word_counts() for page in old) - new.word_counts()).astype(
                np.int32
            )
        self._pages[first : first + len(old)] = [new] if len(new) else []

    def words(self, descriptors: U8) -> U32:
        """Words (N * tables,) of descriptors (N, 32): table number and sampled bits in one integer."""
        tables, bits = self._sampled_bits.shape
        sampled = np.unpackbits(descriptors, axis=1)[:, self._sampled_bits].astype(np.float32)
        values = sampled @ (2.0 ** np.arange(bits)).astype(np.float32)  # exact up to 24 bits
        words: U32 = (
            values.astype(np.uint32) + (np.arange(tables, dtype=np.uint32) << np.uint32(bits))
        ).ravel()
        return words


U32 = NDArray[np.uint32]

_SLOT_BITS = 10
MAX_PAGE_KEYFRAMES = 1 << _SLOT_BITS
MAX_WORDS = 1 << (32 - _SLOT_BITS)  # word and slot are sorted as one uint32
_MERGE_BLOCK = 1 << 16  # words merged at a time: allocating for all at once doubles the time


@dataclass(frozen=True, eq=False)
class IndexPage:
    """Up to 1024 keyframes: ids (n,), number of words of each (n,), and which are not removed (n,).

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

    def compact(self) -> IndexPage:
        if self.is_alive.all():
            return self
        kept = self.is_alive[self.slots]
        starts = np.zeros(1 + len(kept), np.uint32)
        np.cumsum(kept, out=starts[1:])
        slots = (np.cumsum(self.is_alive) - 1).astype(np.uint16)[self.slots.compress(kept)]
        return _new_page(self.ids[self.is_alive], self.sizes[self.is_alive], starts[self.starts], slots)


def build_page(ids: Sequence[int], views: Sequence[U32], vocabulary: int) -> IndexPage:
    """Build a page from keyframes by their words, each (N,) below `vocabulary`."""
    keys = np.concatenate([words << _SLOT_BITS | np.uint32(slot) for slot, words in enumerate(views)])
    keys.sort()
    starts = np.zeros(vocabulary + 1, np.uint32)
    np.cumsum(np.bincount(keys >> _SLOT_BITS, minlength=vocabulary), out=starts[1:])
    slots = (keys & (MAX_PAGE_KEYFRAMES - 1)).astype(np.uint16)
    return _new_page(np.array(ids, np.int64), np.array([len(v) for v in views]), starts, slots)


def merge_pages(pages: Sequence[IndexPage]) -> IndexPage:
    """Merge pages, dropping removed keyframes.

    Entries are sorted by word already: under each word the pages' runs are concatenated.
    """
    pages = [page.compact() for page in pages]
    starts: U32 = np.zeros_like(pages[0].starts)
    for page in pages:
        starts += page.starts
    slots = np.empty(starts[-1], np.uint16)
    first_slot, offsets = 0, starts[:-1].astype(np.int64)  # entries of earlier pages under each word
    for page in pages:
        offsets -= page.starts[:-1]
        for word in range(0, len(offsets), _MERGE_BLOCK):
            own = page.starts[word : word + _MERGE_BLOCK + 1].astype(np.int64)
            positions = np.repeat(offsets[word : word + _MERGE_BLOCK], np.diff(own)) + np.arange(
                own[0], own[-1]
            )
            slots[positions] = page.slots[own[0] : own[-1]] + np.uint16(first_slot)
        offsets += page.starts[1:]
        first_slot += len(page)
    ids, sizes = (np.concatenate([getattr(page, name) for page in pages]) for name in ("ids", "sizes"))
    return _new_page(ids, sizes, starts, slots)


def _new_page(ids: I64, sizes: I64, starts: U32, slots: NDArray[np.uint16]) -> IndexPage:
    return IndexPage(ids, sizes, np.ones(len(ids), bool), starts, slots)
