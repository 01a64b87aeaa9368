"""The edge's service of clients: peers without a camera, which place objects and command robots
(docs/lookup/wire.md#clients)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Any, get_args

from share.mapping.corrections import MapEvent
from share.mapping.map_changes import SaveObject
from share.protocol import edge_events as ed
from share.protocol.admission import RunRegistry
from share.protocol.client_registry import Client, ClientRegistry
from share.protocol.command_service import CommandService
from share.protocol.edge_records import EdgeOutput
from share.protocol.known_maps import KnownMaps
from share.protocol.object_service import ObjectService
from share.protocol.peer import fault_lines
from share.wire import messages as wire
from share.wire import room_messages as room

CLIENT_MESSAGES = frozenset((*get_args(room.ClientUplink), wire.Ping, wire.Bye))  # what a client may send


class ClientService:
    """Serves the clients of one room. session: of the edge. runs: its agents."""

    def __init__(
        self,
        out: EdgeOutput,
        runs: RunRegistry,
        session: int,
        silent_s: float,
        stored: Sequence[SaveObject] = (),
    ) -> None:
        self._out, self._runs, self._session = out, runs, session
        self.clients, self.maps = ClientRegistry(out, silent_s), KnownMaps()
        self._objects = ObjectService(out, self.clients, self.maps, session, stored)
        self._commands = CommandService(out, self.clients, self.maps)

    # ------------------------------------------------------------ clients

    def on_hello(self, event: ed.PeerMessageReceived, hello: room.ClientHello) -> None:
        """Welcome a client, or refuse it; no answer while the bridge that it replaces may be dead."""
        if event.peer_id in self._runs:
            joined: Client | str | None = "this run id is in use by an agent; start again"
        else:
            joined = self.clients.join(event, hello)
        if isinstance(joined, str):
            self._out.send(event.peer_id, wire.Refused(joined))
            self._out.record("refused", None, f"client '{hello.name}': {joined}")
        elif joined is not None:
            joined.last_received_ns = self._out.now_ns
            self.clients.send(joined, wire.Welcome(self._session, 0))
            self._objects.begin_client(joined)

    def may_send(self, event: ed.PeerMessageReceived, client: Client) -> bool:
        """Return whether the credential of a message may speak for this client."""
        if not event.is_authorised_for(client.name):
            return False
        client.last_received_ns = self._out.now_ns
        return True

    def on_message(self, event: ed.PeerMessageReceived, client: Client, message: wire.Message) -> None:
        """Handle a message of a client that has joined."""
        match message:
            case wire.Bye():
                self.clients.leave(client, "sent bye")
            case room.PutObject() | room.RemoveObject():
                self._objects.on_request(event, client, message, self._default_map(client))
            case room.ObjectsSeen():
                self._objects.on_seen(client, message)
            case room.Goto() | room.Cancel():
                self._commands.on_command(event, client, message)
            case room.CommandState():
                self._commands.on_state(client, message)
            case room.RobotPlace():
                self._commands.on_place(client, message)

    def send_away(self, name: str, reason: str) -> None:
        """Let the clients of an agent that goes on in another room say hello there."""
        for client in self.clients:
            if client.name == name:
                self.clients.leave(client, reason)

    def tick(self) -> None:
        """Do what time makes due."""
        self.clients.remove_silent()
        self._follow_joins()
        self._objects.tick()

    def _default_map(self, client: Client) -> str | None:
        """Return the map in which a client means a place: that of its agent, or the only one of the room."""
        shown = [(run.name, run.map_id) for run in self._runs.present() if run.map_id is not None]
        own = {map_id for name, map_id in shown if name == client.name}
        maps = own or {map_id for _, map_id in shown} or self.maps.ids()
        return next(iter(maps)) if len(maps) == 1 else None

    # ------------------------------------------------------------ maps

    def restore(self, map_events: Iterable[MapEvent]) -> None:
        """Take in the maps of runs of an earlier session."""
        for map_event in map_events:
            self.on_map_event(map_event)

    def on_map_event(self, map_event: MapEvent) -> None:
        """Follow a decision of the mapper."""
        if map_event.joined is not None:
            self.maps.record_join(map_event.joined)
        if map_event.correction is not None and map_event.agent is not None:
            move = self.maps.add_correction(map_event.agent, map_event.correction)
            if move is not None:
                self._objects.follow(move)

    def add_solved(self, map_ids: Collection[str]) -> None:
        """Take in which maps there are, by a solution of all."""
        self._follow_joins()
        self._objects.add_solved(map_ids)

    def _follow_joins(self) -> None:
        for move in self.maps.due_joins([run.key for run in self._runs.present()]):
            self._objects.follow(move)

    def mark_saved(self, ticket: int) -> None:
        self._objects.mark_saved(ticket)

    # ------------------------------------------------------------ reports

    def kept_objects(self) -> list[SaveObject]:
        """Return the objects, for a session that follows."""
        return self._objects.objects.kept()

    def report(self) -> dict[str, Any]:
        """Return the fields of edge.json about clients, objects and robots."""
        objects = [one.object for one in self._objects.objects.kept()]
        return {
            "clients": [
                {
                    "name": client.name,
                    "drives_robot": client.hello.drives_robot,
                    "refused_messages": client.refusals.count,
                    "last_refusal": client.refusals.reason or None,
                }
                for client in self.clients
            ],
            "objects": {
                str(one.object_id): {
                    "kind": str(one.kind),
                    "owner": one.owner,
                    "map_id": one.map_id,
                    "position": [round(v, 4) for v in one.T_map_object[:3, 3].tolist()],
                }
                for one in objects
            },
            "robots": self._commands.report(),
        }

    def warnings(self) -> list[str]:
        """Return a line for each client with repeatedly refused messages."""
        return fault_lines(
            ((f"client '{client.name}'", "messages refused", client.refusals) for client in self.clients),
            self._out.now_ns,
        )
