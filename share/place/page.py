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
