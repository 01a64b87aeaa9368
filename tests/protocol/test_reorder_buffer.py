"""Reordering of keyframes at the edge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from share.protocol.keyframe_intake import ReorderBuffer
from share.types import MAX_JPEG_BYTES, MAX_SURFACES, Keyframe, KeyframeImage, View
from share.wire.messages import Ack

EMPTY = View(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 32)))


def keyframe(id_: int, predecessor: int | None = None, reference: int | None = None) -> Keyframe:
    """A keyframe, by default relative to its predecessor."""
    predecessor = id_ - 1 if predecessor is None else predecessor
    reference = predecessor if reference is None else reference
    eye = np.eye(4)
    return Keyframe(id_, reference, id_, eye, np.eye(6), eye, np.zeros(3), 0.0, EMPTY, predecessor)


def ids(keyframes: list[Keyframe]) -> list[int]:
    return [k.id for k in keyframes]


def test_keyframes_in_order_are_applied_at_once() -> None:
    book = ReorderBuffer()
    assert [ids(book.push(keyframe(k))) for k in range(3)] == [[0], [1], [2]]
    assert book.ack() == Ack(3)


def test_keyframes_after_a_gap_are_buffered() -> None:
    book = ReorderBuffer()
    book.push(keyframe(0))
    assert book.push(keyframe(3)) == book.push(keyframe(2)) == []
    assert book.ack() == Ack(1, (2, 3))
    assert ids(book.push(keyframe(1))) == [1, 2, 3]
    assert book.ack() == Ack(4)


def test_duplicates_are_ignored_and_acknowledged_again() -> None:
    book = ReorderBuffer()
    book.push(keyframe(0))
    assert book.push(keyframe(0)) == []
    book.push(keyframe(2))
    assert book.push(keyframe(2)) == []
    assert book.duplicates == 2
    assert book.ack() == Ack(1, (2,))


def test_a_new_segment_does_not_overtake() -> None:
    book = ReorderBuffer()
    book.push(keyframe(0))
    assert book.push(keyframe(2, predecessor=1, reference=-1)) == []
    assert ids(book.push(keyframe(1))) == [1, 2]


def test_dropped_ids_are_skipped() -> None:
    book = ReorderBuffer()
    book.push(keyframe(0))
    assert ids(book.push(keyframe(5, predecessor=0))) == [5]
    assert book.push(keyframe(3)) == []  # dropped by the agent, but late on its way
    assert book.ack() == Ack(6)


def test_the_later_version_of_a_buffered_keyframe_is_used() -> None:
    book = ReorderBuffer()
    book.push(keyframe(0))
    book.push(keyframe(2))
    assert ids(book.push(keyframe(2, predecessor=0))) == [2]
    book.push(keyframe(5))
    assert book.push(keyframe(5)) == []


def test_an_old_version_does_not_replace_a_later_one() -> None:
    book = ReorderBuffer()
    book.push(keyframe(9, predecessor=3))
    book.push(keyframe(9, predecessor=8))
    assert ids(book.push(keyframe(3, predecessor=-1))) == [3, 9]


def test_an_edge_without_map_starts_at_any_id() -> None:
    assert ids(ReorderBuffer().push(keyframe(40, predecessor=-1))) == [40]


def test_an_edge_with_map_continues() -> None:
    book = ReorderBuffer(next_keyframe=40)
    assert book.push(keyframe(39)) == []
    assert ids(book.push(keyframe(40))) == [40]


def test_the_buffer_is_bounded() -> None:
    book = ReorderBuffer(capacity=4)
    for k in (9, 8, 7, 6, 5, 4, 3, 2, 1):
        assert book.push(keyframe(k)) == []
    assert book.ack() == Ack(0, (1, 2, 3, 4))
    assert book.evicted == 5
    assert ids(book.push(keyframe(0))) == [0, 1, 2, 3, 4]


def test_waiting_keyframes_are_bounded_in_bytes() -> None:
    """More of those with the largest image and most surfaces than an agent has in flight."""
    none = np.zeros((MAX_SURFACES, 3), np.float32)
    jpeg = np.zeros(MAX_JPEG_BYTES, np.uint8)
    image = KeyframeImage(jpeg, none[:, :2], none, none[:, 0])
    buffer = ReorderBuffer()
    for k in range(1, 64):
        buffer.push(replace(keyframe(k), image=image))
    assert buffer.ack().buffered == tuple(range(1, 17 + 1))
    assert buffer.evicted == 63 - 17
