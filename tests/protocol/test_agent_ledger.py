"""The agent's ledger and chain of keyframes."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest

from share.earlier_poses import MAX_EARLIER, EarlierPoses
from share.geometry import se3
from share.protocol.agent_ledger import KeyframeChain, KeyframeLedger, LedgerEntry, select_earlier
from share.types import Keyframe, OdometryKeyframe, View
from share.wire.messages import Ack, Welcome

S = 1_000_000_000
EMPTY = View(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 32)))
RNG = np.random.default_rng(5)
STEPS = se3.exp(RNG.normal(scale=0.2, size=(100, 6)))
ODOMETRY = [np.eye(4)]
for step in STEPS:
    ODOMETRY.append(se3.orthonormal(ODOMETRY[-1] @ step))
COV = np.diag([1.0, 2, 3, 4, 5, 6]) * 1e-6


def candidate(k: int, new_stretch: bool = False) -> OdometryKeyframe:
    T_last_body = ODOMETRY[k] if k == 0 or new_stretch else se3.inverse(ODOMETRY[k - 1]) @ ODOMETRY[k]
    return OdometryKeyframe(ODOMETRY[k], T_last_body, COV, np.array([0, 0, 1.0]), 0.01, EMPTY, new_stretch)


def entries(n: int, new_segments: tuple[int, ...] = ()) -> list[LedgerEntry]:
    chain = KeyframeChain()
    made = []
    for k in range(n):
        chain.extend(candidate(k, k in new_segments))
        made.append(LedgerEntry(chain.make_keyframe(candidate(k), k), frame_index=k, arrived_ns=k))
    return made


def ledger(n: int, keep: int = 100, window: int = 4, new_segments: tuple[int, ...] = ()) -> KeyframeLedger:
    book = KeyframeLedger(keep, window)
    for entry in entries(n, new_segments):
        book.add(entry)
    return book


def due(book: KeyframeLedger, now_ns: int) -> list[int]:
    return [entry.keyframe.id for entry in book.take_due(now_ns)]


def links(book: KeyframeLedger) -> list[tuple[int, int, int]]:
    """(id, reference, predecessor) of all pending keyframes."""
    return [(e.keyframe.id, e.keyframe.reference, e.keyframe.predecessor) for e in book.pending]


def test_the_chain_composes_candidates_that_were_not_sent() -> None:
    chain = KeyframeChain()
    chain.extend(candidate(0))
    chain.make_keyframe(candidate(0), 0)
    chain.extend(candidate(1))
    chain.extend(candidate(2))
    keyframe = chain.make_keyframe(candidate(2), 2)
    assert (keyframe.id, keyframe.reference, keyframe.predecessor) == (1, 0, 0)
    np.testing.assert_allclose(keyframe.T_ref_body, STEPS[0] @ STEPS[1], atol=1e-12)
    np.testing.assert_allclose(keyframe.cov, se3.compose_cov(STEPS[1], COV, COV), atol=1e-15)


def test_a_segment_starts_even_if_its_first_candidate_was_not_sent() -> None:
    chain = KeyframeChain()
    chain.extend(candidate(0))
    chain.make_keyframe(candidate(0), 0)
    chain.extend(candidate(1, new_stretch=True))
    chain.extend(candidate(2))
    keyframe = chain.make_keyframe(candidate(2), 2)
    assert (keyframe.reference, keyframe.predecessor, chain.first_of_segment) == (-1, 0, 1)
    np.testing.assert_array_equal(keyframe.T_ref_body, ODOMETRY[2])


def reaching_back(k: int, *candidates: int, new_segment: bool = False) -> OdometryKeyframe:
    """Candidate k with its pose relative to others, that differs from the chain's."""
    T = np.array([se3.inverse(ODOMETRY[i]) @ ODOMETRY[k] @ se3.exp(np.full(6, 0.01)) for i in candidates])
    cov = np.array([(k - i) * COV for i in candidates])
    return replace(candidate(k, new_segment), earlier=EarlierPoses(np.array(candidates, np.int64), T, cov))


def chain_of(sent: Collection[int], n: int, back: int = 20) -> tuple[KeyframeChain, list[Keyframe]]:
    """Return the chain of n candidates with stamps 0 .. n - 1; those `sent` become keyframes."""
    chain, made = KeyframeChain(), []
    for k in range(n):
        one = reaching_back(k, *range(max(0, k - back), k)) if k else candidate(0)
        chain.extend(one)
        if k in sent:
            made.append(chain.make_keyframe(one, k))
    return chain, made


