"""Connections of a WebSocket server count from their arrival on, before TLS."""

from __future__ import annotations

import asyncio
import asyncio.sslproto
import contextlib
import socket
import ssl
import subprocess
import sys
import time
import weakref
from pathlib import Path
from typing import Any

import pytest

bounded = pytest.importorskip("share.net.bounded_websocket", reason="websockets is not installed")
HELLO = b"\x16\x03\x01\x3f\xf0\x01\x00\x3f\xec\x03\x03" + bytes(8000)  # of TLS, unfinished
LIMITS = (4, 10, 200, 100.0, 2**18, 2**17)


@pytest.mark.skipif(
    subprocess.run([sys.executable, "-c", "import cryptography"], capture_output=True).returncode != 0,
    reason="cryptography is not installed",
)
def test_an_unfinished_tls_hello_has_a_place_of_few_and_two_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from websockets.asyncio.client import connect

    from share.headset.certificate import own_certificate

    ended = []

    class Protocol(asyncio.sslproto.SSLProtocol):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            ended.append(weakref.ref(self))

    monkeypatch.setattr(asyncio.sslproto, "SSLProtocol", Protocol)
    monkeypatch.setattr(bounded, "_COLLECTED", 16)

    async def count(handler_calls: list[int]) -> None:
        connections = bounded.PeerConnections(bounded.PeerLimits(*LIMITS))
        plain = socket.create_server(("127.0.0.1", 0), backlog=128)
        address = plain.getsockname()
        listener = bounded.BoundedListener(plain, connections)
        context = own_certificate(tmp_path, "127.0.0.1").context()

        async def handler(connection: object) -> None:
            handler_calls.append(1)

        def let_in(connection: object, _: object) -> None:
            assert connections.admit(connection)

        server = bounded.serve_bounded(handler, listener, context, process_request=let_in)
        async with server, contextlib.AsyncExitStack() as stack:
            began, silent = time.monotonic(), []
            for _ in range(60):
                silent.append(stack.enter_context(socket.create_connection(address)))
                silent[-1].sendall(HELLO)
                await asyncio.sleep(0.005)
            assert len(connections._waiting) <= 10
            open_ones = [one for one in silent if is_open(one)]
            assert len(open_ones) <= 10, "those over the limit are closed before their TLS is done"
            trusting = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
            trusting.check_hostname, trusting.verify_mode = False, ssl.CERT_NONE
            where = f"wss://127.0.0.1:{address[1]}"
            async with connect(where, ssl=trusting, proxy=None):
                assert connections.open_count == 1
            while connections._waiting:
                await asyncio.sleep(0.05)
                assert time.monotonic() - began < bounded.TLS_S + 10
            assert sum(one() is not None for one in ended) <= 30, "their memory is freed by and by"
            assert not any(is_open(one) for one in silent)

    handler_calls: list[int] = []
    asyncio.run(asyncio.wait_for(count(handler_calls), 40))
    assert handler_calls == [1]


def is_open(one: socket.socket) -> bool:
    one.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        try:
            return one.recv(1) != b""
        except ConnectionError:
            return False
    return True
