"""An edge that lies: a ROUTER that answers agents with what no honest edge says.

Nothing of `share` is imported.

Each mode is a function of what has come; the address is that of a thread of this process.
"""

from __future__ import annotations

import math
import random
import struct
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zmq
from corpus import DOWN, KINDS, Corpus
from mutations import mutate
from raw_wire import Message, pack, unpack

FAR = (1e4, 1e6, 1e30, 1e153, 1e300, 1.7e308, -1.7e308)
IDS = (2**31 - 1, 10**9, 2**53, 2**63 - 1)
CLOCK_FAR_NS = 9 * 10**18  # 285 years
CLOCKS_NS = (0, -(2**63), 2**63 - 1, 9 * 10**18, 3600 * 10**9, -3600 * 10**9)


class LyingEdge:
    """Between `start` and `close`. said: messages sent, by kind."""

    def __init__(self, mode: str, traffic: Path, seed: int) -> None:
        self.mode, self._answer = mode, MODES[mode]
        self.corpus, self.draw = Corpus(traffic), random.Random(seed)
        self.version: int = 0
        self.session, self.newest, self.revision = self.draw.getrandbits(62), -1, 0
        self.said: Counter[str] = Counter()
        self.heard: Counter[str] = Counter()

    def start(self) -> str:
        self._context = zmq.Context()
        self._socket = self._bind(0)
        port = self._socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2]
        self.port = int(port.rstrip("\0"))
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        return f"tcp://127.0.0.1:{self.port}"

    def close(self) -> None:
        self._ending.set()
        self._thread.join(5)
        self._socket.close(0)
        self._context.term()

    def _bind(self, port: int) -> zmq.Socket[bytes]:
        socket = self._context.socket(zmq.ROUTER)
        for option in (zmq.SNDHWM, zmq.RCVHWM):
            socket.setsockopt(option, 1000)
        socket.setsockopt(zmq.ROUTER_HANDOVER, 1)
        socket.bind(f"tcp://127.0.0.1:{port or '*'}")
        return socket

    def _run(self) -> None:
        peer, again_s = b"", time.monotonic()
        while not self._ending.is_set():
            if self._socket.poll(5):
                peer, *parts = self._socket.recv_multipart()
                fields: Any = unpack(parts[0])
                self.version = fields[0]
                kind = next((name for name, code in KINDS.items() if code == fields[1]), "other")
                self.heard[kind] += 1
                if kind == "keyframe":
                    self.newest = max(self.newest, fields[2][0])
                self._say(peer, self._answer(self, kind, fields[2]))
            elif peer:
                self._say(peer, self._answer(self, "tick", []))
            if self.mode == "resets" and time.monotonic() > again_s + 0.3:
                self._socket.close(0)
                time.sleep(0.05)
                self._socket, again_s = self._bind(self.port), time.monotonic()

    def _say(self, peer: bytes, messages: list[Message]) -> None:
        for parts in messages:
            try:
                self._socket.send_multipart([peer, *parts], zmq.NOBLOCK)
                self.said["sent"] += 1
            except zmq.ZMQError:
                self.said["not taken"] += 1

    # ------------------------------------------------------------------ messages

    def of(self, kind: str, *scalars: object, arrays: tuple[tuple[int, list[float]], ...] = ()) -> Message:
        """scalars and square arrays of f8, in the version that the agent speaks."""
        table = [["<f8", [n, n]] for n, _ in arrays]
        return [
            pack([self.version, KINDS[kind], list(scalars), table]),
            *(struct.pack(f"<{n * n}d", *values) for n, values in arrays),
        ]

    def correction(self, x_m: float, sigma2: float = 1e-4, map_id: str = "liar-0000/0") -> Message:
        self.revision += 1
        T = [float(i % 5 == 0) for i in range(16)]
        T[3] = x_m
        cov = [sigma2 * (i % 7 == 0) for i in range(36)]
        about = max(0, self.newest)
        return self.of("correction", map_id, self.revision, about, about, arrays=((4, T), (6, cov)))

    def honest(self, kind: str, scalars: list[Any]) -> list[Message]:
        """As an edge would answer that has a map of its own for everybody."""
        now = time.monotonic_ns()
        match kind:
            case "hello":
                return [self.of("welcome", self.session, 0, 0.0)]
            case "ping":
                return [self.of("pong", scalars[0], scalars[1], now, now, self.session)]
            case "keyframe":
                return [self.of("ack", self.newest + 1, []), self.correction(0.01)]
        return []


def mutated(edge: LyingEdge, kind: str, scalars: list[Any]) -> list[Message]:
    out = edge.honest(kind, scalars)
    if kind == "hello" and edge.draw.random() < 0.5:
        return out
    base = out or [edge.draw.choice(edge.corpus.by_kind[edge.draw.choice(DOWN)])]
    return [mutate(edge.draw, message) for message in base for _ in range(5)] + out * (
        edge.draw.random() < 0.3
    )


