"""Interfaces of the links between agents and the edge: ZeroMQ for a network, memory for one process.

A link belongs to one thread; only `wake` may be called from any. Only `receive` blocks, for at most its
timeout. Queues are bounded, with the drop policy `drop_newest`: if the queue is full or the peer absent,
`send` drops the message and returns False. The sender resends what must arrive
(`share.protocol.agent_ledger`).
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
from share.wire.layouts import MAX_FRAME_BYTES, Bytes
from share.wire.room_messages import Permission

QUEUE_MESSAGES = 128  # per queue and direction; poses at 30 Hz fill it in 4 s
LINGER_MS = 200  # how long `close` waits for the last messages to leave


class AgentLink(Protocol):
    """An agent's link to its edge. It connects and reconnects by itself."""

    def send(self, frames: Sequence[Bytes]) -> bool:
        """Queue a message. Return False if there is no edge now or the queue is full."""
        ...

    def receive(self, timeout_ms: int) -> list[bytes] | None:
        """Return the next message; None after `timeout_ms`, or earlier if woken."""
        ...

    def trouble(self) -> str | None:
        """Return why the edge refused this agent, or why the agent left it, and what to do; else None."""
        ...

    def poll_connected(self) -> bool:
        """Return whether a connection was made since the last call."""
        ...

    def wake(self) -> None:
        """Make the current or next `receive` return early. Safe from any thread, also after `close`."""
        ...

    def close(self) -> None:
        """Give sent messages LINGER_MS to leave, then drop the link. May be repeated."""
        ...


@dataclass(frozen=True)
class IncomingMessage:
    """A message at the edge. peer: its sender's 8-byte id. key: the sender's CURVE public key in Z85, ""
    without keys."""

    peer: bytes
    frames: list[bytes]
    key: str = ""


class EdgeLink(Protocol):
    """The edge's link to its agents, each with an 8-byte peer id (`share.wire.messages.peer_id`)."""

    @property
    def endpoint(self) -> str:
        """The bound address, with the actual port."""
        ...

    def send(self, peer: bytes, frames: Sequence[Bytes]) -> bool:
        """Queue a message. Return False if the peer is not connected or its queue is full."""
        ...

    def receive(self, timeout_ms: int) -> IncomingMessage | None:
        """Return the next message; None after `timeout_ms`, or earlier if woken."""
        ...

    def agent_names(self, key: str) -> frozenset[str] | None:
        """Return the names of the agents that this key may act for; None if no keys are used."""
        ...

    def permissions(self, key: str) -> frozenset[Permission]:
        """Return what the holder of this key may do as a client; nothing without keys."""
        ...

    def refusals(self) -> list[str]:
        """Return a line for each refusal since the last call: peer and remedy; equal for equal causes."""
        ...

    def trouble(self) -> str | None:
        """Return why no agent can connect now; None if all is well."""
        ...

    def expect_growth(self, is_expected: bool) -> None:
        """Set whether this process grows by itself, as while it loads a map: no peer is blamed for it."""
        ...

    def wake(self) -> None:
        """See `AgentLink.wake`."""
        ...

    def close(self) -> None:
        """See `AgentLink.close`; also frees the address."""
        ...


@dataclass(frozen=True)
class Address:
    """`tcp://HOST:PORT`. Port 0 (bind only) asks for a free one."""

    host: str
    port: int

    @property
    def local(self) -> bool:
        """Whether it can be reached from this machine only."""
        try:
            return ip_address(self.host).is_loopback
        except ValueError:  # a host name
            return False

    def __str__(self) -> str:
        return f"tcp://[{self.host}]:{self.port}" if ":" in self.host else f"tcp://{self.host}:{self.port}"


_TCP = re.compile(r"(?:tcp://)?(?:\[([0-9A-Fa-f:.]+)\]|([A-Za-z0-9_.-]+)):(\d{1,5})")


def parse_address(text: str, bind: bool = False) -> Address:
    """Return the address tcp://HOST:PORT or HOST:PORT (an IPv6 host in brackets). Raises UsageError."""
    match = _TCP.fullmatch(text)
    if not match or not (0 if bind else 1) <= int(match[3]) <= 65535:
        raise UsageError(
            f"'{text}' is not an address; expected tcp://HOST:PORT, such as tcp://127.0.0.1:5555"
        )
    host = match[1] or match[2]
    return Address("127.0.0.1" if host == "localhost" else host, int(match[3]))


def bind_error(target: object, number: int | None, text: str, other: str = "edge") -> TransportError:
    """Return the error for binding `target` with errno `number` and its message `text`. other: the program
    that may use the port."""
    fixes = {
        errno.EADDRINUSE: f"the port is in use; stop the other {other} or choose another port",
        errno.EACCES: "this port needs root; choose one above 1023",
        errno.EADDRNOTAVAIL: "this machine has no such address",
        errno.ENODEV: "this machine has no such address",
    }
    return TransportError(f"{target}: {fixes.get(number or 0, f'cannot be bound: {text}')}")


def check_keys(target: Address, keys: object | None) -> Address:
    """Return `target`. Raises UsageError if it is on another machine and there are no keys."""
    if keys is None and not target.local:
        raise UsageError(
            f"{target}: links to other machines need keys; make them with `share keys generate` "
            "(docs/do/keys.md), or use tcp://127.0.0.1"
        )
    return target


def connect(address: str, run_id: int, keys: AgentKeys | None = None) -> AgentLink:
    """Return a link to the edge at `address`, which need not run yet. Raises UsageError."""
    from share.net.zeromq_agent import ZmqAgentLink

    return ZmqAgentLink(address, run_id, keys)


def bind(address: str, keys: EdgeKeys | None = None, max_frame_bytes: int = MAX_FRAME_BYTES) -> EdgeLink:
    """Return a link that agents connect to. A peer that sends a frame above `max_frame_bytes` is
    disconnected.

    Raises UsageError, or TransportError if the port is in use.
    """
    from share.net.zeromq_edge import ZmqEdgeLink

    return ZmqEdgeLink(address, keys, max_frame_bytes)
