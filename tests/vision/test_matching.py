import cv2
import numpy as np

from share.vision.matching import (
    DescriptorPairs,
    close_pairs,
    hamming_matrix,
    match_descriptors,
    mutual_best,
    pairs_within,
)


def test_hamming_agrees_with_opencv() -> None:
    rng = np.random.default_rng(0)
    a, b = (rng.integers(0, 256, (n, 32), np.uint8) for n in (40, 60))
    index = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(a, b, k=60)
    expected = np.zeros((40, 60))
    for row in index:
        for m in row:
            expected[m.queryIdx, m.trainIdx] = m.distance
    assert np.array_equal(hamming_matrix(a, b), expected)


def test_close_pairs_are_those_of_all_that_differ_little() -> None:
    """Nearly all: 95 % of those at the limit, and none beyond it."""
    rng = np.random.default_rng(4)
    a = rng.integers(0, 256, (300, 32), np.uint8)
    bits = rng.permuted(np.arange(256) < 40, axis=0)[None] & np.ones((300, 1), bool)
    b = a ^ np.packbits(rng.permuted(bits, axis=1), axis=1)
    expected = pairs_within(hamming_matrix(a, b), 40)
    found = close_pairs(a, b, 40)
    assert len(expected.rows) == 300 and 285 <= len(found.rows) <= 300
    assert {*zip(found.rows, found.cols, found.bits, strict=True)} <= {
        *zip(expected.rows, expected.cols, expected.bits, strict=True)
    }
    assert len(close_pairs(a, b, 39).rows) == 0
    assert len(close_pairs(a[:0], b, 40).rows) == len(close_pairs(a, b[:0], 40).rows) == 0


def test_finds_the_permutation_of_noisy_descriptors() -> None:
    rng = np.random.default_rng(1)
    a = rng.integers(0, 256, (300, 32), np.uint8)
    order = rng.permutation(300)
    b = a[order] ^ np.packbits(rng.random((300, 256)) < 0.05, axis=1)
    pairs = match_descriptors(a, b, 64, 0.9)
    assert len(pairs) == 300
    assert np.array_equal(order[pairs[:, 1]], pairs[:, 0])


def test_matching_is_symmetric_and_rejects_unlike_descriptors() -> None:
    rng = np.random.default_rng(2)
    a, b = (rng.integers(0, 256, (100, 32), np.uint8) for _ in range(2))
    assert len(match_descriptors(a, b, 64, 1.0)) == 0
    loose = match_descriptors(a, b, 256, 1.0)
    assert {tuple(p) for p in loose} == {(j, i) for i, j in match_descriptors(b, a, 256, 1.0)}


def test_mutual_pairs_are_the_best_of_row_and_column() -> None:
    """The first of equals; the most similar come first."""
    distance = np.array([[9, 3, 9], [2, 1, 9], [9, 9, 5], [9, 9, 5]], np.uint16)
    found = mutual_best(pairs_within(distance, 8))
    assert [tuple(map(int, pair)) for pair in zip(*found, strict=True)] == [(1, 1, 1), (2, 2, 5)]
    none = np.zeros(0, np.int64)
    assert len(mutual_best(DescriptorPairs(none, none, none.astype(np.uint16))).rows) == 0


def test_ratio_refuses_an_ambiguous_match() -> None:
    rng = np.random.default_rng(3)
    a = rng.integers(0, 256, (2, 32), np.uint8)
    twins = np.stack([a[0], a[0] ^ np.eye(1, 32, 0, dtype=np.uint8)[0]])
    noisy = a.copy()
    noisy[0, 5] ^= 0xFF
    assert 0 in match_descriptors(noisy, twins, 64, 1.0)[:, 0]
    assert 0 not in match_descriptors(noisy, twins, 64, 0.8)[:, 0]


def test_too_few_descriptors_match_nothing() -> None:
    one = np.zeros((1, 32), np.uint8)
    assert match_descriptors(one, one, 64, 1.0).shape == (0, 2)
    assert match_descriptors(np.zeros((0, 32), np.uint8), one, 64, 1.0).shape == (0, 2)
