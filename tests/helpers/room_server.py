"""An edge without a mapper in a thread, for clients over a real link: agent `ann` is in the map `ann-1/0`."""

from __future__ import annotations

import threading
import time
from collections.abc import Collection, Sequence

import numpy as np
from helpers.hellos import hello_of

from share.config import Config
from share.mapping.corrections import MapEvent
from share.mapping.map_changes import SaveObject
from share.net.keys import EdgeKeys
from share.net.transport import bind
from share.protocol import edge_events as ed
from share.protocol.common_events import Tick
from share.protocol.edge import EdgeProtocol
from share.timing import PeriodicTimer
from share.types import Correction
from share.wire.codec import encode
from share.wire.messages import Ping, peer_id
from share.wire.room_messages import Permission

MAP = "ann-1/0"


class RoomServer:
    """allowed: of all, without keys. address: of an earlier one, whose place it takes."""

    def __init__(
        self,
        allowed: Collection[Permission] = tuple(Permission),
        keys: EdgeKeys | None = None,
        address: str = "tcp://127.0.0.1:0",
        session: int = 7,
        objects: Sequence[SaveObject] = (),
    ) -> None:
        self.link, self._allowed, self._is_ended = bind(address, keys), frozenset(allowed), False
        self.address, self.events = self.link.endpoint, list[dict[str, object]]()
        self.edge = EdgeProtocol(Config(), session, objects=objects)
        self._handle(ed.PeerMessageReceived(peer_id(1), encode(hello_of("ann", 1))))
        (run,) = self.edge.room._runs.present()
        correction = Correction(np.eye(4), np.zeros((6, 6)), MAP, 0, 0)
        self._handle(ed.MapperResult((MapEvent(run.key, "correction", "", correction),)))
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> RoomServer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_ended = True
        self.link.wake()
        self._thread.join()
        self.link.close()

    def _serve(self) -> None:
        ping_timer = PeriodicTimer(1.0)
        while not self._is_ended:
            if (message := self.link.receive(20)) is not None:
                names = self.link.agent_names(message.key)
                may = self._allowed if names is None else self.link.permissions(message.key)
                self._handle(ed.PeerMessageReceived(message.peer, message.frames, names, message.key, may))
            if ping_timer.fire_if_due(time.monotonic_ns()):  # ann is never silent
                self._handle(ed.PeerMessageReceived(peer_id(1), encode(Ping(0, 0))))
            self._handle(Tick())

    def _handle(self, event: ed.EdgeEvent) -> None:
        for effect in self.edge.handle(event, time.monotonic_ns()):
            if isinstance(effect, ed.SendToPeer) and effect.peer_id != peer_id(1):
                self.link.send(effect.peer_id, effect.frames)
            elif isinstance(effect, ed.WriteEvent):
                self.events.append(effect.fields)
