"""Attacks by a raw edge on an agent's link in a process of its own.

Memory is the most that its process ever had.
"""

from __future__ import annotations

import json
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from helpers.raw_zmtp import command, frame, greeting, message, metadata, parts

GROWTH_BYTES = 120_000_000  # 5 to 70 MB, by how busy the machine is; without a guard 700 MB and more
PING = command(b"PING", b"\0\0abc")


@dataclass
class RawEdge:
    """Listens; to each agent that comes and shakes hands it sends `said` again and again, until it is cut
    off, or sends `once` and resets the connection. sent: bytes, to each."""

    said: bytes = b""
    once: bytes | None = None
    sent: list[int] = field(default_factory=list)
    came_s: list[float] = field(default_factory=list)
    is_over: bool = False

    def __post_init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def close(self) -> None:
        self.is_over = True
        self._thread.join()
        self._listener.close()

    def _serve(self) -> None:
        self._listener.settimeout(0.1)
        while not self.is_over:
            try:
                agent, _ = self._listener.accept()
            except TimeoutError:
                continue
            with agent:
                self.came_s.append(time.monotonic())
                agent.settimeout(1.0)
                try:
                    self._speak(agent)
                except OSError:
                    continue

    def _speak(self, agent: socket.socket) -> None:
        agent.sendall(greeting())
        heard = b""
        while (
            len(heard) <= 64
        ):  # its greeting, then READY: libzmq does not look at what comes with a greeting
            heard += agent.recv(1000)
        agent.sendall(command(b"READY", metadata(b"", b"ROUTER")))
        self.sent.append(0)
        if self.once is not None:
            agent.sendall(self.once)
            time.sleep(0.05)
            agent.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            return
        while not self.is_over:
            agent.sendall(self.said)
            self.sent[-1] += len(self.said)


@dataclass
class LoneAgent:
    process: subprocess.Popen[str]
    usual: int = 0

    @property
    def growth(self) -> int:
        return self.status("VmHWM") - self.usual

    def status(self, name: str) -> int:
        lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(name))

    def end(self) -> dict[str, Any]:
        said, _ = self.process.communicate("over\n", timeout=30)
        assert self.process.returncode == 0
        return dict(json.loads(said))


@contextmanager
def agent_of(edge: RawEdge) -> Iterator[LoneAgent]:
    command = [sys.executable, str(Path(__file__).parents[1] / "helpers" / "lone_agent.py"), edge.endpoint]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        child.stdout.readline()
        agent = LoneAgent(child)
        agent.usual = agent.status("VmRSS")
        try:
            yield agent
        finally:
            child.kill()
            edge.close()


def wait_for(what: Callable[[], object], within_s: float = 15.0) -> None:
    end = time.monotonic() + within_s
    while not what():
        assert time.monotonic() < end, "did not happen in time"
        time.sleep(0.005)


FLOODS = {
    "a message without end": parts(16, bytes(60_000)),
    "empty parts": parts(30_000),
    "empty messages": message(b"") * 30_000,
    "valid messages": message(bytes(30), bytes(128)) * 1000,
    "messages of many parts": parts(30_000) + message(b""),
}


@pytest.mark.long
@pytest.mark.parametrize("said", FLOODS.values(), ids=FLOODS)
def test_an_agent_leaves_an_edge_that_sends_too_much(said: bytes) -> None:
    """One line, and it is tried again after 1 s, then 2, 4 ..."""
    edge = RawEdge(said)
    with agent_of(edge) as agent:
        wait_for(lambda: len(edge.came_s) > 1)
        between_s = edge.came_s[1] - edge.came_s[0]
        print(f"growth {agent.growth / 1e6:.1f} MB, sent {edge.sent}, back after {between_s:.2f} s")
        assert agent.growth < GROWTH_BYTES
        assert between_s > 0.9
        at_end = agent.end()
    said_once = {line.partition(" (")[0] for line in at_end["said"]}  # the reason depends on who is sooner
    assert said_once == {"disconnected from the edge, which sends what no edge does"}


@pytest.mark.long
def test_reconnection_intervals_grow() -> None:
    edge = RawEdge(parts(30_000))
    with agent_of(edge) as agent:
        wait_for(lambda: len(edge.came_s) > 2)
        first, second = (b - a for a, b in zip(edge.came_s, edge.came_s[1:], strict=False))
        assert first > 0.9 and second > first + 0.5
        assert len(agent.end()["said"]) == 1


@pytest.mark.long
@pytest.mark.parametrize("last", [b"", PING], ids=["messages", "a ping"])
def test_an_edge_that_fills_the_queue_and_resets(last: bytes) -> None:
    """Input that libzmq had stopped and a heartbeat would end the process: its input is never stopped."""
    edge = RawEdge(once=(message(bytes(10)) * 200 + last) * 50)
    with agent_of(edge) as agent:
        wait_for(lambda: len(edge.sent) > 4)
        time.sleep(1.0)  # two heartbeats
        assert agent.end()["joined"] > 2


@pytest.mark.long
def test_oversized_frames_and_garbage() -> None:
    for said in (frame(bytes(70_000)), b"\xff" * 1000, b"\x01\x00" * 1000):
        edge = RawEdge(once=said)
        with agent_of(edge) as agent:
            wait_for(lambda edge=edge: len(edge.sent) > 1)
            assert agent.growth < GROWTH_BYTES
            agent.end()
