"""Writing to stderr blocks nothing, whether or not the output is read."""

from __future__ import annotations

import fcntl
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import zmq

from share.cli import stderr as stderr_module
from share.cli.stderr import Stderr
from share.cli.terminal import LiveLine
from share.wire import messages as m
from share.wire.codec import decode, encode


@contextmanager
def pipe(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, int]]:
    """Return both ends of a pipe of 4 kB; stderr writes to it."""
    reader, writer = os.pipe()
    fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
    with os.fdopen(writer, "w", closefd=False) as stream, monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", stream)
        yield reader, writer
    os.close(reader)  # first: what still waits to be written ends
    os.close(writer)


def read(handle: int, until: bytes) -> bytes:
    data = b""
    while until not in data:
        data += os.read(handle, 65536)
    return data


def test_blocked_reader_delays_nothing_and_dropped_lines_are_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(stderr_module, "MAX_PENDING_LINES", 50)
    with pipe(monkeypatch) as (reader, _):
        stderr, began = Stderr(), time.monotonic()
        for i in range(200):
            stderr.print_line(f"{i} {'x' * 200}")
        stderr.flush(0.05)
        assert time.monotonic() - began < 1.0
        assert b"0 xxx" in read(reader, b"\n49 ")
        stderr.flush()
        stderr.print_line("again")
        assert b"lines were dropped" in read(reader, b"again\n")


def test_lines_keep_their_order_and_are_written_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    with pipe(monkeypatch) as (reader, writer):
        line = LiveLine()
        for i in range(20):
            line.print_line(f"{i}")
        line.end()
        os.write(writer, b"after")
        assert read(reader, b"after").decode().split() == [*map(str, range(20)), "after"]


def test_full_disk_does_not_end_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stderr", full)
        line = LiveLine()
        line.print_line("one")
        line.end()
        line.print_line("two")
        line.end()


@pytest.mark.long
def test_edge_with_a_blocked_output_answers_and_ends(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with suppress(BlockingIOError):
        while True:
            os.write(writer, bytes(4096))
    os.set_blocking(writer, True)
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    edge = subprocess.Popen(
        [sys.executable, "-m", "share", "edge", "--bind", address, "--map", str(tmp_path / "room.sqlite")],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=writer,
    )
    context = zmq.Context()
    agent = context.socket(zmq.DEALER)
    try:
        agent.setsockopt(zmq.ROUTING_ID, m.peer_id(1))
        agent.connect(address)
        agent.send_multipart(encode(m.Ping(1, 0)))
        assert agent.poll(20_000), "no answer to a ping"
        assert isinstance(decode(agent.recv_multipart()), m.Pong)
        edge.send_signal(signal.SIGINT)
        assert edge.wait(20) == 0
    finally:
        edge.kill()
        edge.wait()
        agent.close(0)
        context.term()
        os.close(writer)
        os.close(reader)