def test_the_pose_relative_to_the_reference_is_the_trackers_where_it_knows_it() -> None:
    _, made = chain_of([0, 2, 5], 6)
    for keyframe, (before, k) in zip(made[1:], [(0, 2), (2, 5)], strict=True):
        T = se3.inverse(ODOMETRY[before]) @ ODOMETRY[k] @ se3.exp(np.full(6, 0.01))
        np.testing.assert_allclose(keyframe.T_ref_body, T, atol=1e-6)
        np.testing.assert_allclose(keyframe.cov, (k - before) * COV, rtol=1e-6)


def test_where_it_does_not_know_it_the_candidates_are_composed() -> None:
    """The reference has left the tracker's window, or was dropped by it."""
    _, made = chain_of([0, 1, 5], 6, back=2)
    assert len(made[2].earlier) == 0
    np.testing.assert_allclose(made[2].T_ref_body, se3.inverse(ODOMETRY[1]) @ ODOMETRY[5], atol=1e-12)
    assert made[2].cov[0, 0] > 3 * COV[0, 0]


def test_the_pose_relative_to_another_keyframe_is_not_taken_for_that_to_the_reference() -> None:
    chain, _ = chain_of([0, 1], 2)
    chain.extend(reaching_back(2, 0))
    keyframe = chain.make_keyframe(reaching_back(2, 0), 2)
    assert (keyframe.reference, keyframe.earlier.ids.tolist()) == (1, [0])
    np.testing.assert_allclose(keyframe.T_ref_body, STEPS[1], atol=1e-12)


def test_earlier_poses_are_relative_to_keyframes_that_were_sent_by_their_ids() -> None:
    sent = [0, 3, 4, 7, 8, 9, 12, 15]
    _, made = chain_of(sent, 16)
    last = made[-1]
    assert last.id == 7 and last.reference == 6
    assert last.earlier.ids.tolist() == [0, 4]  # nearest to 13, 7 and 3 keyframes back
    for id_, T, cov in zip(last.earlier.ids, last.earlier.T_earlier_body, last.earlier.cov, strict=True):
        truth = se3.inverse(ODOMETRY[sent[id_]]) @ ODOMETRY[15] @ se3.exp(np.full(6, 0.01))
        np.testing.assert_allclose(T, truth, atol=1e-6)
        np.testing.assert_allclose(cov, (15 - sent[id_]) * COV, rtol=1e-6)
    assert made[0].earlier.ids.tolist() == made[1].earlier.ids.tolist() == []


@pytest.mark.parametrize(
    ("known", "kept"),
    [
        (range(10, 40), [27, 33, 37]),
        ([39], []),  # only the reference
        ([38, 39], [38]),
        ([20, 39], [20]),
        ([30, 31, 39], [30, 31]),  # 31 for 7 and for 3 back
    ],
)
def test_earlier_poses_are_spread(known: Collection[int], kept: list[int]) -> None:
    assert select_earlier(reaching_back(40, *known).earlier, 40).ids.tolist() == kept


@pytest.mark.parametrize("how", ["candidate", "told"])
def test_a_new_segment_is_relative_to_nothing_and_nothing_later_to_the_one_before(how: str) -> None:
    chain, _ = chain_of(range(8), 8)
    if how == "told":
        chain.begin_segment()
    made = []
    for k in range(8, 16):
        one = reaching_back(k, *range(k), new_segment=how == "candidate" and k == 8)
        chain.extend(one)
        made.append(chain.make_keyframe(one, k))
    assert (made[0].reference, len(made[0].earlier)) == (-1, 0)
    np.testing.assert_array_equal(made[0].T_ref_body, ODOMETRY[8])
    assert {i for keyframe in made for i in keyframe.earlier.ids.tolist()} == {8, 9, 10, 11, 12}


def test_the_ids_of_keyframes_are_kept_as_long_as_they_may_be_needed() -> None:
    chain, made = chain_of(range(70), 70, back=MAX_EARLIER)
    assert [69 - i for i in made[-1].earlier.ids.tolist()] == [13, 7, 3]
    assert len(chain._ids) == MAX_EARLIER


def book_of(made: list[Keyframe], capacity: int = 100) -> KeyframeLedger:
    book = KeyframeLedger(capacity, 100)
    for k, keyframe in enumerate(made):
        book.add(LedgerEntry(keyframe, k, k))
    return book


