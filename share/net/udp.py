"""UDP sockets that stamp datagrams on arrival, by the kernel where available (Linux)."""

from __future__ import annotations

import contextlib
import math
import re
import select
import socket
import struct
import sys
import time
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from share.errors import UsageError
from share.net.transport import bind_error

MAX_DATAGRAM_BYTES = 2048  # longer ones are truncated
_TIMESTAMPNS = 35  # SO_TIMESTAMPNS, asm-generic/socket.h (x86 and ARM); Python has no name for it
_TIMESPEC = struct.Struct("@ll")
_ADDRESS = re.compile(r"(?:\[([0-9A-Fa-f:.%\w]+)\]|([A-Za-z0-9_.-]+))(?::(\d{1,5}))?")


@dataclass(frozen=True)
class HostPort:
    """Address of a UDP socket."""

    name: str
    port: int

    def __str__(self) -> str:
        return f"[{self.name}]:{self.port}" if ":" in self.name else f"{self.name}:{self.port}"


@dataclass(frozen=True)
class Datagram:
    """A received datagram. stamp_ns: Unix time of arrival, by the kernel or else by this process. source: the
    socket address."""

    data: bytes
    source: Any
    stamp_ns: int


class StampedSocket:
    """A UDP socket. has_kernel_stamps: the kernel, not this process, stamps its datagrams."""

    def __init__(self, family: int) -> None:
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self.has_kernel_stamps = False
        if sys.platform == "linux":
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, _TIMESTAMPNS, 1)
                self.has_kernel_stamps = True

    @classmethod
    def bind(cls, host: HostPort) -> StampedSocket:
        """Raises UsageError for an unknown host, TransportError if the address cannot be bound."""
        family, target = resolve(host)
        bound_socket = cls(family)
        try:
            bound_socket._socket.bind(target)
        except OSError as error:
            bound_socket.close()
            raise bind_error(host, error.errno, error.strerror or str(error), "server") from None
        return bound_socket

    @classmethod
    def connect(cls, host: HostPort) -> StampedSocket:
        """Return a socket that exchanges datagrams with `host` only. Raises UsageError for an unknown host,
        OSError for an unreachable one."""
        family, target = resolve(host)
        connected_socket = cls(family)
        try:
            connected_socket._socket.connect(target)
        except OSError:
            connected_socket.close()
            raise
        return connected_socket

    @property
    def port(self) -> int:
        """The bound port."""
        return int(self._socket.getsockname()[1])

    def send(self, data: bytes, to: Any = None) -> None:
        """Raises OSError."""
        if to is None:
            self._socket.send(data)
        else:
            self._socket.sendto(data, to)

    def receive(self, timeout_s: float) -> Datagram | None:
        """Return the next datagram, None after `timeout_s`. Raises OSError, on a connected socket also for a
        datagram sent before (connection refused)."""
        if not select.select([self._socket], [], [], max(0.0, timeout_s))[0]:
            return None
        try:
            data, extra, _, source = self._socket.recvmsg(MAX_DATAGRAM_BYTES, 64)
        except BlockingIOError:  # a damaged datagram that the kernel dropped
            return None
        return Datagram(data, source, _kernel_stamp_ns(extra) or time.time_ns())

    def close(self) -> None:
        """May be repeated."""
        self._socket.close()


def _kernel_stamp_ns(extra: list[tuple[int, int, bytes]]) -> int | None:
    for level, kind, data in extra:
        if (level, kind, len(data)) == (socket.SOL_SOCKET, _TIMESTAMPNS, _TIMESPEC.size):
            seconds, rest_ns = _TIMESPEC.unpack(data)
            return int(seconds) * 1_000_000_000 + int(rest_ns)
    return None


def parse_host(text: str, default_port: int, bind: bool = False) -> HostPort:
    """Parse HOST, HOST:PORT, [IPV6] or [IPV6]:PORT. Raises UsageError."""
    match = _ADDRESS.fullmatch(text)
    port = int(match[3]) if match and match[3] else default_port
    if not match or text.isdigit() or not (0 if bind else 1) <= port <= 65535:
        raise UsageError(
            f"'{text}' is not an address; give HOST or HOST:PORT, such as 192.168.1.10:{default_port}"
        )
    name = match[1] or match[2]
    return HostPort("127.0.0.1" if name == "localhost" else name, port)


def resolve(host: HostPort) -> tuple[int, Any]:
    """Return the address family and socket address. Raises UsageError for an unknown host."""
    try:
        candidates = socket.getaddrinfo(host.name, host.port, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UsageError(f"{host.name}: no such host ({reason}); give its name or IP address") from None
    return candidates[0][0], candidates[0][4]


def clock_precision() -> int:
    """Return the time that reading this machine's clock takes, as log2 of s (RFC 5905, section 7.3)."""
    readings = [time.time_ns() for _ in range(200)]
    min_step_ns = min((b - a for a, b in pairwise(readings) if b > a), default=1_000_000)
    return math.ceil(math.log2(min_step_ns * 1e-9))
