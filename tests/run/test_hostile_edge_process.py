"""`share agent` with an edge that sends absurd values: the same odometry, no exit, few lines."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import numpy as np
import pytest
import zmq
from helpers.children import Child
from helpers.liar import Liar

from share.errors import WireError
from share.wire import messages as m
from share.wire.codec import decode, encode


class HostileEdge:
    """Welcomes honestly, and then floods with lies."""

    def __init__(self) -> None:
        self._socket = zmq.Context.instance().socket(zmq.ROUTER)
        self.address = f"tcp://127.0.0.1:{self._socket.bind_to_random_port('tcp://127.0.0.1')}"
        self._liar, self.lies = Liar(np.random.default_rng(4)), 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._lie, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._ended.set()
        self._thread.join(10)
        self._socket.close(0)

    def _lie(self) -> None:
        peer, welcomed = b"", False
        while not self._ended.is_set():
            while self._socket.poll(0 if welcomed else 50):
                peer, *frames = self._socket.recv_multipart()
                message = self._heard(frames)
                if isinstance(message, m.Hello) and not welcomed:
                    welcomed = True
                    self._send(peer, encode(m.Welcome(1, 0)))
            if welcomed:
                self._send(peer, self._liar.say())
                self.lies += 1
                self._ended.wait(0.0005)

    def _heard(self, frames: list[bytes]) -> m.Message | None:
        try:
            message = decode(frames)
        except WireError:
            return None
        self._liar.hear(message)
        return message

    def _send(self, peer: bytes, frames: list) -> None:
        self._socket.send_multipart([peer, *map(bytes, frames)])


@pytest.mark.slow
def test_an_agent_survives_a_hostile_edge(plain_session: Path, tmp_path: Path) -> None:
    edge = HostileEdge()
    said = {}
    try:
        for name, address in (("hostile", edge.address), ("alone", "tcp://127.0.0.1:9")):
            who = (str(plain_session / "ar1"), "--name", "ann", "--kind", "ar", "--edge", address)
            child = Child(tmp_path / f"{name}.log", "agent", *who, "--out", str(tmp_path / name))
            assert child.wait(120) == (0 if name == "hostile" else 1), child.said
            said[name] = child.said
    finally:
        edge.close()
    assert edge.lies > 1000
    assert (tmp_path / "hostile/odom.tum").read_bytes() == (tmp_path / "alone/odom.tum").read_bytes()
    report = json.loads((tmp_path / "hostile/report.json").read_text())
    assert report["failed_steps"] == 0
    assert report["protocol"]["bad_messages"] > 10
    assert "Traceback" not in said["hostile"]
    assert len(said["hostile"].splitlines()) < 60
