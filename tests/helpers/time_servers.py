"""Time servers on loopback, of which tests know how far they are off; and the real chronyd."""

from __future__ import annotations

import getpass
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from share.devices.time_server import TimeServer
from share.net.ntp import NtpPacket, to_stamp

MS = 1_000_000
CHRONYD = shutil.which("chronyd") or next(iter(map(str, Path("/usr/sbin").glob("chronyd"))), None)
CHRONYC = shutil.which("chronyc")
needs_chrony = pytest.mark.skipif(not (CHRONYD and CHRONYC), reason="chrony is not installed")

Replies = Callable[[bytes], list[bytes]]


@contextmanager
def udp(replies: Replies, address: str = "127.0.0.1") -> Iterator[int]:
    """Answers each datagram with some; gives its port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.bind((address, 0))
        own.settimeout(0.05)
        over = threading.Event()

        def serve() -> None:
            while not over.is_set():
                try:
                    data, source = own.recvfrom(2048)
                except TimeoutError:
                    continue
                for reply in replies(data):
                    own.sendto(reply, source)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield own.getsockname()[1]
        finally:
            over.set()
            thread.join()


def shifted(offset_ms: float, slow_ms: float = 0.0, **changed: object) -> Replies:
    """Return the replies of a server whose clock is `offset_ms` ahead; it reads requests `slow_ms` late."""
    server, offset_ns = TimeServer(precision=-20), round(offset_ms * MS)

    def replies(data: bytes) -> list[bytes]:
        time.sleep(slow_ms / 1e3)
        reply = server.answer(data, "", time.time_ns() + offset_ns, time.monotonic_ns())
        assert isinstance(reply, NtpPacket)
        whole = replace(reply, **changed)  # type: ignore[arg-type]
        return [replace(whole, transmit=to_stamp(time.time_ns() + offset_ns)).encode()]

    return replies


def chronyd(*arguments: str) -> list[str]:
    """Its command line; as who runs the tests, so that it can read their files."""
    return [str(CHRONYD), "-U", "-u", getpass.getuser(), *arguments]


@contextmanager
def running_chronyd(folder: Path, *config: str) -> Iterator[Path]:
    """A chronyd that leaves the clock of this machine alone (-x), until its socket is there: gives that."""
    folder.mkdir()
    folder.chmod(0o750)
    control = folder / "chronyd.sock"
    files = ["cmdport 0", f"bindcmdaddress {control}", f"pidfile {folder / 'chronyd.pid'}"]
    (folder / "chrony.conf").write_text("\n".join([*files, *config]) + "\n")
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(
            chronyd("-d", "-x", "-f", str(folder / "chrony.conf")), stderr=log, stdout=log
        )
        try:
            wait_for(control.exists)
            yield control
        finally:
            process.terminate()
            process.wait(10)


def wait_for(so: Callable[[], object], limit_s: float = 20.0) -> None:
    deadline = time.monotonic() + limit_s
    while not so():
        assert time.monotonic() < deadline, "it did not come to be"
        time.sleep(0.05)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