def acks(edge: LyingEdge, kind: str, scalars: list[Any]) -> list[Message]:
    """Acknowledges what was never sent."""
    if kind == "keyframe":
        number = edge.draw.choice(IDS)
        return [
            edge.of("ack", number, []),
            edge.of("ack", 0, [number] * 256),
            edge.of("ack", 0, list(range(256))),
        ]
    return edge.honest(kind, scalars)


def welcomes(edge: LyingEdge, kind: str, scalars: list[Any]) -> list[Message]:
    """Another session with each answer, which goes on at a keyframe that is not there."""
    edge.session = edge.draw.getrandbits(62)
    out = edge.honest(kind, scalars)
    hold_ms = edge.draw.choice((0.0, 1.0, 1e4, -1.0, 1e300, math.inf, math.nan))
    return [edge.of("welcome", edge.session, edge.draw.choice((0, *IDS)), hold_ms), *out]


def corrections(edge: LyingEdge, kind: str, scalars: list[Any]) -> list[Message]:
    """To the end of the number range, each in another map."""
    out = edge.honest(kind, scalars)
    if kind == "keyframe":
        far, name = edge.draw.choice(FAR), f"map-{edge.draw.randrange(10**6)}/0"
        out += [edge.correction(far), edge.correction(-far, 1e12, name), edge.correction(far, 0.0, "m" * 64)]
    return out


def clocks(edge: LyingEdge, kind: str, scalars: list[Any]) -> list[Message]:
    """A clock that is anywhere, answered at once."""
    if kind == "ping":
        at = edge.draw.choice(CLOCKS_NS)
        return [edge.of("pong", scalars[0], scalars[1], at, at, edge.session)]
    return edge.honest(kind, scalars)


def clock_far(edge: LyingEdge, kind: str, scalars: list[Any]) -> list[Message]:
    """A clock that runs well, 285 years from the agent's."""
    if kind == "ping":
        at = time.monotonic_ns() + CLOCK_FAR_NS
        return [edge.of("pong", scalars[0], scalars[1], at, at, edge.session)]
    return edge.honest(kind, scalars)


def rates(edge: LyingEdge, kind: str, scalars: list[Any]) -> list[Message]:
    out = edge.honest(kind, scalars)
    numbers = (0.0, 5e-324, 1e-300, 1000.0, -1.0, math.inf, math.nan)
    pose_hz = edge.draw.choice((None, *numbers))
    quality = edge.draw.choice((None, 1, 20, 100, 0, -1, 10**9, 2.5))
    return [*out, edge.of("rate", edge.draw.choice(numbers), edge.draw.random() < 0.5, pose_hz, quality)]


def refuses(edge: LyingEdge, kind: str, scalars: list[Any]) -> list[Message]:
    """Welcomes and refuses by turns, at great length."""
    text = edge.draw.choice(("no", "x" * 512, "\x1b[2J\x07", "a\nb\rc", "‮"))
    return [*edge.honest(kind, scalars), *([edge.of("refused", text)] if edge.draw.random() < 0.3 else [])]


def tracked(edge: LyingEdge, kind: str, scalars: list[Any]) -> list[Message]:
    """Poses for frames that were never streamed."""
    eye = [float(i % 5 == 0) for i in range(16)]
    out = [
        edge.of("tracked", k, 10, "OK", True, True, True, None, arrays=((4, eye),)) for k in (0, 1, 2**31, -1)
    ]
    return [*edge.honest(kind, scalars), *out]


def flood(edge: LyingEdge, kind: str, scalars: list[Any]) -> list[Message]:
    """As much as the link takes, all valid."""
    more = [edge.correction(edge.draw.uniform(-1, 1)) for _ in range(40)] if edge.heard["keyframe"] else []
    return [*edge.honest(kind, scalars), *more]


def silent(edge: LyingEdge, kind: str, scalars: list[Any]) -> list[Message]:
    return []


def half_silent(edge: LyingEdge, kind: str, scalars: list[Any]) -> list[Message]:
    """Welcomes, and answers pings, and acknowledges nothing."""
    return [] if kind == "keyframe" else edge.honest(kind, scalars)


def resets(edge: LyingEdge, kind: str, scalars: list[Any]) -> list[Message]:
    """Its socket is closed and bound again three times a second."""
    return edge.honest(kind, scalars)


Answer = Callable[[LyingEdge, str, list[Any]], list[Message]]
MODES: dict[str, Answer] = {
    f.__name__.replace("_", "-"): f
    for f in (
        mutated, acks, welcomes, corrections, clocks, clock_far, rates, refuses, tracked, flood, silent,
        half_silent, resets,
    )
}  # fmt: skip
