"""A TCP port before another one, whose bytes take as long as over an emulated network."""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
import time

import numpy as np

from share.lab.evaluate.emulated_network import Channel, NetworkModel

_CHUNK = 65536


class DelayedPort:
    """Forwards connections at `port` of 127.0.0.1 to `target`. Each has delays of its own, by the
    seed and its number."""

    def __init__(self, target: tuple[str, int], network: NetworkModel, seed: int) -> None:
        self._target, self._network = target, network
        self._seeds, self._open, self._is_gone = np.random.default_rng(seed), list[socket.socket](), False
        self._is_clear = threading.Event()
        self._is_clear.set()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._is_clear.set()
        self._listener.close()

    def hold(self, is_silent: bool) -> None:
        """Let nothing through and end nothing, as where a Wi-Fi is out of reach; or let come what waited."""
        if is_silent:
            self._is_clear.clear()
        else:
            self._is_clear.set()

    def cut(self, is_gone: bool) -> None:
        """End all connections and let no other in, or be there again."""
        self._is_gone = is_gone
        while self._open:
            with contextlib.suppress(OSError):
                self._open.pop().shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                if self._is_gone:
                    near.close()
                    continue
                far = socket.create_connection(self._target)
                for one in (near, far):
                    one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._open += [near, far]
                up, down = self._seeds.spawn(2)
                for source, sink, model, rng in (
                    (near, far, self._network.up, up),
                    (far, near, self._network.down, down),
                ):
                    self._forward(source, sink, Channel(model, self._network.round_trip_ms, rng))

    def _forward(self, source: socket.socket, sink: socket.socket, channel: Channel) -> None:
        waiting: queue.Queue[tuple[int, bytes]] = queue.Queue()

        def take() -> None:
            with contextlib.suppress(OSError):
                while data := source.recv(_CHUNK):
                    waiting.put((channel.arrival_ns(len(data), time.monotonic_ns()), data))
            waiting.put((time.monotonic_ns(), b""))

        def give() -> None:
            with contextlib.suppress(OSError):
                while True:
                    arrival_ns, data = waiting.get()
                    time.sleep(max(0, arrival_ns - time.monotonic_ns()) * 1e-9)
                    self._is_clear.wait()
                    if not data:
                        break
                    sink.sendall(data)
            for one in (source, sink):
                one.close()

        for work in (take, give):
            threading.Thread(target=work, daemon=True).start()
