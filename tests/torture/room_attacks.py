"""Attacks of clients: peers without a camera, which place objects, send robots and watch both.

Nothing of `share` is imported.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from raw_wire import Message, pack, unpack

Say = Callable[[int, int], list[Message]]  # of the number of a client and of a round
CLIENTS, NAMES = 60, 20  # an edge has 64 places; a key speaks for twenty names


def _hello(c: Any, name: str, identity: bytes, **wants: bool) -> Message:
    header, *arrays = c.corpus.hello(name, identity, "client")
    fields: Any = unpack(header)
    fields[2][2:5] = [wants.get(key, False) for key in ("drives_robot", "wants_objects", "wants_robots")]
    return [pack(fields), *arrays]


def _clients(c: Any, **wants: bool) -> list[tuple[Any, Message]]:
    """As many as find a place, each with its hello. drives_robot: the first of each name."""
    out = []
    for k in range(CLIENTS):
        identity = c.draw.randbytes(8)
        mine = {**wants, "drives_robot": wants.get("drives_robot", False) and k < NAMES}
        hello = _hello(c, f"eve{k % NAMES}", identity, **mine)
        peer = c.peer(identity=identity, hello=False)
        if c.send(peer, [hello]):
            out.append((peer, hello))
        time.sleep(0.05)  # newcomers wait in line
    return out


def _put(c: Any, request: int, object_id: int) -> Message:
    header, *arrays = c.corpus.by_kind["put"][0]
    fields: Any = unpack(header)
    fields[2][0], fields[2][1], fields[2][3] = request, object_id, None
    return [pack(fields), *arrays]


def _repeat(
    c: Any, clients: list[tuple[Any, Message]], messages: Callable[[int, int], list[Message]]
) -> None:
    """All clients send, round by round, as the link takes it; with a ping, so that none is forgotten."""
    number = 0
    while c.going and clients:
        number += 1
        for k, (peer, _) in enumerate(clients):
            c.send(peer, [*c.corpus.by_kind["ping"][:1], *messages(k, number)])
        time.sleep(0.02)


def client_hellos(c: Any) -> None:
    """Clients of a room full of objects that say hello again and again: each time they want all objects."""
    clients = _clients(c, wants_objects=True)
    for number in range(4 * NAMES):
        for k, (peer, _) in enumerate(clients[:NAMES]):
            c.send(peer, [_put(c, number, 100 * k + number % 4)])
        time.sleep(0.02)
    _repeat(c, clients, lambda k, number: [clients[k][1]] * 20)


def client_objects(c: Any) -> None:
    """Each client moves its objects as fast as it can, and all want to see all changes."""
    clients = _clients(c, wants_objects=True)
    _repeat(c, clients, lambda k, number: [_put(c, 10 * number + i, 100 * k + i) for i in range(2)])


def client_places(c: Any) -> None:
    """Twenty robots that say where they are as fast as they can, and sixty clients that want to see it. No
    right is needed for it."""
    clients = _clients(c, drives_robot=True, wants_robots=True)
    place = c.corpus.by_kind["place"][:1]
    _repeat(c, clients, lambda k, number: place * 4 if k < NAMES else [])


def two_commanders(c: Any) -> None:
    """Commanders that send one robot to and fro, cancel each other, and answer for it in its name."""
    clients = _clients(c, drives_robot=True, wants_robots=True)

    def fight(k: int, number: int) -> list[Message]:
        out = []
        for kind, scalars in (
            ("goto", [number, "eve0", "", None, float(k), 1e3, None, number % 2 == 0]),
            ("cancel", [number + k % 3, "eve0", f"eve{k % 7}"]),
            ("state", [number, None, f"eve{k % 7}", "reached", True, True]),
        ):
            fields: Any = unpack(c.corpus.by_kind[kind][0][0])
            fields[2] = scalars
            out.append([pack(fields)])
        return out

    _repeat(c, clients, fight)


ROOM_ATTACKS: dict[str, Callable[[Any], None]] = {
    f.__name__.replace("_", "-"): f for f in (client_hellos, client_objects, client_places, two_commanders)
}
