"""Match ORB descriptors of two views."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from share.types import I64, U8

_BLOCK_ROWS = 50  # so that intermediate results stay in the cache
_QUARTER_MARGIN = 5  # bits: two sigmas of those in a quarter of a descriptor of 40 that differ


class DescriptorPairs(NamedTuple):
    """Possible matches: rows (M,) of one view, cols (M,) of the other, and differing bits (M,)."""

    rows: I64
    cols: I64
    bits: NDArray[np.uint16]

    def keep(self, keep: NDArray[np.bool_]) -> DescriptorPairs:
        at = np.flatnonzero(keep)
        return DescriptorPairs(self.rows[at], self.cols[at], self.bits[at])


def hamming_matrix(a: U8, b: U8) -> NDArray[np.uint16]:
    """Return the differing bits (N, K) of every descriptor in a (N, 32) with every one in b (K, 32)."""
    words_a, words_b = (np.ascontiguousarray(np.ascontiguousarray(x).view(np.uint64).T) for x in (a, b))
    out = np.empty((len(a), len(b)), np.uint16)
    for start in range(0, len(a), _BLOCK_ROWS):
        differ = (x[start : start + _BLOCK_ROWS, None] ^ y for x, y in zip(words_a, words_b, strict=True))
        first, *others, last = (np.bitwise_count(d) for d in differ)  # at most 64, in a byte
        for count in others:
            first += count
        np.add(first, last, out=out[start : start + _BLOCK_ROWS], dtype=np.uint16)
    return out


def hamming_rowwise(a: U8, b: U8) -> I64:
    """Return the differing bits (N,) of descriptors a (N, 32) and b (N, 32), row by row."""
    differ = np.ascontiguousarray(a).view(np.uint64) ^ np.ascontiguousarray(b).view(np.uint64)
    return np.asarray(np.bitwise_count(differ).sum(1, dtype=np.int64))


def pairs_within(distance: NDArray[np.uint16], max_bits: int) -> DescriptorPairs:
    """Return all pairs of a distance matrix (N, K) that differ in at most `max_bits`."""
    at = np.flatnonzero(distance <= max_bits)
    rows, cols = np.divmod(at, distance.shape[1])
    return DescriptorPairs(rows, cols, distance.ravel()[at])


def close_pairs(a: U8, b: U8, max_bits: int) -> DescriptorPairs:
    """Return nearly all pairs of descriptors in a (N, 32) and b (K, 32) that differ in at most `max_bits`, a
    small number, in a third of the time of all distances: those that differ much in a quarter of the bits are
    left out."""
    if not len(a) or not len(b):
        return DescriptorPairs(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.uint16))
    first_a, first_b = (np.ascontiguousarray(x[:, :8]).view(np.uint64)[:, 0] for x in (a, b))
    max_first = max_bits // 4 + _QUARTER_MARGIN
    at = np.concatenate(
        [
            start * len(b) + np.flatnonzero(np.bitwise_count(block[:, None] ^ first_b) <= max_first)
            for start, block in ((k, first_a[k : k + _BLOCK_ROWS]) for k in range(0, len(a), _BLOCK_ROWS))
        ]
    )
    rows, cols = np.divmod(at, len(b))
    pairs = DescriptorPairs(rows, cols, hamming_rowwise(a[rows], b[cols]).astype(np.uint16))
    return pairs.keep(pairs.bits <= max_bits)


def mutual_best(pairs: DescriptorPairs) -> DescriptorPairs:
    """Return the pairs that are best of their row and of their column, the most similar first."""
    order = np.argsort(pairs.bits, kind="stable")
    ranked = DescriptorPairs(pairs.rows[order], pairs.cols[order], pairs.bits[order])
    return ranked.keep(_is_first(ranked.rows) & _is_first(ranked.cols))


def _is_first(ids: I64) -> NDArray[np.bool_]:
    """Return which entries (M,) are the first with their value."""
    number = np.arange(len(ids))
    first = np.empty(ids.max(initial=-1) + 1, np.int64)
    first[ids[::-1]] = number[::-1]  # of several, numpy keeps the last
    return np.asarray(first[ids] == number)


def match_descriptors(query: U8, candidate: U8, max_distance: int, ratio: float) -> I64:
    """Return mutual nearest neighbours: indices (M, 2) into query (N, 32) and candidate (K, 32) descriptors.

    A pair is kept if its Hamming distance is at most `max_distance` bits and less than `ratio` times that of
    the second best on either side (Lowe, IJCV 2004, section 7.1).
    """
    if len(query) < 2 or len(candidate) < 2:
        return np.zeros((0, 2), np.int64)
    distance = hamming_matrix(query, candidate)
    rows = np.arange(len(query))
    to_candidate, to_query = distance.argmin(1), distance.argmin(0)
    best = distance[rows, to_candidate]
    keep = (to_query[to_candidate] == rows) & (best <= max_distance)
    rows, cols, best = rows[keep], to_candidate[keep], best[keep]
    distance[rows, cols] = 257
    runner_up = np.minimum(distance[rows].min(1), distance[:, cols].min(0))
    keep = best < ratio * runner_up
    return np.stack([rows[keep], cols[keep]], axis=1)
