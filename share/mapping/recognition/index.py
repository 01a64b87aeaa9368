"""Which stored views look like this one: an inverted index over hashed ORB descriptors.

Each of `tables` hash functions reads `bits` of a descriptor's 256: a word. Two descriptors that
differ in d bits share the word with probability (1 - d/256)^bits, so the tables together are a
vocabulary of words that needs no training. Sources: bit-sampling locality-sensitive hashing, Indyk
and Motwani, STOC 1998; scoring by tf-idf, Sivic and Zisserman, ICCV 2003.

A query reads the entries of rare words first and stops at 64 a stored keyframe, 400,000 in all: what is
everywhere says little, costs most, and misleads (stop words, Sivic and Zisserman). So the time of a
query hardly grows with the map.

The newest keyframes are looked through one by one. They are then written on a page, and four pages of
like size become one (a log-structured merge tree that ends at a page's size, so that no `add` takes
long).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from share.types import F32, F64, I64, U8

_FRESH = 64  # keyframes looked through one by one, at most
_DEAD = 0.25  # share of a page; beyond, it is written anew
_READ = 64  # entries a stored keyframe, on average
_READ_AT_LEAST, _READ_AT_MOST = 30_000, 400_000  # entries in all
_FAN = 4  # pages that become one


class Candidate(NamedTuple):
    """A stored keyframe and how alike it is; scores compare within one query only."""

    id: int
    score: float


class PlaceIndex:
    """Keyframes by their descriptors. Ids are any distinct integers."""

    def __init__(self, seed: int, tables: int = 8, bits: int = 16) -> None:
        if not (bits >= 1 and tables >= 1 and tables << bits <= MOST_WORDS):
            raise ValueError(
                f"{tables} tables of {bits} bits: at least one of each, and {MOST_WORDS} words in all"
            )
        rng = np.random.default_rng(seed)
        self._samples = np.stack([rng.choice(256, bits, replace=False) for _ in range(tables)])
        self._held = np.zeros(tables << bits, np.int32)  # entries of each word
        self._pages: list[Page] = []
        self._fresh: dict[int, U32] = {}  # words of the newest keyframes

    def __len__(self) -> int:
        return len(self._fresh) + sum(int(page.alive.sum()) for page in self._pages)

    @property
    def nbytes(self) -> int:
        """Memory that the index holds."""
        arrays = [array for page in self._pages for array in (page.starts, page.slots)]
        return sum(array.nbytes for array in (*arrays, *self._fresh.values(), self._held))

    def add(self, id: int, descriptors: U8) -> None:
        """Store the view (N, 32) of keyframe `id`."""
        words = self._words(descriptors)
        np.add.at(self._held, words, np.int32(1))  # of another type, it is 30 times slower
        self._fresh[id] = words
        if len(self._fresh) == _FRESH:
            self._pages.append(written(list(self._fresh), list(self._fresh.values()), len(self._held)))
            self._fresh.clear()
            self._join(_FAN)

    def remove(self, id: int) -> None:
        """Forget keyframe `id`. Raises KeyError if it is not stored."""
        if id in self._fresh:
            np.add.at(self._held, self._fresh.pop(id), np.int32(-1))
            return
        for number, page in enumerate(self._pages):
            at = np.flatnonzero((page.ids == id) & page.alive)
            if len(at):
                page.alive[at] = False
                if page.alive.mean() < 1 - _DEAD:
                    self._rewrite(number)
                return
        raise KeyError(f"keyframe {id} is not in the index")

    def query(self, descriptors: U8, limit: int, exclude: Collection[int] = ()) -> list[Candidate]:
        """Up to `limit` stored keyframes that share words with descriptors (N, 32), best first.

        A shared word counts log(n / df).
        """
        if not len(self) or not len(descriptors):
            return []
        words, weights = self._weighted(descriptors)
        parts = [(page.ids, page.sizes, page.votes(words, weights)) for page in self._pages]
        parts.append(self._fresh_part(words, weights))
        ids, sizes, votes = (np.concatenate(column) for column in zip(*parts, strict=True))
        scores = votes / np.sqrt(np.maximum(1, sizes))
        scores[np.isin(ids, list(exclude))] = 0.0
        ranked = np.argsort(-scores, kind="stable")[:limit]
        return [Candidate(int(ids[i]), float(scores[i])) for i in ranked if scores[i] > 0]

    def _weighted(self, descriptors: U8) -> tuple[I64, F64]:
        """The view's distinct words that may be read, and what each counts for."""
        words, times = np.unique(self._words(descriptors).astype(np.int64), return_counts=True)
        held = self._held[words]
        rare_first = np.argsort(held, kind="stable")
        n = len(self)
        read = np.cumsum(held[rare_first]) <= np.clip(_READ * n, _READ_AT_LEAST, _READ_AT_MOST)
        chosen = np.sort(rare_first[read & (held[rare_first] > 0)])
        return words[chosen], times[chosen] * np.log((1 + n) / (1 + np.minimum(held[chosen], n)))

    def _fresh_part(self, words: I64, weights: F64) -> tuple[I64, I64, F64]:
        """Ids, sizes and votes of the newest."""
        worth: F32 = np.zeros(len(self._held), np.float32)
        worth[words] = weights
        held = self._fresh.values()
        votes = np.array([worth[w].sum() for w in held], np.float64)
        return np.array(list(self._fresh), np.int64), np.array([len(w) for w in held], np.int64), votes

    def _join(self, fan: int) -> None:
        """The newest `fan` neighbours that fit and of which none is much larger become one page."""
        for first in range(len(self._pages) - fan, -1, -1):
            some = self._pages[first : first + fan]
            if sum(map(len, some)) <= MOST and len(some[0]) <= 2 * len(some[-1]):
                self._put(first, some, joined(some))
                return

    def _rewrite(self, number: int) -> None:
        """Without the dead of this page."""
        before = self._pages[number]
        self._put(number, [before], before.living())
        self._join(2)

    def _put(self, first: int, before: list[Page], after: Page) -> None:
        """In place of these pages; what is on none any more is held no longer."""
        if sum(map(len, before)) > len(after):
            self._held -= (sum(page.held() for page in before) - after.held()).astype(np.int32)
        self._pages[first : first + len(before)] = [after] if len(after) else []

    def _words(self, descriptors: U8) -> U32:
        """The words (N * tables,) of descriptors (N, 32): table number and sampled bits in one integer."""
        tables, bits = self._samples.shape
        sampled = np.unpackbits(descriptors, axis=1)[:, self._samples].astype(np.float32)
        values = sampled @ (2.0 ** np.arange(bits)).astype(np.float32)  # exact up to 24 bits
        words: U32 = (
            values.astype(np.uint32) + (np.arange(tables, dtype=np.uint32) << np.uint32(bits))
        ).ravel()
        return words


