"""The clients of an edge: admission, rights, and limits of their messages."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

from share.protocol.admission import NAME_HOLD_S, name_objection
from share.protocol.edge_events import PeerMessageReceived, SendToPeer
from share.protocol.edge_records import EdgeOutput
from share.protocol.peer import Sender
from share.timing import SECOND_NS, TokenBuckets, seconds_to_ns
from share.wire.codec import encode, message_bytes
from share.wire.messages import Pong, Refused, Welcome
from share.wire.room_messages import ClientDownlink, ClientHello, ClientUplink, CommandState, Permission

MAX_CLIENTS, MAX_OF_NAME = 64, 8
_NEW_RUN_LIMIT = (8.0, 2.0)  # at once, and a second, of a name
_REQUEST_LIMIT, _COMMAND_LIMIT, _STATE_LIMIT = (80.0, 40.0), (20.0, 10.0), (40.0, 20.0)  # of a name
_FULL_RATE_NAMES = 3  # of more names that ask at a time about objects, each has a smaller part of their rate
_MAX_REQUESTS, _MAX_COMMANDS = 64, 16  # of a client that are remembered
_ANSWERED_S = 0.6  # a bridge that was silent for longer may be dead

Downlink = Welcome | Refused | Pong | ClientDownlink | ClientUplink


@dataclass(frozen=True)
class ForwardedCommand:
    """A command of a client. robot: to which it was passed; None: to none yet. final: its last state, if
    nothing follows. gone_ns: since when its robot has no bridge; None: it has one."""

    robot: str | None = None
    final: CommandState | None = None
    gone_ns: int | None = None


@dataclass(eq=False)
class Client(Sender):
    """A client that is present. id: of the transport.

    requests: by number, the object and the answer, None while it waits for the disk. forgotten_below: older
    requests are not remembered. commands: by number. seen_revision: of objects.
    """

    id: bytes
    hello: ClientHello
    last_received_ns: int
    requests: dict[int, tuple[int, str | None]] = field(default_factory=dict)
    forgotten_below: int = 0
    commands: dict[int, ForwardedCommand] = field(default_factory=dict)
    newest_command: int = -1
    seen_revision: int = -1
    list_due_ns: int = 0
    list_pause_s: float = 0.0

    @property
    def name(self) -> str:
        return self.hello.name

    def remember_request(self, request: int, object_id: int, answer: str | None) -> None:
        self.requests[request] = object_id, answer
        while len(self.requests) > _MAX_REQUESTS:
            oldest = min(self.requests)
            del self.requests[oldest]
            self.forgotten_below = max(self.forgotten_below, oldest + 1)

    def remember_command(
        self, command: int, robot: str | None = None, final: CommandState | None = None
    ) -> None:
        """robot, final: as of `ForwardedCommand`; the first of each counts."""
        known = self.commands.get(command, ForwardedCommand())
        self.commands[command] = replace(known, robot=known.robot or robot, final=known.final or final)
        self.newest_command = max(self.newest_command, command)
        while len(self.commands) > _MAX_COMMANDS:
            del self.commands[min(self.commands)]

    def mark_robot(self, command: int, has_bridge: bool, now_ns: int) -> float:
        """Note whether the robot of a command has a bridge. Return for how long it has had none, s."""
        known = self.commands[command]
        gone_ns = None if has_bridge else now_ns if known.gone_ns is None else known.gone_ns
        self.commands[command] = replace(known, gone_ns=gone_ns)
        return 0.0 if gone_ns is None else (now_ns - gone_ns) / SECOND_NS


class ClientRegistry:
    """The clients that are present, and limits on what they send. Messages go to `out`."""

    def __init__(self, out: EdgeOutput, silent_s: float) -> None:
        self._out, self._silent_s = out, silent_s
        self._clients: dict[bytes, Client] = {}
        self._new_runs = TokenBuckets(*_NEW_RUN_LIMIT)
        self.requests, self.commands = TokenBuckets(*_REQUEST_LIMIT), TokenBuckets(*_COMMAND_LIMIT)
        self.states = TokenBuckets(*_STATE_LIMIT)

    def __iter__(self) -> Iterator[Client]:
        return iter(list(self._clients.values()))

    def get(self, peer_id: bytes) -> Client | None:
        return self._clients.get(peer_id)

    def bridge(self, robot: str) -> Client | None:
        """Return the bridge of a robot."""
        return next((one for one in self if one.hello.drives_robot and one.name == robot), None)

    def robots(self) -> list[str]:
        """Return the names of robots that have a bridge."""
        return sorted(one.name for one in self if one.hello.drives_robot)

    def send(self, client: Client, message: Downlink) -> None:
        self.send_all([client], message)

    def send_all(self, clients: Sequence[Client], message: Downlink) -> None:
        frames = encode(message)
        size = message_bytes(frames)
        for client in clients:
            client.counts["bytes_down"] += size
            self._out.add(SendToPeer(client.id, frames))

    def take_request(self, name: str, now_ns: int) -> bool:
        """Return whether a client may make a request about an object now: each is stored, and sent to all, so
        many names together may make no more than a few."""
        bucket = self.requests.bucket(name, now_ns)
        share = self.requests.count_used(now_ns) / _FULL_RATE_NAMES
        return bucket.take(now_ns, cost=min(max(1.0, share), _REQUEST_LIMIT[0]))

    def refuse(self, client: Client, kind: str, reason: str) -> str:
        """Count and record what a client may not do; return the reason."""
        client.count(kind, reason, self._out.now_ns)
        self._out.record("refused", None, f"client '{client.name}': {reason}", client=client.name)
        return reason

    def join(self, event: PeerMessageReceived, hello: ClientHello) -> Client | str | None:
        """Return the client of a hello; the reason if it is refused; None while it is not answered."""
        now_ns = self._out.now_ns
        if not event.is_authorised_for(hello.name):
            return name_objection(hello.name, event)
        if (known := self._clients.get(event.peer_id)) is not None:
            return known if known.hello == hello else "this run id is in use by another client; start again"
        if hello.drives_robot and (bridge := self.bridge(hello.name)) is not None:
            if now_ns - bridge.last_received_ns > seconds_to_ns(_ANSWERED_S):
                return None
            return f"robot '{hello.name}' has a bridge already; stop that one, or wait {NAME_HOLD_S:g} s"
        if len(self._clients) >= MAX_CLIENTS:
            return f"the edge already serves {MAX_CLIENTS} clients, its limit"
        if sum(one.name == hello.name for one in self) >= MAX_OF_NAME:
            return f"'{hello.name}' has {MAX_OF_NAME} clients already"
        if not self._new_runs.bucket(hello.name, now_ns).take(now_ns):
            return f"too many new clients of '{hello.name}': try again in a second"
        client = Client(id=event.peer_id, hello=hello, last_received_ns=now_ns)
        self._clients[event.peer_id] = client
        what = "bridge of a robot" if hello.drives_robot else "client"
        self._out.record("client joined", None, f"{what}, '{hello.name}'", client=hello.name)
        return client

    def leave(self, client: Client, reason: str) -> None:
        if self._clients.pop(client.id, None) is not None:
            self._out.record("client left", None, f"'{client.name}': {reason}", client=client.name)

    def remove_silent(self) -> None:
        """Remove the clients that have been silent too long."""
        limit_ns = self._out.now_ns - seconds_to_ns(self._silent_s)
        for client in self:
            if client.last_received_ns < limit_ns:
                self.leave(client, f"no message for {self._silent_s:g} s")


def permission_objection(name: str, permission: Permission, event: PeerMessageReceived) -> str | None:
    """Return why this sender may not do that, and what to do; None if it may."""
    if permission in event.permissions:
        return None
    what = {Permission.COMMANDS: "command robots", Permission.OBJECTS: "place objects"}[permission]
    if event.allowed_names is None:
        return f"nobody may {what} here; start the edge with --allow {permission}"
    return f"the key of '{name}' may not {what}; on the edge run: share keys authorize … --{permission}"
