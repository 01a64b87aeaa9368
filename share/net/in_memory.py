"""Links within one process, for tests and demonstrations; they behave like the ZeroMQ links."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from threading import Condition, Lock
from typing import Generic, TypeVar

from share.errors import TransportError
from share.net.transport import QUEUE_MESSAGES, IncomingMessage
from share.wire.codec import Bytes
from share.wire.messages import peer_id

T = TypeVar("T")


class _Mailbox(Generic[T]):
    """A bounded queue between threads; its reader can be woken."""

    def __init__(self) -> None:
        self._items: deque[T] = deque()
        self._ready = Condition()
        self._woken = False

    def put(self, item: T) -> bool:
        with self._ready:
            if len(self._items) >= QUEUE_MESSAGES:
                return False
            self._items.append(item)
            self._ready.notify()
            return True

    def get(self, timeout_ms: int) -> T | None:
        with self._ready:
            if not self._items:
                self._ready.wait_for(lambda: self._items or self._woken, timeout_ms / 1000)
                self._woken = False
            return self._items.popleft() if self._items else None

    def wake(self) -> None:
        with self._ready:
            self._woken = True
            self._ready.notify()


class MemoryNetwork:
    """Registry of memory links: edges by name, agents by edge name and peer id."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._edges: dict[str, MemoryEdgeLink] = {}
        self._agents: dict[tuple[str, bytes], MemoryAgentLink] = {}

    def bind(self, name: str) -> MemoryEdgeLink:
        """Raises TransportError if an edge has that name already."""
        with self._lock:
            if name in self._edges:
                raise TransportError(f"{name}: the name is in use; stop the other edge or choose another")
            self._edges[name] = MemoryEdgeLink(self, name)
            return self._edges[name]

    def connect(self, name: str, run_id: int) -> MemoryAgentLink:
        link = MemoryAgentLink(self, name, peer_id(run_id))
        with self._lock:
            self._agents[name, link.peer] = link
        return link

    def edge(self, name: str) -> MemoryEdgeLink | None:
        with self._lock:
            return self._edges.get(name)

    def agent(self, name: str, peer: bytes) -> MemoryAgentLink | None:
        with self._lock:
            return self._agents.get((name, peer))

    def forget(self, link: MemoryAgentLink | MemoryEdgeLink) -> None:
        with self._lock:
            self._edges = {key: edge for key, edge in self._edges.items() if edge is not link}
            self._agents = {key: agent for key, agent in self._agents.items() if agent is not link}


class MemoryAgentLink:
    """`AgentLink` within a `MemoryNetwork`."""

    def __init__(self, network: MemoryNetwork, name: str, peer: bytes) -> None:
        self.peer = peer
        self.inbox: _Mailbox[list[bytes]] = _Mailbox()
        self._network = network
        self._name = name
        self._connected_edge: MemoryEdgeLink | None = None

    def send(self, frames: Sequence[Bytes]) -> bool:
        edge = self._network.edge(self._name)
        return edge is not None and edge.inbox.put(
            IncomingMessage(self.peer, [bytes(frame) for frame in frames])
        )

    def receive(self, timeout_ms: int) -> list[bytes] | None:
        return self.inbox.get(timeout_ms)

    def trouble(self) -> str | None:
        return None

    def poll_connected(self) -> bool:
        edge, self._connected_edge = self._connected_edge, self._network.edge(self._name)
        return self._connected_edge is not None and self._connected_edge is not edge

    def wake(self) -> None:
        self.inbox.wake()

    def close(self) -> None:
        self._network.forget(self)


class MemoryEdgeLink:
    """`EdgeLink` within a `MemoryNetwork`."""

    def __init__(self, network: MemoryNetwork, name: str) -> None:
        self.endpoint = name
        self.inbox: _Mailbox[IncomingMessage] = _Mailbox()
        self._network = network

    def send(self, peer: bytes, frames: Sequence[Bytes]) -> bool:
        agent = self._network.agent(self.endpoint, peer)
        return agent is not None and agent.inbox.put([bytes(frame) for frame in frames])

    def receive(self, timeout_ms: int) -> IncomingMessage | None:
        return self.inbox.get(timeout_ms)

    def agent_names(self, key: str) -> frozenset[str] | None:
        return None

    def refusals(self) -> list[str]:
        return []

    def trouble(self) -> str | None:
        return None

    def wake(self) -> None:
        self.inbox.wake()

    def close(self) -> None:
        self._network.forget(self)
