"""Runs that come from another room, beside those that the room knows already."""

from __future__ import annotations

import numpy as np
from helpers.hellos import hello_of

from share.config import Config
from share.mapping.corrections import map_assignment
from share.protocol.edge import EdgeProtocol
from share.protocol.edge_events import PeerMessageReceived
from share.protocol.peer import Peer, RestoredRun
from share.wire.codec import encode
from share.wire.messages import peer_id

S = 10**9
PLACE = map_assignment("ann-0002", "bob-0001/0", np.eye(4), 5, None)


def said_hello(run_id: int) -> PeerMessageReceived:
    return PeerMessageReceived(peer_id(run_id), [bytes(f) for f in encode(hello_of("ann", run_id))])


def comer(run_id: int, key: str = "ann-0002") -> Peer:
    """A run of ann that takes part in another room."""
    return RestoredRun(key, hello_of("ann", run_id), None).peer(7)


def test_it_takes_the_place_of_a_silent_run_of_its_name() -> None:
    """Two runs of one name took part."""
    edge = EdgeProtocol(Config(), 7)
    edge.handle(said_hello(1), 0)
    peer = comer(2)
    assert "in use" in (edge.entry_objection(peer, 2 * S) or "")
    assert edge.entry_objection(peer, 4 * S) is None
    edge.take_over(peer, "lab", PLACE, 4 * S)
    agents = edge.report({})["agents"]
    assert sorted((label, agent["gone"]) for label, agent in agents.items()) == [
        ("ann", False),
        (next(label for label in agents if label.startswith("ann/")), True),
    ]
    assert agents["ann"]["run"] == peer.key


def test_one_that_is_known_by_another_key_stays_where_it_is() -> None:
    edge = EdgeProtocol(Config(), 7, restored=[RestoredRun("ann-0001", hello_of("ann", 2), None)])
    assert edge.entry_objection(comer(2), 0) == "it has another name there"
    assert edge.entry_objection(comer(2, "ann-0001"), 0) is None
    assert "another run is called ann-0001" in (edge.entry_objection(comer(3, "ann-0001"), 0) or "")