# ---- A page of the inverted index: which of up to a thousand keyframes hold a word.

U32 = NDArray[np.uint32]

_SLOT_BITS = 10
MOST = 1 << _SLOT_BITS  # keyframes of a page
MOST_WORDS = 1 << (32 - _SLOT_BITS)  # a word and a slot are sorted as one uint32
_BLOCK = 1 << 16  # words joined at a time: fresh memory for all at once costs as much as the work


@dataclass(frozen=True, eq=False)
class Page:
    """Keyframes `ids` (n,), the descriptors that each has (n,), and who is still alive (n,).

    The keyframes that hold word w are slots[starts[w] : starts[w + 1]], numbers below n.
    """

    ids: I64
    sizes: I64
    alive: NDArray[np.bool_]
    starts: U32
    slots: NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.ids)

    def votes(self, words: I64, weights: F64) -> F64:
        """Sum of the weights (W,) of the words (W,) that each keyframe holds: (n,); none for the dead."""
        start, end = self.starts[words].astype(np.int64), self.starts[words + 1].astype(np.int64)
        count = end - start
        at = np.repeat(start - np.cumsum(count) + count, count) + np.arange(count.sum())
        found = np.bincount(self.slots[at], np.repeat(weights, count), len(self))
        return np.where(self.alive, found, 0.0)

    def held(self) -> I64:
        """How many entries each word has, (words,)."""
        starts = self.starts.astype(np.int64)
        return starts[1:] - starts[:-1]

    def living(self) -> Page:
        """What is left of this page without its dead."""
        if self.alive.all():
            return self
        kept = self.alive[self.slots]
        starts = np.zeros(1 + len(kept), np.uint32)
        np.cumsum(kept, out=starts[1:])
        slots = (np.cumsum(self.alive) - 1).astype(np.uint16)[self.slots.compress(kept)]
        return _page(self.ids[self.alive], self.sizes[self.alive], starts[self.starts], slots)


def written(ids: Sequence[int], views: Sequence[U32], vocabulary: int) -> Page:
    """A page of keyframes by their words, each (N,) below `vocabulary`."""
    keys = np.concatenate([words << _SLOT_BITS | np.uint32(slot) for slot, words in enumerate(views)])
    keys.sort()
    starts = np.zeros(vocabulary + 1, np.uint32)
    np.cumsum(np.bincount(keys >> _SLOT_BITS, minlength=vocabulary), out=starts[1:])
    slots = (keys & (MOST - 1)).astype(np.uint16)
    return _page(np.array(ids, np.int64), np.array([len(v) for v in views]), starts, slots)


def joined(pages: Sequence[Page]) -> Page:
    """One page of all that lives on several.

    Each has its entries in order already: under every word, the pages' runs go one behind the other.
    """
    pages = [page.living() for page in pages]
    starts: U32 = np.zeros_like(pages[0].starts)
    for page in pages:
        starts += page.starts
    slots = np.empty(starts[-1], np.uint16)
    first, ahead = 0, starts[:-1].astype(np.int64)  # other pages' entries that go before this one's
    for page in pages:
        ahead -= page.starts[:-1]
        for word in range(0, len(ahead), _BLOCK):
            own = page.starts[word : word + _BLOCK + 1].astype(np.int64)
            at = np.repeat(ahead[word : word + _BLOCK], np.diff(own)) + np.arange(own[0], own[-1])
            slots[at] = page.slots[own[0] : own[-1]] + np.uint16(first)
        ahead += page.starts[1:]
        first += len(page)
    ids, sizes = (np.concatenate([getattr(page, name) for page in pages]) for name in ("ids", "sizes"))
    return _page(ids, sizes, starts, slots)


def _page(ids: I64, sizes: I64, starts: U32, slots: NDArray[np.uint16]) -> Page:
    return Page(ids, sizes, np.ones(len(ids), bool), starts, slots)
