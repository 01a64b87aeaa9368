"""A page of the inverted index: which of up to a thousand keyframes hold a word."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.types import F64, I64

U32 = NDArray[np.uint32]

_SLOT_BITS = 10
MOST = 1 << _SLOT_BITS  # keyframes of a page
MOST_WORDS = 1 << (32 - _SLOT_BITS)  # a word and a slot are sorted as one uint32


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

    def keys(self, first: int) -> U32:
        """Word and slot of every living keyframe's entries in one integer, slots counted from `first`."""
        moved = (first - 1 + np.cumsum(self.alive)).astype(np.uint32)
        words = np.repeat(np.arange(len(self.starts) - 1, dtype=np.uint32), self.held())
        keys: U32 = words << np.uint32(_SLOT_BITS) | moved[self.slots]
        return keys[self.alive[self.slots]]


def written(ids: Sequence[int], views: Sequence[U32], vocabulary: int) -> Page:
    """A page of keyframes by their words, each (N,) below `vocabulary`."""
    keys = np.concatenate([words << _SLOT_BITS | np.uint32(slot) for slot, words in enumerate(views)])
    return _sorted(np.array(ids, np.int64), np.array([len(v) for v in views]), keys, vocabulary)


def joined(pages: Sequence[Page]) -> Page:
    """One page of all that lives on several."""
    firsts = np.cumsum([0, *(int(page.alive.sum()) for page in pages)])
    keys = [page.keys(int(first)) for page, first in zip(pages, firsts[:-1], strict=True)]
    ids, sizes = (
        np.concatenate([getattr(page, name)[page.alive] for page in pages]) for name in ("ids", "sizes")
    )
    return _sorted(ids, sizes, np.concatenate(keys), len(pages[0].starts) - 1)


def _sorted(ids: I64, sizes: I64, keys: U32, vocabulary: int) -> Page:
    keys = np.sort(keys)
    starts = np.zeros(vocabulary + 1, np.uint32)
    np.cumsum(np.bincount(keys >> _SLOT_BITS, minlength=vocabulary), out=starts[1:])
    slots = (keys & (MOST - 1)).astype(np.uint16)
    return Page(ids, sizes, np.ones(len(ids), bool), starts, slots)
