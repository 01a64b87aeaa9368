"""A ZMTP 3.0 client made by hand (RFC 23), without libzmq: it can say what libzmq never would.

A frame: flags (1: more follows, 2: the size has 8 bytes, 4: a command), size, body.
"""

from __future__ import annotations

import socket
import struct
from types import TracebackType

MORE, LONG, COMMAND = 1, 2, 4
_GREETING, _READY = 64, 43  # bytes of a greeting, and of READY of a ROUTER


def greeting(mechanism: bytes = b"NULL", server: bool = False, version: tuple[int, int] = (3, 0)) -> bytes:
    """Signature, version, mechanism, role, filler."""
    return (
        b"\xff"
        + bytes(8)
        + b"\x7f"
        + bytes(version)
        + mechanism.ljust(20, b"\0")
        + bytes([server])
        + bytes(31)
    )


def frame(body: bytes, more: bool = False, command: bool = False) -> bytes:
    """As it goes over the wire."""
    flags = (MORE if more else 0) | (COMMAND if command else 0)
    if len(body) < 256:
        return bytes([flags, len(body)]) + body
    return bytes([flags | LONG]) + struct.pack(">Q", len(body)) + body


def head(size: int, more: bool = False) -> bytes:
    """Return the head of a frame that announces `size` bytes, which may never come."""
    return bytes([LONG | (MORE if more else 0)]) + struct.pack(">Q", size)


def message(*parts: bytes) -> bytes:
    """All parts, the last without MORE."""
    return b"".join(frame(part, more=at < len(parts)) for at, part in enumerate(parts, 1))


def parts(count: int, body: bytes = b"") -> bytes:
    """So many equal parts of a message that goes on."""
    return frame(body, more=True) * count


def command(name: bytes, data: bytes = b"") -> bytes:
    return frame(bytes([len(name)]) + name + data, command=True)


def ready(identity: bytes, kind: bytes = b"DEALER") -> bytes:
    """READY with the peer's routing id."""
    return command(b"READY", metadata(identity, kind))


def metadata(identity: bytes, kind: bytes = b"DEALER") -> bytes:
    """Properties of a peer, as in READY or INITIATE."""
    return b"".join(
        bytes([len(name)]) + name + struct.pack(">I", len(value)) + value
        for name, value in ((b"Socket-Type", kind), (b"Identity", identity))
    )


class RawPeer:
    """A TCP connection to `endpoint`, tcp://HOST:PORT, on which nothing has been said yet.

    Whoever it speaks to may close it at any time: `send` then says False, and `closed` within how long.
    """

    def __init__(self, endpoint: str, timeout_s: float = 5.0) -> None:
        host, _, port = endpoint.removeprefix("tcp://").rpartition(":")
        self.socket = socket.create_connection((host.strip("[]"), int(port)), timeout=timeout_s)

    @classmethod
    def joined(cls, endpoint: str, identity: bytes, timeout_s: float = 5.0) -> RawPeer:
        """One that has shaken hands without keys. Raises OSError where it is not let in."""
        peer = cls(endpoint, timeout_s)
        try:
            peer.socket.sendall(greeting())
            early = peer.hear(_GREETING)  # libzmq does not look at what comes in one segment with a greeting
            peer.socket.sendall(ready(identity))
            peer.hear(_READY - max(0, len(early) - _GREETING))
        except OSError:
            peer.close()
            raise
        return peer

    def send(self, data: bytes) -> bool:
        """Whether all of it went out; False where the other side has closed or takes no more."""
        try:
            self.socket.sendall(data)
        except OSError:
            return False
        return True

    def hear(self, at_least: int) -> bytes:
        """Raises ConnectionError where the other side closes before that many bytes."""
        received = b""
        while len(received) < at_least:
            more = self.socket.recv(65536)
            if not more:
                raise ConnectionError(f"closed after {len(received)} bytes")
            received += more
        return received

    def closed(self, within_s: float) -> bool:
        """Whether the other side closes in that time."""
        self.socket.settimeout(within_s)
        try:
            while self.socket.recv(65536):
                pass
        except TimeoutError:
            return False
        except OSError:
            pass
        return True

    def reset(self) -> None:
        """Breaks off at once: what is under way is thrown away."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.socket.close()

    def close(self) -> None:
        self.socket.close()

    def __enter__(self) -> RawPeer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
