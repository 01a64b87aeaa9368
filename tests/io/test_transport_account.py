"""How much may wait of a connection, and who is kept out for how long: without sockets."""

from __future__ import annotations

from share.net.account import PART_BYTES, TINY, Account, Bounds, wire_bytes
from share.net.gate import FIRST_S, MOST_S, KeepOut
from share.types import DESCRIPTOR_BYTES, MAX_KEYPOINTS
from share.wire.codec import MAX_FRAME_BYTES, MAX_HEADER_BYTES, MAX_IMAGE_BYTES


def test_the_largest_keyframe_is_less_than_a_message_may_have() -> None:
    poses = 8 * (16 + 36 + 16 + 3)
    points = MAX_KEYPOINTS * (8 + 12 + DESCRIPTOR_BYTES)
    for sealed in (False, True):
        bounds = Bounds.of(MAX_FRAME_BYTES)
        assert MAX_HEADER_BYTES + poses + points + 10 * wire_bytes(0, sealed) < bounds.message
        assert 16 * bounds.message <= bounds.peer <= bounds.total  # the ledger's window


def test_two_of_the_largest_images_are_less_too() -> None:
    assert Bounds.of(MAX_IMAGE_BYTES).message > 2 * MAX_IMAGE_BYTES + 20_000 * 56 + MAX_HEADER_BYTES


def test_part_sizes_on_the_wire() -> None:
    assert [wire_bytes(size, False) for size in (0, 255, 256)] == [2, 257, 265]
    assert [wire_bytes(size, True) for size in (0, 222, 223)] == [35, 257, 265]


def test_small_parts_weigh_more_than_their_bytes() -> None:
    keyframes, pings, empty = Account(0.0), Account(0.0), Account(0.0)
    keyframes.took(16 * 25_000, 16 * 9, 16, 0.0)
    pings.took(100 * 32, 100, 100, 0.0)
    empty.took(100_000, 50_000, 50_000, 0.0)
    assert keyframes.weight < 2.0 < pings.weight < TINY < empty.weight
    empty.sample(200_000, True)
    assert empty.memory > 50_000 * PART_BYTES * 0.9


def test_large_parts_of_before_hide_small_ones_not_for_long() -> None:
    account = Account(0.0)
    account.took(100_000_000, 1000, 100, 0.0)
    assert account.weight < 2.0
    account.took(200_000, 100_000, 100_000, 0.0)
    assert account.weight > TINY


def test_heartbeats_do_not_add_up() -> None:
    account, read = Account(0.0), 0
    for second in range(10_000):
        read += 100 + 500  # heartbeats and a message
        account.took(500, 1, 1, float(second))
        account.sample(read, True)
        account.mark()
        account.settle()
        assert account.waiting <= 200


def test_a_message_that_does_not_end_adds_up_however_slowly_it_comes() -> None:
    account, read = Account(0.0), 0
    for second in range(1000):
        read += 100
        account.sample(read, True)
        account.mark()
        account.settle()
        assert account.waiting == 100 * (second + 1)


def test_half_a_message_behind_each_is_no_way_to_hide_one() -> None:
    account, read = Account(0.0), 64
    account.sample(read, True)
    for second in range(100):
        read += 1000  # the rest of one, and half of the next
        account.took(1000, 1, 1, float(second))
        account.sample(read + 500, True)
        account.mark()
        account.settle()
    for _ in range(10):  # the last does not end
        read += 1000
        account.sample(read + 500, True)
        account.mark()
        account.settle()
    assert account.waiting >= 10_000


def test_what_is_not_known_exactly_changes_no_more_than_it_says() -> None:
    account = Account(0.0)
    account.sample(1000, True)
    account.took(100, 1, 1, 1.0)
    account.sample(200, False)  # some came while it was asked
    assert account.waiting == 900


def test_kept_out_twice_as_long_each_time() -> None:
    keep, now = KeepOut(), 0.0
    for lasts in (10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 600.0, 600.0):
        assert keep.offend("bob", now) == lasts
        assert keep.holds("bob", now + lasts - 0.1) and not keep.holds("bob", now + lasts)
        assert not keep.holds("ann", now)
        now += lasts + 1
    assert keep.offend("bob", now + 2 * MOST_S) == FIRST_S


def test_offences_at_the_same_time_count_once() -> None:
    keep = KeepOut()
    assert [keep.offend("bob", 0.1 * at) for at in range(5)] == [FIRST_S] * 5


def test_only_so_many_are_remembered() -> None:
    keep = KeepOut()
    for number in range(10_000):
        keep.offend(str(number), float(number))
    assert len(keep._ends) <= 256 and keep.holds("9999", 9999.0)
