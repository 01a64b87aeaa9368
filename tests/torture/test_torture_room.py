"""Mutated messages of clients against the state machines of the edge and of a client: ten thousand each."""

from __future__ import annotations

import random

import numpy as np
import pytest
from corpus import KINDS, _made_up
from helpers.room_bench import RoomBench
from mutations import mutate

from share.protocol import room_events as ev
from share.protocol.common_events import EdgeMessageReceived, Tick
from share.protocol.room_objects import MAX_OBJECTS
from share.wire import room_messages as room
from share.wire.codec import WIRE_VERSION
from share.wire.messages import peer_id
from share.wire.room_messages import Permission

pytestmark = pytest.mark.long
SEED, COUNT = 20261128, 10_000
UP = [name for name, code in KINDS.items() if 32 <= code < 48]
DOWN = [name for name, code in KINDS.items() if code >= 36]
MAP = "ann-1234/0"
EVE = peer_id(66)


def prepared(permissions: frozenset[Permission]) -> RoomBench:
    bench = RoomBench(rights={"eve": permissions})
    bench.correct(bench.agent("ann", 1), MAP, np.eye(4))
    bench.ann = bench.client("ann", 11, wants_objects=True)  # type: ignore[attr-defined]
    bench.bot = bench.client("bot", 12, drives_robot=True)  # type: ignore[attr-defined]
    bench.names[EVE] = "eve"
    bench.run(0.2)
    return bench


def attack(bench: RoomBench, draw: random.Random, kinds: list[str], count: int) -> None:
    made = _made_up(WIRE_VERSION)
    for k in range(count):
        if k % 50 == 0:  # it joins again and again
            bench.said(EVE, room.ClientHello("eve", 66, wants_objects=True))
        bench.deliver(EVE, mutate(draw, made[draw.choice(kinds)]))
        if k % 10 == 0:
            bench.now_ns += 20_000_000
            bench.under_way.clear()
            bench.to_edge(Tick())


@pytest.mark.parametrize("permissions", [frozenset(), frozenset(Permission)], ids=["may nothing", "may all"])
def test_mutated_messages_of_a_client_end_nothing(permissions: frozenset[Permission]) -> None:
    bench = prepared(permissions)
    attack(bench, random.Random(SEED), UP, COUNT)
    report = bench.edge.report({})
    assert report["internal_errors"] == 0
    objects = [one.object for one in bench.edge.room.kept_objects()]
    assert len(objects) <= MAX_OBJECTS
    assert all(np.abs(one.T_map_object[:3, 3]).max() <= room.MAX_PLACE_M for one in objects)
    assert all(one.map_id == MAP for one in objects)
    if not permissions:
        assert not objects
        assert not [
            one for one in bench.of(bench.bot, ev.RobotCommanded) if isinstance(one.command, room.Goto)
        ]
    assert len(list(bench.edge.room.clients)) <= 64
    assert sum(len(str(one)) for one in bench.events) < 500_000  # what it writes of it is bounded

    bench.run(5)  # the attacker is silent; others go on
    bench.put(bench.ann, 1, 4242, np.eye(4), MAP)
    bench.run(1)
    assert 4242 in bench.clients[bench.ann].objects or len(objects) == MAX_OBJECTS


def test_mutated_messages_of_an_edge_end_no_client() -> None:
    bench = prepared(frozenset(Permission))
    draw, made = random.Random(SEED), _made_up(WIRE_VERSION)
    machine = bench.clients[bench.ann]
    machine.handle(ev.MessageWanted(room.RemoveObject(9, 3)), bench.now_ns)
    for k in range(COUNT):
        kind = draw.choice([*DOWN, "receipt", "object", "objects"])
        machine.handle(EdgeMessageReceived(mutate(draw, made[kind])), bench.now_ns)
        if k % 10 == 0:
            bench.now_ns += 20_000_000
            machine.handle(Tick(), bench.now_ns)
    assert len(machine.objects) <= 2 * 128
    bench.run(5)
    bench.put(bench.ann, 10, 4242, np.eye(4), MAP)
    bench.run(2)
    assert 4242 in machine.objects
