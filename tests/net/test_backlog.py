"""Limits for waiting data of a connection, and how long peers are blocked; without sockets."""

from __future__ import annotations

from share.net.backlog import PART_OVERHEAD_BYTES, SMALL_PARTS_FACTOR, Backlog, BacklogLimits, wire_bytes
from share.net.connection_gate import FIRST_BLOCK_S, MAX_BLOCK_S, Blocklist
from share.types import DESCRIPTOR_BYTES, MAX_KEYPOINTS
from share.wire.codec import MAX_HEADER_BYTES
from share.wire.layouts import MAX_FRAME_BYTES, MAX_IMAGE_BYTES


def test_the_largest_keyframe_is_less_than_a_message_may_have() -> None:
    poses = 8 * (16 + 36 + 16 + 3)
    points = MAX_KEYPOINTS * (8 + 12 + DESCRIPTOR_BYTES)
    for sealed in (False, True):
        bounds = BacklogLimits.for_frame_size(MAX_FRAME_BYTES)
        assert MAX_HEADER_BYTES + poses + points + 10 * wire_bytes(0, sealed) < bounds.message_bytes
        assert 16 * bounds.message_bytes <= bounds.peer_bytes <= bounds.total_bytes  # the ledger's window


def test_two_of_the_largest_images_are_less_too() -> None:
    assert (
        BacklogLimits.for_frame_size(MAX_IMAGE_BYTES).message_bytes
        > 2 * MAX_IMAGE_BYTES + 20_000 * 56 + MAX_HEADER_BYTES
    )


def test_part_sizes_on_the_wire() -> None:
    assert [wire_bytes(size, False) for size in (0, 255, 256)] == [2, 257, 265]
    assert [wire_bytes(size, True) for size in (0, 222, 223)] == [35, 257, 265]


def test_small_parts_weigh_more_than_their_bytes() -> None:
    keyframes, pings, empty = Backlog(0.0), Backlog(0.0), Backlog(0.0)
    keyframes.deliver(16 * 25_000, 16 * 9, 16, 0.0)
    pings.deliver(100 * 32, 100, 100, 0.0)
    empty.deliver(100_000, 50_000, 50_000, 0.0)
    assert (
        keyframes.memory_per_byte < 2.0 < pings.memory_per_byte < SMALL_PARTS_FACTOR < empty.memory_per_byte
    )
    empty.update_read(200_000, True)
    assert empty.memory_bytes > 50_000 * PART_OVERHEAD_BYTES * 0.9


def test_earlier_large_parts_hide_small_ones_only_briefly() -> None:
    account = Backlog(0.0)
    account.deliver(100_000_000, 1000, 100, 0.0)
    assert account.memory_per_byte < 2.0
    account.deliver(200_000, 100_000, 100_000, 0.0)
    assert account.memory_per_byte > SMALL_PARTS_FACTOR


def test_heartbeats_do_not_add_up() -> None:
    account, read = Backlog(0.0), 0
    for second in range(10_000):
        read += 100 + 500  # heartbeats and a message
        account.deliver(500, 1, 1, float(second))
        account.update_read(read, True)
        account.mark()
        account.classify_commands()
        assert account.waiting_bytes <= 200


def test_an_endless_message_adds_up_at_any_speed() -> None:
    account, read = Backlog(0.0), 0
    for second in range(1000):
        read += 100
        account.update_read(read, True)
        account.mark()
        account.classify_commands()
        assert account.waiting_bytes == 100 * (second + 1)


def test_partial_messages_do_not_hide_an_endless_one() -> None:
    account, read = Backlog(0.0), 64
    account.update_read(read, True)
    for second in range(100):
        read += 1000  # the rest of one, and half of the next
        account.deliver(1000, 1, 1, float(second))
        account.update_read(read + 500, True)
        account.mark()
        account.classify_commands()
    for _ in range(10):  # the last does not end
        read += 1000
        account.update_read(read + 500, True)
        account.mark()
        account.classify_commands()
    assert account.waiting_bytes >= 10_000


def test_an_inexact_count_is_a_lower_bound() -> None:
    account = Backlog(0.0)
    account.update_read(1000, True)
    account.deliver(100, 1, 1, 1.0)
    account.update_read(200, False)  # some came while it was asked
    assert account.waiting_bytes == 900


def test_the_blocking_time_doubles() -> None:
    keep, now = Blocklist(), 0.0
    for lasts in (10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 600.0, 600.0):
        assert keep.block("bob", now) == lasts
        assert keep.is_blocked("bob", now + lasts - 0.1) and not keep.is_blocked("bob", now + lasts)
        assert not keep.is_blocked("ann", now)
        now += lasts + 1
    assert keep.block("bob", now + 2 * MAX_BLOCK_S) == FIRST_BLOCK_S


def test_offences_at_the_same_time_count_once() -> None:
    keep = Blocklist()
    assert [keep.block("bob", 0.1 * at) for at in range(5)] == [FIRST_BLOCK_S] * 5


def test_the_number_of_blocked_peers_is_bounded() -> None:
    keep = Blocklist()
    for number in range(1000):
        keep.block(str(number), 1e-3 * number)
    blocked = [number for number in range(1000) if keep.is_blocked(str(number), 1.0)]
    assert blocked == list(range(1000 - 256, 1000))
