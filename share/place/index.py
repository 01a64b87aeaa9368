"""Which stored views look like this one: an inverted index over hashed ORB descriptors.

Each of `tables` hash functions reads `bits` of a descriptor's 256: a word. Two descriptors that
differ in d bits share the word with probability (1 - d/256)^bits, so the tables together are a
vocabulary of words that needs no training. Sources: bit-sampling locality-sensitive hashing, Indyk
and Motwani, STOC 1998; scoring by tf-idf, Sivic and Zisserman, ICCV 2003.

A word and its keyframe are one int64 (word << 32 | keyframe), so that a sorted array is the whole
index; new ones are kept in sorted segments that are merged as they come near their neighbour's size
 (a log-structured merge tree: each entry is moved O(log n) times).
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from share.types import F64, I64, U8

_MAX_BITS = 24
_SHIFT = 32
_KEYFRAME = (1 << _SHIFT) - 1


class Candidate(NamedTuple):
    """A stored keyframe and how alike it is; scores compare within one query only."""

    id: int
    score: float


class PlaceIndex:
    """Keyframes by their descriptors. Ids are any distinct integers."""

    def __init__(self, seed: int, tables: int = 8, bits: int = 16) -> None:
        if not (1 <= bits <= _MAX_BITS and tables >= 1):
            raise ValueError(f"{tables} tables of {bits} bits: bits must lie in 1 .. {_MAX_BITS}")
        rng = np.random.default_rng(seed)
        self._samples = np.stack([rng.choice(256, bits, replace=False) for _ in range(tables)])
        self._ids: list[int] = []
        self._sizes: list[int] = []  # descriptors of each keyframe
        self._segments: list[I64] = []  # each sorted; every one more than twice its successor

    def __len__(self) -> int:
        return len(self._ids)

    def add(self, id: int, descriptors: U8) -> None:
        """Store the view (N, 32) of keyframe `id`."""
        segment = np.sort(self._words(descriptors) << _SHIFT | len(self._ids))
        self._ids.append(id)
        self._sizes.append(len(descriptors))
        while self._segments and len(self._segments[-1]) <= 2 * len(segment):
            segment = np.sort(np.concatenate([self._segments.pop(), segment]), kind="stable")
        self._segments.append(segment)

    def query(self, descriptors: U8, limit: int, exclude: Collection[int] = ()) -> list[Candidate]:
        """Up to `limit` stored keyframes that share words with descriptors (N, 32), best first.

        A shared word counts log(n / df): what is seen everywhere says nothing about where one is.
        """
        if not self._ids or not len(descriptors):
            return []
        votes = self._votes(np.sort(self._words(descriptors)))
        votes /= np.sqrt(np.maximum(1, self._sizes))
        left_out = set(exclude)
        ranked = np.argsort(-votes, kind="stable")[: limit + len(left_out)]
        found = [Candidate(self._ids[i], float(votes[i])) for i in ranked if votes[i] > 0]
        return [c for c in found if c.id not in left_out][:limit]

    def _votes(self, words: I64) -> F64:
        """Sum over the words of idf for every stored keyframe, (n,)."""
        low = [np.searchsorted(s, words << _SHIFT) for s in self._segments]
        high = [np.searchsorted(s, (words + 1) << _SHIFT) for s in self._segments]
        counts = np.array(high) - low
        idf = np.log((1 + len(self._ids)) / (1 + np.minimum(counts.sum(0), len(self._ids))))
        votes = np.zeros(len(self._ids))
        for segment, start, count in zip(self._segments, low, counts, strict=True):
            at = np.repeat(start - np.cumsum(count) + count, count) + np.arange(count.sum())
            keyframes = segment[at] & _KEYFRAME
            votes += np.bincount(keyframes, np.repeat(idf, count), len(votes))
        return votes

    def _words(self, descriptors: U8) -> I64:
        """The words (N * tables,) of descriptors (N, 32): table number and sampled bits in one integer."""
        tables, bits = self._samples.shape
        sampled = np.unpackbits(descriptors, axis=1)[:, self._samples]
        values = sampled.astype(np.int64) @ (1 << np.arange(bits))
        words: I64 = (values + (np.arange(tables) << bits)).ravel()
        return words