def test_a_keyframe_that_starts_a_segment_for_a_restarted_edge_has_no_earlier_poses() -> None:
    _, made = chain_of(range(20), 20)
    book = book_of(made)
    book.take_due(0)
    book.acknowledge(Ack(15))
    for k in range(15):  # they are dropped
        book._acknowledged.pop(k, None)
    book.begin_session(Welcome(2, 0))
    pending = [entry.keyframe for entry in book.pending]
    assert [(one.id, one.reference, len(one.earlier)) for one in pending[:2]] == [(15, -1, 0), (16, 15, 3)]


def test_a_rebased_keyframe_keeps_its_earlier_poses() -> None:
    """They do not depend on the reference; the edge leaves out those that it does not have."""
    _, made = chain_of(range(12), 12)
    book = book_of(made[9:], capacity=2)
    assert book.counts["drop_oldest"] == 1
    rebased = book.pending[0].keyframe
    assert (rebased.id, rebased.reference) == (10, 8)
    np.testing.assert_array_equal(rebased.earlier.ids, made[10].earlier.ids)
    np.testing.assert_allclose(rebased.T_ref_body, made[9].T_ref_body @ made[10].T_ref_body)


def test_the_window_moves_with_the_acknowledgements() -> None:
    book = ledger(10)
    assert due(book, 0) == [0, 1, 2, 3]
    assert due(book, 0) == []
    book.acknowledge(Ack(2))
    assert due(book, 1) == [4, 5]
    assert (len(book.pending), book.counts["sent"], book.counts["acknowledged"]) == (8, 6, 2)


