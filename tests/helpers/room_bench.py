"""An edge and its clients in made-up time: the state machines of both sides, and a network between them."""

from __future__ import annotations

import random
from dataclasses import dataclass, field

import numpy as np
from helpers.hellos import hello_of

from share.config import Config
from share.geometry import se3
from share.mapping.corrections import MapEvent, MapsJoined
from share.mapping.map_changes import SaveObject, SavePoses
from share.protocol import edge_events as ed
from share.protocol import room_events as ev
from share.protocol.common_events import Connected, EdgeMessageReceived, SendToEdge, Tick
from share.protocol.edge import EdgeProtocol
from share.protocol.room_client import RoomClient
from share.types import F64, Correction
from share.wire import room_messages as room
from share.wire.codec import decode, encode
from share.wire.messages import Message, peer_id
from share.wire.room_messages import ObjectKind, Permission

MS = 1_000_000
ALL = frozenset(Permission)


def at(x: float, y: float, yaw: float = 0.0, z: float = 0.0) -> F64:
    return se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, yaw])), np.array([x, y, z]))


@dataclass
class Air:
    """What happens to a message: lost, doubled, or late by up to `late_ms` (so that later ones overtake)."""

    loss: float = 0.0
    twice: float = 0.0
    late_ms: float = 0.0


@dataclass
class RoomBench:
    """permissions: of all clients, unless `rights` has others by name."""

    permissions: frozenset[Permission] = ALL
    has_store: bool = False
    air: Air = field(default_factory=Air)
    seed: int = 0
    now_ns: int = 0
    session: int = 7
    rights: dict[str, frozenset[Permission]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.draw = random.Random(self.seed)
        self.clients: dict[bytes, RoomClient] = {}
        self.names: dict[bytes, str] = {}
        self.effects: dict[bytes, list[ev.ClientEffect]] = {}
        self.events: list[dict[str, object]] = []
        self.tickets: list[int] = []
        self.is_disk_slow = False
        self.under_way: list[tuple[int, bytes, bool, list[bytes]]] = []
        self.start_edge()

    # ------------------------------------------------------------ the edge

    def start_edge(self, objects: list[SaveObject] | None = None) -> None:
        self.edge = EdgeProtocol(Config(), self.session, self.has_store, objects=objects or ())
        self.run_of: dict[str, bytes] = {}

    def restart_edge(self) -> None:
        """A new session, with the objects that the old one had."""
        kept, self.session = self.edge.room.kept_objects(), self.session + 1
        self.under_way.clear()
        self.start_edge(kept)

    def to_edge(self, event: ed.EdgeEvent) -> None:
        for effect in self.edge.handle(event, self.now_ns):
            match effect:
                case ed.SendToPeer():
                    self._send(effect.peer_id, False, [bytes(part) for part in effect.frames])
                case ed.WriteEvent():
                    self.events.append(effect.fields)
                case ed.SaveChanges():
                    self.tickets.append(effect.ticket)

    def reasons(self, kind: str) -> list[str]:
        return [str(one["reason"]) for one in self.events if one["event"] == kind]

    def agent(self, name: str, run_id: int) -> str:
        """A present agent; return its run's key."""
        self.deliver(peer_id(run_id), encode(hello_of(name, run_id)))
        return self.run_key(name)

    def run_key(self, name: str) -> str:
        return next(run.key for run in self.edge.room._runs.present() if run.name == name)

    def correct(self, run: str, map_id: str, T_map_odom: F64, keyframe: int = 0) -> None:
        correction = Correction(T_map_odom, np.zeros((6, 6)), map_id, 0, keyframe)
        self.to_edge(ed.MapperResult((MapEvent(run, "correction", "", correction),)))

    def join(self, survivor: str, absorbed: str, T: F64) -> None:
        event = MapEvent(None, "maps merged", "", joined=MapsJoined(survivor, absorbed, T))
        self.to_edge(ed.MapperResult((event,)))

    def solved(self, *map_ids: str) -> None:
        """A solution of these maps."""
        from share.mapping.loops import KeyframeKey

        keys = tuple(KeyframeKey("x", i) for i in range(len(map_ids)))
        poses = SavePoses(keys, np.tile(np.eye(4), (len(keys), 1, 1)), map_ids)
        self.to_edge(ed.MapperResult((), (poses,)))

    # ------------------------------------------------------------ clients

    def client(self, name: str, run_id: int, **hello: bool) -> bytes:
        """A client; return its id."""
        peer = peer_id(run_id)
        drives = hello.get("drives_robot", False)
        self.clients[peer] = RoomClient(room.ClientHello(name, run_id, **hello), 3.0, keeps_trying=drives)
        self.names[peer], self.effects[peer] = name, []
        self.to_client(peer, Connected())
        return peer

    def to_client(self, peer: bytes, event: ev.ClientEvent) -> None:
        for effect in self.clients[peer].handle(event, self.now_ns):
            self.effects[peer].append(effect)
            if isinstance(effect, SendToEdge):
                self._send(peer, True, [bytes(part) for part in effect.frames])

    def of(self, peer: bytes, kind: type) -> list:
        """What a client's machine had done of this kind."""
        return [effect for effect in self.effects[peer] if isinstance(effect, kind)]

    def put(
        self, peer: bytes, request: int, object_id: int, T: F64, map_id: str | None = None, **more
    ) -> None:
        kind = more.get("kind", ObjectKind.CUBE)
        self.to_client(peer, ev.MessageWanted(room.PutObject(request, object_id, kind, map_id, T)))

    # ------------------------------------------------------------ the network

    def _send(self, peer: bytes, is_up: bool, frames: list[bytes]) -> None:
        if self.draw.random() < self.air.loss:
            return
        for _ in range(1 + (self.draw.random() < self.air.twice)):
            late_ns = int(self.draw.random() * self.air.late_ms * MS)
            self.under_way.append((self.now_ns + late_ns, peer, is_up, frames))

    def deliver(self, peer: bytes, frames: list) -> None:
        """Give the edge a message of a peer."""
        rights = self.rights.get(self.names.get(peer, ""), self.permissions)
        message = ed.PeerMessageReceived(peer, [bytes(part) for part in frames], permissions=rights)
        self.to_edge(message)

    def said(self, peer: bytes, message: Message) -> None:
        """A message of a peer, past its machine."""
        self.deliver(peer, encode(message))

    def heard(self, peer: bytes) -> list[Message]:
        """Take what is under way to a peer."""
        mine = [one for one in self.under_way if one[1] == peer and not one[2]]
        self.under_way = [one for one in self.under_way if one not in mine]
        return [decode(frames) for _, _, _, frames in mine]

    def run(self, seconds: float, step_ms: int = 20) -> None:
        """Let time pass."""
        end_ns = self.now_ns + round(seconds * 1e9)
        while self.now_ns < end_ns:
            self.now_ns += step_ms * MS
            self.pass_on()
            self.to_edge(Tick())
            if self.tickets and not self.is_disk_slow:
                self.to_edge(ed.ChangesSaved(self.tickets.pop()))
                self.tickets.clear()
            for peer in self.clients:
                self.to_client(peer, Tick())

    def pass_on(self) -> None:
        for _ in range(20):  # answers of answers, in one step
            due = sorted((one for one in self.under_way if one[0] <= self.now_ns), key=lambda one: one[0])
            if not due:
                return
            self.under_way = [one for one in self.under_way if one[0] > self.now_ns]
            for _, peer, is_up, frames in due:
                if is_up:
                    self.deliver(peer, frames)
                elif peer in self.clients:
                    self.to_client(peer, EdgeMessageReceived(frames))
