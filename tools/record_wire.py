"""Record the messages between agents and the edge of this release, for tests of later ones.

    python tools/record_wire.py OUT

Two agents run against an edge through a relay that records every message; then one agent streams to an edge
that tracks. OUT/wire-N.msgpack.gz has the messages, OUT/map-N.sqlite.gz the edge's map file, where N is the
wire version. tests/wire/recorded has those of the last releases; `recorded_traffic.py` reads them. Only
the commands of SHARE are used, so that every release can be recorded.
"""

from __future__ import annotations

import gzip
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import zmq

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from helpers.small_session import small_profile

SECONDS = 6
PER_KIND, PER_RAW = 12, 3  # messages kept of each kind, peer and direction; of raw frames
RAW_BYTES = 30_000
KINDS = {"ann": "ar", "rob": "robot"}
SHARE = [sys.executable, "-m", "share"]


class Relay(threading.Thread):
    """Relays between agents and an edge by ZeroMQ sockets of the same kinds, and records the messages."""

    def __init__(self, edge: str, name: str) -> None:
        super().__init__(daemon=True)
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._front = self._context.socket(zmq.ROUTER)
        self.address = f"tcp://127.0.0.1:{self._front.bind_to_random_port('tcp://127.0.0.1')}"
        self._edge, self._name = edge, name
        self._backs: dict[bytes, zmq.Socket[bytes]] = {}
        self._kept: Counter[tuple[bytes, str, int]] = Counter()
        self._began_ns = time.monotonic_ns()
        self.messages: list[dict[str, Any]] = []
        self.stopping = False

    def run(self) -> None:
        while not self.stopping:
            poller = zmq.Poller()
            for socket in (self._front, *self._backs.values()):
                poller.register(socket, zmq.POLLIN)
            ready = dict(poller.poll(50))
            if self._front in ready:
                self._up(*self._front.recv_multipart())
            for peer, back in list(self._backs.items()):
                if back in ready:
                    self._down(peer, back.recv_multipart())
        self._context.destroy(linger=0)

    def _up(self, peer: bytes, *frames: bytes) -> None:
        if peer not in self._backs:
            back = self._backs[peer] = self._context.socket(zmq.DEALER)
            back.routing_id = peer
            back.connect(self._edge)
        self._keep(peer, "up", frames)
        self._backs[peer].send_multipart(frames)

    def _down(self, peer: bytes, frames: list[bytes]) -> None:
        self._keep(peer, "down", tuple(frames))
        self._front.send_multipart([peer, *frames])

    def _keep(self, peer: bytes, way: str, frames: tuple[bytes, ...]) -> None:
        code = msgspec.msgpack.decode(frames[0])[1]
        self._kept[peer, way, code] += 1
        raw = sum(map(len, frames)) > RAW_BYTES
        if self._kept[peer, way, code] <= (PER_RAW if raw else PER_KIND):
            t_ns = time.monotonic_ns() - self._began_ns
            self.messages.append(
                {"edge": self._name, "way": way, "peer": peer, "t_ns": t_ns, "frames": list(frames)}
            )


def main(out: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        session = _session(work)
        said = _maps(work, session) + _streams(work, session)
        version = max(map(_version, said))
        messages = [message for message in said if _version(message) == version]  # no Pings of earlier ones
        record = {"wire": version, "share": _said("--version"), "messages": messages}
        out.mkdir(parents=True, exist_ok=True)
        _write(out / f"wire-{version}.msgpack.gz", msgspec.msgpack.encode(record))
        _write(out / f"map-{version}.sqlite.gz", (work / "map.sqlite").read_bytes())


def _version(message: dict[str, Any]) -> int:
    return int(msgspec.msgpack.decode(message["frames"][0])[0])


def _session(work: Path) -> Path:
    session = work / "session"
    motions = ("--motion", "ann=walk:", "--motion", "rob=walk:")
    more = ("--seconds", str(SECONDS), "--profile", str(small_profile(work)), "--out", str(session))
    subprocess.run([*SHARE, "emulate", "--scene", "plain", *motions, *more], check=True)
    return session


def _maps(work: Path, session: Path) -> list[dict[str, Any]]:
    """Record two agents, and a third that uses a name in use."""
    with _Edge(work / "edge.log", "--map", str(work / "map.sqlite")) as edge:
        relay = _relay(edge, "maps")
        runs = [_agent(work, session / name, name, relay) for name in ("ann", "rob")]
        time.sleep(2.0)
        refused = _agent(work, session / "ann", "ann", relay)
        _wait(refused, ok=False)
        for run in runs:
            _wait(run)
    relay.stopping = True
    return relay.messages


def _streams(work: Path, session: Path) -> list[dict[str, Any]]:
    with _Edge(work / "streamed.log", "--policy", "streamed") as edge:
        relay = _relay(edge, "streamed")
        _wait(_agent(work, session / "ann", "ann", relay, "--streamed"))
    relay.stopping = True
    return relay.messages


class _Edge:
    """A listening edge at `address`."""

    def __init__(self, log: Path, *more: str) -> None:
        with log.open("wb") as sink:
            command = [*SHARE, "edge", "--bind", "tcp://127.0.0.1:0", *more]
            self._process = subprocess.Popen(command, stdout=sink, stderr=sink)
        while (found := re.search(r"listening on (tcp://\S+?),", log.read_text())) is None:
            if self._process.poll() is not None:
                sys.exit(f"the edge has ended: {log.read_text()}")
            time.sleep(0.05)
        self.address = found[1]

    def __enter__(self) -> _Edge:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.send_signal(signal.SIGINT)
        self._process.wait(30)


def _relay(edge: _Edge, name: str) -> Relay:
    relay = Relay(edge.address, name)
    relay.start()
    return relay


def _agent(work: Path, source: Path, name: str, relay: Relay, *more: str) -> subprocess.Popen[bytes]:
    who = ("--name", name, "--kind", KINDS[name], "--edge", relay.address)
    return subprocess.Popen([*SHARE, "agent", str(source), *who, *more])


def _wait(run: subprocess.Popen[bytes], ok: bool = True) -> None:
    if (run.wait(120) == 0) is not ok:
        sys.exit(f"an agent ended with exit code {run.returncode}")


def _said(*command: str) -> str:
    return subprocess.run([*SHARE, *command], check=True, capture_output=True, text=True).stdout.strip()


def _write(path: Path, data: bytes) -> None:
    path.write_bytes(gzip.compress(data, 9, mtime=0))
    print(f"{path}: {path.stat().st_size} bytes")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
