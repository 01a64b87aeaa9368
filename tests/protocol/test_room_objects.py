"""Objects of the room: placed, moved, removed, seen by all; loss, disorder, restarts, joins of maps."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.room_bench import Air, RoomBench, at

from share.protocol import room_events as ev
from share.protocol.common_events import EdgeMessageReceived
from share.protocol.object_replica import ObjectReplica
from share.protocol.room_objects import MAX_OBJECTS, MAX_OWNED
from share.wire import room_messages as room
from share.wire.codec import encode
from share.wire.room_messages import ObjectKind, Permission

MAP = "ann-1/0"


@pytest.fixture
def bench() -> RoomBench:
    """An agent ann in a map, and two clients."""
    return prepared(RoomBench())


def prepared(bench: RoomBench) -> RoomBench:
    bench.correct(bench.agent("ann", 1), MAP, np.eye(4))
    bench.ann = bench.client("ann", 11, wants_objects=True)  # type: ignore[attr-defined]
    bench.bob = bench.client("bob", 12, wants_objects=True)  # type: ignore[attr-defined]
    bench.run(0.2)
    return bench


def positions(bench: RoomBench, peer: bytes) -> dict[int, tuple[float, ...]]:
    objects = bench.clients[peer].objects
    return {n: tuple(np.round(one.T_map_object[:3, 3], 6).tolist()) for n, one in objects.items()}


def answers(bench: RoomBench, peer: bytes) -> dict[int, str]:
    return {one.request: one.reason for one in bench.of(peer, ev.RequestAnswered)}


def test_what_one_places_all_see_in_the_next_step(bench) -> None:
    bench.put(bench.ann, 1, 7, at(1, 2), MAP)
    bench.run(0.02)
    assert positions(bench, bench.bob) == {7: (1, 2, 0)} == positions(bench, bench.ann)
    (seen,) = bench.clients[bench.bob].objects.values()
    assert (seen.owner, seen.kind, seen.map_id) == ("ann", ObjectKind.CUBE, MAP)
    assert answers(bench, bench.ann) == {1: ""}


def test_another_may_move_it_and_remove_it_and_the_owner_stays(bench) -> None:
    bench.put(bench.ann, 1, 7, at(1, 2), MAP)
    bench.run(0.1)
    bench.put(bench.bob, 1, 7, at(3, 4), MAP)
    bench.run(0.1)
    assert positions(bench, bench.ann) == {7: (3, 4, 0)}
    assert bench.clients[bench.ann].objects[7].owner == "ann"
    bench.to_client(bench.bob, ev.MessageWanted(room.RemoveObject(2, 7)))
    bench.run(0.1)
    assert positions(bench, bench.ann) == {}
    assert bench.of(bench.ann, ev.ObjectChanged)[-1].changed.removed == "removed by 'bob'"


def test_without_a_map_id_it_is_that_of_the_senders_agent(bench) -> None:
    bench.correct(bench.agent("carl", 2), "carl-1/0", np.eye(4))
    bench.put(bench.ann, 1, 7, at(1, 2))
    bench.put(bench.bob, 1, 8, at(1, 2))
    bench.run(0.1)
    assert bench.clients[bench.ann].objects[7].map_id == MAP
    assert answers(bench, bench.bob) == {1: "the room has no map yet, or several; name one (map_id)"}


def test_without_an_agent_it_is_the_only_map_of_the_room() -> None:
    bench = RoomBench()
    bench.solved(MAP)
    bob = bench.client("bob", 12, wants_objects=True)
    bench.run(0.1)
    bench.put(bob, 1, 8, at(1, 2))
    bench.run(0.1)
    assert answers(bench, bob) == {1: ""} and bench.clients[bob].objects[8].map_id == MAP


@pytest.mark.parametrize("seed", range(8))
def test_loss_doubles_and_disorder_heal(seed: int) -> None:
    bench = prepared(RoomBench(seed=seed))
    bench.air = Air(0.3, 0.3, 400)
    rng = np.random.default_rng(seed)
    last: dict[int, tuple[float, ...]] = {}
    for request in range(1, 120):
        object_id = int(rng.integers(5))
        if rng.random() < 0.1 and object_id in last:
            bench.to_client(bench.ann, ev.MessageWanted(room.RemoveObject(request, object_id)))
            del last[object_id]
        else:
            last[object_id] = (float(request), 0.0, 0.0)
            bench.put(bench.ann, request, object_id, at(request, 0), MAP)
        bench.run(0.06)
    bench.run(12)
    assert positions(bench, bench.ann) == last == positions(bench, bench.bob)
    kept = [one.object for one in bench.edge.room.kept_objects()]
    assert {one.object_id: tuple(one.T_map_object[:3, 3]) for one in kept} == last
    # a removal whose put was lost, and that took its place, finds nothing
    assert all(not one or one.startswith("there is no object") for one in answers(bench, bench.ann).values())


def test_the_same_request_again_changes_nothing_and_has_the_same_answer(bench) -> None:
    put = room.PutObject(5, 7, ObjectKind.CUBE, MAP, at(1, 2))
    bench.said(bench.ann, put)
    revision = bench.edge.room._objects.objects.revision
    bench.heard(bench.ann)
    bench.said(bench.ann, put)
    assert bench.edge.room._objects.objects.revision == revision
    assert bench.heard(bench.ann) == [room.Receipt(5)]


def test_a_late_put_does_not_bring_back_what_a_later_one_changed(bench) -> None:
    bench.said(bench.ann, room.PutObject(5, 7, ObjectKind.CUBE, MAP, at(1, 2)))
    bench.said(bench.ann, room.PutObject(8, 7, ObjectKind.CUBE, MAP, at(5, 5)))
    bench.said(bench.ann, room.PutObject(6, 7, ObjectKind.CUBE, MAP, at(3, 3)))
    bench.said(bench.ann, room.RemoveObject(9, 7))
    bench.said(bench.ann, room.PutObject(7, 7, ObjectKind.CUBE, MAP, at(4, 4)))
    bench.run(0.1)
    assert positions(bench, bench.bob) == {}


def test_a_receipt_waits_for_the_disk_and_the_others_do_not() -> None:
    bench = prepared(RoomBench(has_store=True))
    bench.is_disk_slow = True
    bench.put(bench.ann, 1, 7, at(1, 2), MAP)
    bench.run(2)
    assert positions(bench, bench.bob) == {7: (1, 2, 0)}
    assert answers(bench, bench.ann) == {}
    bench.is_disk_slow = False
    bench.run(0.1)
    assert answers(bench, bench.ann) == {1: ""}


def test_of_a_slow_disk_no_more_than_64_requests_wait() -> None:
    bench = prepared(RoomBench(has_store=True))
    bench.is_disk_slow = True
    for request in range(1, 200):
        bench.said(bench.ann, room.PutObject(request, 7, ObjectKind.CUBE, MAP, at(request, 0)))
        bench.now_ns += 30_000_000
    assert len(bench.edge.room._objects._unsaved) == 64
    assert "wait for the disk" in bench.edge.report({})["clients"][0]["last_refusal"]


@pytest.mark.parametrize("has_store", [False, True])
def test_objects_and_open_requests_survive_a_restart_of_the_edge(has_store: bool) -> None:
    bench = prepared(RoomBench(has_store=has_store))
    bench.put(bench.ann, 1, 7, at(1, 2), MAP)
    bench.put(bench.ann, 2, 8, at(1, 2), MAP)
    bench.run(0.1)
    bench.air.loss = 1.0
    bench.put(bench.ann, 3, 9, at(3, 3), MAP)
    bench.to_client(bench.bob, ev.MessageWanted(room.RemoveObject(1, 8)))
    bench.run(0.1)
    bench.restart_edge()
    bench.air.loss = 0.0
    bench.correct(bench.agent("ann", 1), MAP, np.eye(4))
    bench.run(5)
    assert positions(bench, bench.ann) == {7: (1, 2, 0), 9: (3, 3, 0)} == positions(bench, bench.bob)
    assert answers(bench, bench.ann)[3] == ""


def test_a_removal_that_the_dead_edge_had_done_counts_as_done(bench) -> None:
    bench.put(bench.ann, 1, 7, at(1, 2), MAP)
    bench.run(0.1)
    bench.to_client(bench.ann, ev.MessageWanted(room.RemoveObject(2, 7)))
    bench.pass_on()
    bench.under_way.clear()  # the receipt is lost
    bench.restart_edge()
    bench.run(5)
    assert answers(bench, bench.ann)[2] == ""


def test_a_removal_that_is_refused_after_a_restart_is_not_done(bench) -> None:
    bench.put(bench.bob, 1, 7, at(1, 2), MAP)
    bench.run(0.1)
    bench.rights["ann"] = frozenset()
    bench.to_client(bench.ann, ev.MessageWanted(room.RemoveObject(2, 7)))
    bench.pass_on()  # to an edge that dies before it answers
    bench.restart_edge()
    bench.run(5)
    assert "nobody may place objects here" in answers(bench, bench.ann)[2]
    assert 7 in positions(bench, bench.bob)


def test_a_client_that_was_away_sees_what_there_is(bench) -> None:
    bench.put(bench.ann, 1, 7, at(1, 2), MAP)
    bench.put(bench.ann, 2, 8, at(1, 2), MAP)
    bench.run(0.5)
    away = bench.clients.pop(bench.bob)
    bench.to_client(bench.ann, ev.MessageWanted(room.RemoveObject(3, 7)))
    bench.run(70)  # the removal is no longer listed
    bench.clients[bench.bob] = away
    bench.run(3)
    assert positions(bench, bench.bob) == {8: (1, 2, 0)}
    assert bench.of(bench.bob, ev.ObjectChanged)[-1].changed.removed == "it was removed meanwhile"


def test_a_client_that_has_seen_all_is_sent_nothing_more(bench) -> None:
    bench.put(bench.ann, 1, 7, at(1, 2), MAP)
    bench.run(1)
    before = bench.edge.room.clients.get(bench.bob).counts["bytes_down"]
    bench.run(5)
    pongs = bench.edge.room.clients.get(bench.bob).counts["bytes_down"] - before
    assert pongs == 0  # pongs count with the unjoined, as those of all pings


def test_a_client_that_the_edge_forgot_without_its_knowing_joins_again(bench) -> None:
    send, bench.deliver = bench.deliver, lambda peer, frames: None  # only the way up is broken
    for _ in range(35):
        bench.run(0.1)
        bench.to_client(bench.ann, EdgeMessageReceived(encode(room.ObjectList(7, 0))))
    bench.deliver = send
    assert bench.edge.room.clients.get(bench.ann) is None and bench.clients[bench.ann].is_connected
    bench.run(2)
    assert bench.edge.room.clients.get(bench.ann) is not None


# ------------------------------------------------------------ bad input


def test_who_may_not_gets_one_line_and_nothing_changes() -> None:
    bench = prepared(RoomBench(rights={"bob": frozenset({Permission.COMMANDS})}))
    bench.put(bench.bob, 1, 7, at(1, 2), MAP)
    bench.run(0.2)
    line = "nobody may place objects here; start the edge with --allow objects"
    assert answers(bench, bench.bob) == {1: line}
    assert positions(bench, bench.ann) == {}
    assert bench.reasons("refused") == [f"client 'bob': {line}"]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"map_id": "eve-9/0"}, "there is no map eve-9/0"),
        ({"kind": ObjectKind.MARKER, "object_id": 1}, "object 1 is a cube; give another id"),
    ],
)
def test_refusals(bench, change, text) -> None:
    bench.put(bench.ann, 1, 1, at(0, 0), MAP)
    kind, object_id, map_id = (
        change.get(k, d) for k, d in (("kind", ObjectKind.CUBE), ("object_id", 2), ("map_id", MAP))
    )
    bench.put(bench.bob, 2, object_id, at(1, 1), map_id, kind=kind)
    bench.run(0.1)
    assert answers(bench, bench.bob) == {2: text}


@pytest.mark.parametrize("T", [at(10_000, 0), np.full((4, 4), np.nan), np.zeros((4, 4))])
def test_a_place_that_no_room_has_is_no_message(T) -> None:
    with pytest.raises(ValueError, match="T_map_object"):
        room.PutObject(1, 1, ObjectKind.CUBE, MAP, T)


def test_an_owner_and_the_room_have_their_limits(bench) -> None:
    for n in range(MAX_OWNED + 1):
        bench.said(bench.ann, room.PutObject(n, n, ObjectKind.CUBE, MAP, at(0, 0)))
        bench.now_ns += 10**8
    assert len(bench.edge.room.kept_objects()) == MAX_OWNED
    for k in range(5):
        peer = bench.client(f"c{k}", 100 + k)
        bench.pass_on()
        for n in range(MAX_OWNED):
            bench.said(peer, room.PutObject(n, 100 * (k + 1) + n, ObjectKind.CUBE, MAP, at(0, 0)))
            bench.now_ns += 10**8
        bench.to_client(peer, ev.ClientEnded())
    assert len(bench.edge.room.kept_objects()) == MAX_OBJECTS


def test_too_many_requests_are_neither_taken_nor_answered_and_come_again(bench) -> None:
    for n in range(200):
        bench.said(bench.ann, room.PutObject(n, n % 8, ObjectKind.CUBE, MAP, at(n, 0)))
    receipts = [one for one in bench.heard(bench.ann) if isinstance(one, room.Receipt)]
    assert 80 <= len(receipts) <= 82
    assert bench.edge.report({})["clients"][0]["last_refusal"] == "too many requests about objects"


# ------------------------------------------------------------ maps


def two_maps() -> tuple[RoomBench, str, str]:
    """ann and bob, each in a map of its own, with an object each."""
    bench = prepared(RoomBench())
    ann = bench.run_key("ann")
    bob = bench.agent("bob", 2)
    bench.correct(bob, "bob-2/0", np.eye(4))
    bench.put(bench.ann, 1, 1, at(1, 0), MAP)
    bench.put(bench.bob, 1, 2, at(2, 0), "bob-2/0")
    bench.run(0.5)
    return bench, ann, bob


JOIN = at(10.0, -3.0, 0.7)


def test_at_a_join_objects_move_when_the_first_agent_does_and_stay_where_it_saw_them() -> None:
    bench, _, bob = two_maps()
    bench.correct(bob, "bob-2/0", at(0.3, 0.0))  # its odometry drifts before the join
    bench.join(MAP, "bob-2/0", JOIN)
    bench.run(1)
    assert bench.clients[bench.ann].objects[2].map_id == "bob-2/0"  # bob is still shown its own map
    T_new_odom = at(10.2, -3.1, 0.71)
    bench.correct(bob, MAP, T_new_odom)
    bench.run(0.5)
    moved = bench.clients[bench.ann].objects[2]
    assert moved.map_id == MAP
    in_odom = np.linalg.inv(at(0.3, 0.0)) @ at(2, 0)
    np.testing.assert_allclose(moved.T_map_object, T_new_odom @ in_odom, atol=1e-9)
    assert bench.clients[bench.bob].objects[1].T_map_object[0, 3] == 1  # what was in the map that stays
    assert bench.reasons("objects moved") == [f"1 objects of map bob-2/0 are in map {MAP} now"]


def test_a_put_in_the_old_maps_name_is_re_expressed() -> None:
    bench, _, bob = two_maps()
    bench.join(MAP, "bob-2/0", JOIN)
    bench.correct(bob, MAP, JOIN)
    bench.put(bench.bob, 2, 3, at(2, 0), "bob-2/0")
    bench.run(0.5)
    put = bench.clients[bench.ann].objects[3]
    assert put.map_id == MAP
    np.testing.assert_allclose(put.T_map_object, JOIN @ at(2, 0), atol=1e-9)


def test_without_an_agent_in_the_old_map_the_mappers_transform_counts() -> None:
    bench, _, _ = two_maps()
    bench.run(4)  # both agents are silent: they have left
    bench.join(MAP, "bob-2/0", JOIN)
    bench.run(0.5)
    np.testing.assert_allclose(bench.clients[bench.ann].objects[2].T_map_object, JOIN @ at(2, 0), atol=1e-9)


def test_a_join_that_is_undone_takes_objects_back_with_their_agents() -> None:
    bench, _, bob = two_maps()
    bench.join(MAP, "bob-2/0", JOIN)
    bench.correct(bob, MAP, JOIN)
    bench.put(bench.bob, 2, 5, at(4, 4), MAP)  # placed in the joint map
    bench.run(0.2)
    bench.correct(bob, "bob-2/0", np.eye(4))
    bench.run(0.5)
    objects = bench.clients[bench.ann].objects
    assert {n: one.map_id for n, one in objects.items()} == {1: MAP, 2: "bob-2/0", 5: MAP}
    np.testing.assert_allclose(objects[2].T_map_object, at(2, 0), atol=1e-9)


def test_a_new_segment_of_odometry_moves_nothing() -> None:
    bench, _, bob = two_maps()
    bench.edge.room.maps.begin_segment(bob, 40)
    bench.correct(bob, "bob-2/1", np.eye(4), keyframe=40)
    bench.correct(bob, MAP, JOIN, keyframe=10)  # of the segment before: the agent ignores it
    bench.run(0.2)
    assert bench.clients[bench.ann].objects[2].map_id == "bob-2/0"


def test_a_chain_of_joins_is_followed() -> None:
    bench, ann, bob = two_maps()
    carl = bench.agent("carl", 3)
    bench.correct(carl, "carl-3/0", np.eye(4))
    bench.join(MAP, "bob-2/0", JOIN)
    bench.join("carl-3/0", MAP, JOIN)
    bench.correct(bob, "carl-3/0", JOIN @ JOIN)
    bench.correct(ann, "carl-3/0", JOIN)
    bench.run(0.5)
    objects = bench.clients[bench.ann].objects
    np.testing.assert_allclose(objects[2].T_map_object, JOIN @ JOIN @ at(2, 0), atol=1e-9)
    np.testing.assert_allclose(objects[1].T_map_object, JOIN @ at(1, 0), atol=1e-9)


def test_an_object_whose_map_is_gone_is_removed_with_that_reason() -> None:
    bench, ann, bob = two_maps()
    for run in (ann, bob):
        bench.edge.room.maps.forget(run)
    bench.solved(MAP)
    bench.run(0.5)
    assert set(bench.clients[bench.ann].objects) == {1, 2}
    bench.solved(MAP)
    bench.run(0.5)
    assert set(bench.clients[bench.ann].objects) == {1}
    assert bench.of(bench.ann, ev.ObjectChanged)[-1].changed.removed == "its map bob-2/0 is gone"
    assert bench.reasons("object removed") == ["cube 2: its map bob-2/0 is gone"]


def test_a_put_that_another_came_instead_of_has_its_answer() -> None:
    bench = prepared(RoomBench(permissions=frozenset()))
    bench.put(bench.ann, 1, 5, at(1, 1), MAP)
    bench.put(bench.ann, 2, 5, at(2, 1), MAP)
    bench.run(1)
    told = answers(bench, bench.ann)
    assert told[1] == told[2] != ""


def test_a_late_put_holds_where_the_later_one_was_refused(bench) -> None:
    bench.said(bench.ann, room.PutObject(10, 5, ObjectKind.CUBE, "nowhere/0", at(1, 1)))
    bench.said(bench.ann, room.PutObject(9, 5, ObjectKind.CUBE, MAP, at(2, 1)))
    bench.run(0.1)
    assert positions(bench, bench.bob) == {5: (2.0, 1.0, 0.0)}


def test_a_client_that_says_hello_again_and_again_is_not_sent_all_objects_each_time(bench) -> None:
    for n in range(MAX_OWNED):
        bench.put(bench.bob, n, n, at(n, 0), MAP)
        bench.run(0.05)
    bench.run(1)
    bench.heard(bench.ann)
    for _ in range(100):
        bench.said(bench.ann, room.ClientHello("ann", 11, wants_objects=True))
    assert len(bench.heard(bench.ann)) <= 100 + MAX_OWNED + 1
    bench.said(bench.ann, room.ClientHello("ann", 11, wants_objects=True))
    bench.run(1)
    assert len(positions(bench, bench.ann)) == MAX_OWNED


def test_an_edge_of_ever_new_sessions_fills_no_client() -> None:
    mirror, count = ObjectReplica(), 0
    for session in range(20):
        mirror.begin_session(session)
        for _ in range(300):
            count += 1
            one = room.RoomObject(session, count, count, ObjectKind.CUBE, "eve", MAP, np.eye(4))
            mirror.add(one)
    assert len(mirror.objects) <= 4 * room.MAX_LISTED


def test_many_names_together_change_little_more_than_a_few(bench) -> None:
    """Each change is stored, and sent to all."""
    peers = [bench.client(f"eve{k}", 100 + k) for k in range(20)]
    bench.run(0.2)
    revision = bench.edge.room._objects.objects.revision
    for n in range(100):  # 5 s
        for k, peer in enumerate(peers):
            for i in range(2):
                bench.said(peer, room.PutObject(10 * n + i, 100 * k + i, ObjectKind.CUBE, MAP, at(n, 0)))
        bench.run(0.05)
    assert 500 < bench.edge.room._objects.objects.revision - revision < 5 * 120 + 5 * 80
