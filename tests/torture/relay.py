"""A relay between agents and an edge (without keys), message by message: it records, and it loses, doubles
and reorders, cuts off, or goes silent."""

from __future__ import annotations

import random
import threading
import time
from dataclasses import dataclass, field

import zmq
from corpus import Recorded


@dataclass
class Weather:
    """What happens to a message: lost, doubled, late by up to `late_s` (so that later ones overtake)."""

    loss: float = 0.0
    twice: float = 0.0
    late: float = 0.0
    late_s: float = 0.3
    blind: bool = False  # nothing goes by, though all connections stand


@dataclass
class Relay:
    """Between `start` and `close`, agents that connect to `address` talk to the edge at `target`."""

    target: str
    weather: Weather = field(default_factory=Weather)
    seed: int = 1
    record: bool = False
    recorded: list[Recorded] = field(default_factory=list)
    counts: dict[str, int] = field(
        default_factory=lambda: dict.fromkeys(("lost", "doubled", "late", "passed"), 0)
    )

    def start(self) -> str:
        self._draw = random.Random(self.seed)
        self._context = zmq.Context()
        self._front = self._context.socket(zmq.ROUTER)
        self._front.setsockopt(zmq.ROUTER_HANDOVER, 1)
        self._front.setsockopt(zmq.LINGER, 0)
        self.address = f"tcp://127.0.0.1:{self._front.bind_to_random_port('tcp://127.0.0.1')}"
        self._backs: dict[bytes, zmq.Socket[bytes]] = {}
        self._late: list[tuple[float, bytes, bool, list[bytes]]] = []
        self._ending, self._cut = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        return self.address

    def cut(self) -> None:
        """Closes every connection to the edge at once; they are dialled again by what agents say next."""
        self._cut.set()

    def close(self) -> None:
        self._ending.set()
        self._thread.join(5)
        for socket in (self._front, *self._backs.values()):
            socket.close(0)
        self._context.term()

    def _run(self) -> None:
        while not self._ending.is_set():
            if self._cut.is_set():
                self._cut.clear()
                for back in self._backs.values():
                    back.close(0)
                self._backs.clear()
            poller = zmq.Poller()
            by_socket = {back: peer for peer, back in self._backs.items()}
            for socket in (self._front, *by_socket):
                poller.register(socket, zmq.POLLIN)
            for socket, _ in poller.poll(10):
                self._read(socket, by_socket.get(socket))
            now = time.monotonic()
            due, self._late = [m for m in self._late if m[0] <= now], [m for m in self._late if m[0] > now]
            for _, peer, up, parts in due:
                self._pass(peer, up, parts)

    def _read(self, socket: zmq.Socket[bytes], peer: bytes | None) -> None:
        for _ in range(64):
            try:
                parts = socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            if peer is None:
                self._take(parts[0], True, parts[1:])
            else:
                self._take(peer, False, parts)

    def _take(self, peer: bytes, up: bool, parts: list[bytes]) -> None:
        if self.record:
            self.recorded.append(Recorded(peer, up, parts))
        w, draw = self.weather, self._draw.random
        if w.blind or draw() < w.loss:
            self.counts["lost"] += 1
            return
        copies = 1 + (draw() < w.twice)
        self.counts["doubled"] += copies - 1
        for _ in range(copies):
            if draw() < w.late:
                self.counts["late"] += 1
                self._late.append((time.monotonic() + draw() * w.late_s, peer, up, parts))
            else:
                self._pass(peer, up, parts)

    def _pass(self, peer: bytes, up: bool, parts: list[bytes]) -> None:
        self.counts["passed"] += 1
        try:
            if up:
                self._back(peer).send_multipart(parts, zmq.NOBLOCK)
            else:
                self._front.send_multipart([peer, *parts], zmq.NOBLOCK)
        except zmq.ZMQError:
            self.counts["lost"] += 1

    def _back(self, peer: bytes) -> zmq.Socket[bytes]:
        if peer not in self._backs:
            back = self._context.socket(zmq.DEALER)
            back.setsockopt(zmq.ROUTING_ID, peer)
            back.setsockopt(zmq.LINGER, 0)
            back.setsockopt(zmq.IMMEDIATE, 1)
            back.setsockopt(zmq.RECONNECT_IVL, 100)
            back.connect(self.target)
            self._backs[peer] = back
        return self._backs[peer]
