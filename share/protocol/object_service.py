"""The edge's service of objects: requests in, receipts and changes out."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence

from share.mapping.map_changes import RemoveStoredObject, SaveObject
from share.protocol.client_registry import Client, ClientRegistry, permission_objection
from share.protocol.edge_events import PeerMessageReceived
from share.protocol.edge_records import EdgeOutput
from share.protocol.known_maps import KnownMaps, MapMoved
from share.protocol.room_objects import RoomObjects
from share.timing import seconds_to_ns
from share.wire.room_messages import (
    MAX_ANSWER_LENGTH,
    ObjectsSeen,
    Permission,
    PutObject,
    Receipt,
    RemoveObject,
    RoomObject,
)

_LIST_S, _MAX_LIST_S = 0.25, 2.0  # pause between lists to a client that has not seen all, the first and later
_MAX_UNSAVED = 64  # requests that wait for the disk


class ObjectService:
    """Serves the objects of one room to its clients."""

    def __init__(
        self,
        out: EdgeOutput,
        clients: ClientRegistry,
        maps: KnownMaps,
        session: int,
        stored: Sequence[SaveObject],
    ) -> None:
        self.objects = RoomObjects(session, stored)
        self._out, self._clients, self._maps, self._session = out, clients, maps, session
        self._unsaved: deque[tuple[int, bytes, int]] = deque()  # ticket, client, request

    def on_request(
        self,
        event: PeerMessageReceived,
        client: Client,
        message: PutObject | RemoveObject,
        default_map: str | None,
    ) -> None:
        """Handle a request. default_map: where an object is put that names no map; None: unknown."""
        known = client.requests.get(message.request)
        if known is not None or message.request < client.forgotten_below:
            if known is not None and known[1] is not None:
                self._clients.send(client, Receipt(message.request, known[1]))
            return
        now_ns = self._out.now_ns
        if not self._clients.take_request(client.name, now_ns):
            client.count("over_rate", "too many requests about objects", now_ns)
            return
        if len(self._unsaved) >= _MAX_UNSAVED:
            client.count("over_rate", "requests about objects wait for the disk", now_ns)
            return
        objection = permission_objection(client.name, Permission.OBJECTS, event)
        if objection is not None:
            self._clients.refuse(client, "unauthorised", objection)
            self._answer(client, message, objection)
            return
        later = (row for n, row in client.requests.items() if n > message.request)
        if any(object_id == message.object_id and not reason for object_id, reason in later):
            self._answer(client, message, "")  # a later one of the same object has come before it, and holds
            return
        try:
            ticket = self._apply(client, message, default_map)
        except ValueError as error:
            self._answer(client, message, self._clients.refuse(client, "refused", str(error)))
            return
        if ticket is None:
            self._answer(client, message, "")
            return
        client.remember_request(message.request, message.object_id, None)
        self._unsaved.append((ticket, client.id, message.request))

    def _answer(self, client: Client, message: PutObject | RemoveObject, reason: str) -> None:
        reason = reason[:MAX_ANSWER_LENGTH]
        client.remember_request(message.request, message.object_id, reason)
        self._clients.send(client, Receipt(message.request, reason))

    def _apply(
        self, client: Client, message: PutObject | RemoveObject, default_map: str | None
    ) -> int | None:
        """Return the ticket of the change. Raises ValueError for what is refused."""
        if isinstance(message, RemoveObject):
            gone = self.objects.remove(message.object_id, f"removed by '{client.name}'", self._out.now_ns)
            return self._announce(gone)
        map_id = default_map if message.map_id is None else message.map_id
        if map_id is None:
            raise ValueError("the room has no map yet, or several; name one (map_id)")
        if (place := self._maps.place(map_id, message.T_map_object)) is None:
            raise ValueError(f"there is no map {map_id}")
        return self._announce(self.objects.put(client.name, message.object_id, message.kind, *place))

    def _announce(self, change: SaveObject | RoomObject) -> int | None:
        """Store a change, record it unless it is a mere move, and send it to all that want it. Return its
        ticket."""
        sent = change.object if isinstance(change, SaveObject) else change
        if sent.removed:
            self._out.record("object removed", None, f"{sent.kind} {sent.object_id}: {sent.removed}")
        wanting = self._wanting()
        self._clients.send_all(wanting, sent)
        for client in wanting:
            client.list_pause_s = _LIST_S
            client.list_due_ns = self._out.now_ns + seconds_to_ns(_LIST_S)
        kept = change if isinstance(change, SaveObject) else RemoveStoredObject(sent.object_id)
        return self._out.save(kept)

    def _wanting(self) -> list[Client]:
        return [client for client in self._clients if client.hello.wants_objects]

    # ------------------------------------------------------------ what clients have seen

    def begin_client(self, client: Client) -> None:
        """Send all objects to a client that was welcomed; now, or with the next list that is due, as it may
        say hello as often as it likes."""
        if client.hello.wants_objects:
            client.seen_revision, client.list_pause_s = -1, _LIST_S
            client.list_due_ns = min(client.list_due_ns, self._out.now_ns + seconds_to_ns(_LIST_S))
            if self._out.now_ns >= client.list_due_ns:
                self._send_newer(client)

    def on_seen(self, client: Client, seen: ObjectsSeen) -> None:
        if seen.session == self._session and seen.revision <= self.objects.revision:
            client.seen_revision = max(client.seen_revision, seen.revision)

    def tick(self) -> None:
        """Send again what was not seen, and forget what was removed long ago."""
        self.objects.expire(self._out.now_ns)
        for client in self._wanting():
            if client.seen_revision < self.objects.revision and self._out.now_ns >= client.list_due_ns:
                self._send_newer(client)

    def _send_newer(self, client: Client) -> None:
        for one in self.objects.newer_than(client.seen_revision):
            self._clients.send(client, one)
        self._clients.send(client, self.objects.listed())
        client.list_due_ns = self._out.now_ns + seconds_to_ns(client.list_pause_s)
        client.list_pause_s = min(2 * client.list_pause_s, _MAX_LIST_S)

    # ------------------------------------------------------------ maps

    def follow(self, move: MapMoved) -> None:
        """Move the objects of a map that moved into another."""
        changes = self.objects.follow(move, self._out.now_ns)
        for change in changes:
            self._announce(change)
        if changes:
            moved = f"{len(changes)} objects of map {move.old} are in map {move.new} now"
            self._out.record("objects moved", None, moved, map_id=move.new)

    def add_solved(self, map_ids: Collection[str]) -> None:
        """Remove the objects of maps that a solution no longer has."""
        self._maps.add_solved(map_ids)
        for gone in self.objects.remove_missing(lambda one: one in self._maps, self._out.now_ns):
            self._announce(gone)

    def mark_saved(self, ticket: int) -> None:
        """Acknowledge the requests that are stored up to this ticket."""
        while self._unsaved and self._unsaved[0][0] <= ticket:
            _, client_id, request = self._unsaved.popleft()
            client = self._clients.get(client_id)
            if client is not None and request in client.requests:
                client.requests[request] = client.requests[request][0], ""
                self._clients.send(client, Receipt(request))
