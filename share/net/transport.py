"""Links between agents and the edge: ZeroMQ for a network, memory for one process. Same behaviour.

Every link belongs to one thread; only `wake` may be called from any. Nothing ever blocks except
`receive`, for at most its timeout. Queues are bounded. There is one drop policy, `drop_newest`: a
message that finds its queue full, or nobody at the other end, is not sent, and `send` says so with
False. What must arrive is sent again by the one who cares (`share.protocol.agent_ledger`).
"""

from __future__ import annotations

import errno
import re
from collections.abc import Sequence
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Protocol

from share.errors import TransportError, UsageError
from share.net.keys import AgentKeys, EdgeKeys
from share.wire.codec import MAX_FRAME_BYTES, Bytes

QUEUE_MESSAGES = 128  # a queue in either direction; poses at 30 Hz fill it in 4 s
LINGER_MS = 200  # how long `close` may wait for a last message to leave


class AgentLink(Protocol):
    """An agent's way to its edge. Connects and reconnects by itself."""

    def send(self, frames: Sequence[Bytes]) -> bool:
        """Whether the message was taken; False if there is no edge now or the queue is full."""
        ...

    def receive(self, timeout_ms: int) -> list[bytes] | None:
        """The next message; None after `timeout_ms`, or at once if woken."""
        ...

    def trouble(self) -> str | None:
        """Why the edge did not let us in, and what to do, or why we left it; None if neither."""
        ...

    def poll_connected(self) -> bool:
        """Whether it has reached an edge, once for each time."""
        ...

    def wake(self) -> None:
        """Makes the current or next `receive` return early. Safe from any thread, also after close."""
        ...

    def close(self) -> None:
        """Gives what was sent LINGER_MS to leave, then drops the link. May be repeated."""
        ...


@dataclass(frozen=True)
class IncomingMessage:
    """A message at the edge. peer: its sender's 8-byte id; key: that sender's CURVE public key in Z85, ""
    without keys."""

    peer: bytes
    frames: list[bytes]
    key: str = ""


class EdgeLink(Protocol):
    """The edge's way to its agents, each known by its 8-byte peer id (`share.wire.messages.peer_id`)."""

    @property
    def endpoint(self) -> str:
        """The address really bound, with the port that was chosen."""
        ...

    def send(self, peer: bytes, frames: Sequence[Bytes]) -> bool:
        """Whether the message was taken; False if the peer is not connected or its queue is full."""
        ...

    def receive(self, timeout_ms: int) -> IncomingMessage | None:
        """The next message and who sent it; None after `timeout_ms`, or at once if woken."""
        ...

    def agent_names(self, key: str) -> frozenset[str] | None:
        """Of the agents that the owner of this key may speak for; None where no keys are used."""
        ...

    def refusals(self) -> list[str]:
        """Who was not let in since the last call, and what to do: a line each, the same for the same."""
        ...

    def trouble(self) -> str | None:
        """Why nobody can be let in now; None where nothing is wrong."""
        ...

    def wake(self) -> None:
        """As `AgentLink.wake`."""
        ...

    def close(self) -> None:
        """As `AgentLink.close`; frees the address."""
        ...


@dataclass(frozen=True)
class Address:
    """`tcp://HOST:PORT`. Port 0 (bind only) asks for a free one."""

    host: str
    port: int

    @property
    def local(self) -> bool:
        """Whether nothing outside this machine can reach it."""
        try:
            return ip_address(self.host).is_loopback
        except ValueError:  # a host name
            return False

    def __str__(self) -> str:
        return f"tcp://[{self.host}]:{self.port}" if ":" in self.host else f"tcp://{self.host}:{self.port}"


_TCP = re.compile(r"tcp://(?:\[([0-9A-Fa-f:.]+)\]|([A-Za-z0-9_.-]+)):(\d{1,5})")


def parse_address(text: str, bind: bool = False) -> Address:
    """Raises UsageError if `text` is not tcp://HOST:PORT (an IPv6 host in brackets)."""
    match = _TCP.fullmatch(text)
    if not match or not (0 if bind else 1) <= int(match[3]) <= 65535:
        raise UsageError(
            f"'{text}' is not an address; expected tcp://HOST:PORT, such as tcp://127.0.0.1:5555"
        )
    host = match[1] or match[2]
    return Address("127.0.0.1" if host == "localhost" else host, int(match[3]))


def bind_error(target: object, number: int | None, text: str, other: str = "edge") -> TransportError:
    """Why nothing can listen at `target`: errno `number`, which the system calls `text`. other: who may
    have the port."""
    fixes = {
        errno.EADDRINUSE: f"the port is in use; stop the other {other} or choose another port",
        errno.EACCES: "this port needs root; choose one above 1023",
        errno.EADDRNOTAVAIL: "this machine has no such address",
        errno.ENODEV: "this machine has no such address",
    }
    return TransportError(f"{target}: {fixes.get(number or 0, f'cannot be bound: {text}')}")


def check_keys(target: Address, keys: AgentKeys | EdgeKeys | None) -> Address:
    """`target`, if it may be used with these keys: without any, only this machine. Else UsageError."""
    if keys is None and not target.local:
        raise UsageError(
            f"{target}: other machines are not spoken to without keys; make them with `share keys generate` "
            "(docs/do/keys.md), or use tcp://127.0.0.1"
        )
    return target


def connect(address: str, run_id: int, keys: AgentKeys | None = None) -> AgentLink:
    """A link to the edge at `address`, whether or not it is there yet. Raises UsageError."""
    from share.net.zeromq import ZmqAgentLink

    return ZmqAgentLink(address, run_id, keys)


def bind(address: str, keys: EdgeKeys | None = None, max_frame_bytes: int = MAX_FRAME_BYTES) -> EdgeLink:
    """A link that agents connect to; who sends it a frame above `max_frame_bytes` is cut off.

    Raises UsageError, or TransportError if the port is in use."""
    from share.net.zeromq import ZmqEdgeLink

    return ZmqEdgeLink(address, keys, max_frame_bytes)