def test_the_resend_interval_doubles() -> None:
    book = ledger(1)
    times = []
    for t in range(0, 40 * S, S // 10):
        times += [t] if due(book, t) else []
        book.record_answer(t)
    assert np.diff(times).tolist() == [S, 2 * S, 4 * S, *[8 * S] * 4]
    assert (book.counts["sent"], book.counts["resent"]) == (1, 7)


def test_what_is_still_on_its_way_is_not_sent_again() -> None:
    """A link keeps the order: while what was sent later is not answered either, it waits in a queue."""
    book = ledger(2)
    assert due(book, S) == [0, 1]
    book.record_answer(S)  # a ping, right before them
    assert due(book, 20 * S) == []
    book.acknowledge(Ack(1))
    book.record_answer(S + S // 2)  # a ping that came after them
    assert due(book, 20 * S) == [1]
    assert due(book, 60 * S) == []  # the second one is on its way


def test_a_gap_is_resent_soon_and_buffered_keyframes_are_not() -> None:
    book = ledger(4)
    due(book, 0)
    book.acknowledge(Ack(1, (2, 3)))
    assert due(book, S // 20) == []  # it may still be on its way
    assert due(book, S // 10) == [1]
    book.record_answer(S)  # a ping
    assert due(book, 2 * S) == []
    assert due(book, 2 * S + S // 10) == [1]
    book.acknowledge(Ack(4))
    assert due(book, 9 * S) == []


def test_an_edge_that_cannot_store_is_not_sent_the_same_again_and_again() -> None:
    """Its disk is full: all that has arrived waits for it, and each duplicate is answered."""
    book, sent = KeyframeLedger(100, window=4), []
    new = entries(4)
    for now in range(0, 30 * S, S // 20):
        if new and now >= new[0].frame_index * S // 5:
            book.add(new.pop(0))
        for keyframe_id in due(book, now):
            sent.append((now, keyframe_id))
            arrived = sorted({one for _, one in sent})
            book.acknowledge(Ack(0, tuple(arrived)))
    assert [keyframe_id for _, keyframe_id in sent if keyframe_id] == [1, 2, 3]
    assert np.diff([now for now, keyframe_id in sent if not keyframe_id]).tolist() == [
        S,
        2 * S,
        4 * S,
        8 * S,
        8 * S,
    ]


def test_a_gap_that_does_not_close_is_resent_soon_once_for_what_has_arrived_since() -> None:
    book = ledger(4, window=5)
    due(book, 0)
    lost, buffered = [], (1, 2, 3)
    for now in range(S // 20, 20 * S, S // 20):
        book.record_answer(now)  # a ping
        book.acknowledge(Ack(0, buffered))
        if now == 5 * S:
            book.add(entries(5)[4])  # it arrives: the second resend is lost too
        for keyframe_id in due(book, now):
            lost += [now] if keyframe_id == 0 else []
            buffered = (*buffered, keyframe_id) if keyframe_id else buffered
    assert np.diff(np.array([0, *lost]) / S).tolist() == pytest.approx([0.1, 2.0, 2.95, 8.0])


def test_old_and_impossible_acknowledgements_are_ignored() -> None:
    book = ledger(8)
    due(book, 0)
    book.acknowledge(Ack(3))
    book.acknowledge(Ack(1))
    assert len(book.pending) == 5
    book.acknowledge(Ack(9))  # more than was ever sent
    assert (len(book.pending), book.counts["invalid_acks"]) == (5, 1)


def test_a_full_ledger_drops_the_oldest_acknowledged_first() -> None:
    book = ledger(6, keep=6)
    due(book, 0)
    book.acknowledge(Ack(2))
    for entry in entries(8)[6:]:
        book.add(entry)
    assert (len(book), len(book.pending)) == (6, 6)
    assert book.counts == {"sent": 4, "acknowledged": 2, "drop_oldest_acknowledged": 2}
    assert links(book)[0] == (2, 1, 1)  # the edge has keyframe 1, though we have it no more


@pytest.mark.parametrize("acknowledged", [0, 1])
def test_a_ledger_full_of_pending_keyframes_drops_the_oldest_and_rebases_the_next(acknowledged: int) -> None:
    book = ledger(5, keep=5)
    due(book, 0)
    book.acknowledge(Ack(acknowledged))
    for entry in entries(9)[5:]:
        book.add(entry)
    reference = acknowledged - 1
    assert links(book)[0] == (4, reference, reference)
    assert book.counts["drop_oldest"] == 4 - acknowledged
    first = book.pending[0].keyframe
    T_odom_ref = ODOMETRY[reference] if reference >= 0 else np.eye(4)
    np.testing.assert_allclose(first.T_ref_body, se3.inverse(T_odom_ref) @ ODOMETRY[4], atol=1e-9)
    cov = COV
    for step in STEPS[reference + 1 : 4] if reference >= 0 else STEPS[:4]:
        cov = se3.compose_cov(step, cov, COV)
    np.testing.assert_allclose(first.cov, cov, rtol=1e-9)


def test_dropping_the_end_of_a_segment_does_not_change_the_next_one() -> None:
    book = ledger(5, keep=2, new_segments=(3,))
    assert links(book) == [(3, -1, -1), (4, 3, 3)]
    np.testing.assert_array_equal(book.pending[0].keyframe.T_ref_body, ODOMETRY[3])


def test_the_window_is_resent_after_silence() -> None:
    book = ledger(6)
    due(book, 0)
    book.resume(Welcome(1, 2))
    assert due(book, 1) == [2, 3, 4, 5]


def test_an_edge_without_map_is_sent_the_whole_ledger() -> None:
    book = ledger(8, keep=5)
    due(book, 0)
    book.acknowledge(Ack(4))
    for entry in entries(9)[8:]:
        book.add(entry)
    assert len(book) == 5
    assert book.begin_session(Welcome(2, 0)) == 5
    assert links(book)[:2] == [(4, -1, -1), (5, 4, 4)]
    np.testing.assert_array_equal(book.pending[0].keyframe.T_ref_body, ODOMETRY[4])
    assert due(book, 1) == [4, 5, 6, 7]


def test_keyframes_acknowledged_in_an_earlier_session_are_marked() -> None:
    book = ledger(4)
    due(book, 0)
    book.acknowledge(Ack(2))
    book.begin_session(Welcome(2, 0))
    assert [entry.is_replayed for entry in book.take_due(1)] == [True, True, False, False]


def test_an_edge_with_map_continues() -> None:
    book = ledger(6)
    due(book, 0)
    book.acknowledge(Ack(4))
    assert book.begin_session(Welcome(2, 3)) == 3
    assert links(book)[0] == (3, 2, 2)
    assert book.last_acknowledged is not None
    assert book.last_acknowledged.keyframe.id == 2


def test_an_edge_restored_from_an_older_map_gets_a_new_segment() -> None:
    book = ledger(8, keep=4)
    book.begin_session(Welcome(1, 0))
    assert book.begin_session(Welcome(2, 2)) == 4  # it has 0 and 1; 2 and 3 are gone for good
    assert links(book)[0][0] == 4


def test_find_covers_acknowledged_and_pending_keyframes() -> None:
    book = ledger(4)
    due(book, 0)
    book.acknowledge(Ack(2))
    assert [getattr(book.find(k), "frame_index", None) for k in (0, 3, 9)] == [0, 3, None]
