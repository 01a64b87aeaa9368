"""ZMTP and msgpack written from their specifications, for peers that do not keep to them.

Nothing of `share` is imported: what the encoder would never write is what is to be sent.
"""

from __future__ import annotations

import math
import socket
import struct
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from urllib.parse import urlsplit

Message = list[bytes]  # frame 0 is the header, as docs/lookup/wire.md has it

MORE, LONG, COMMAND = 1, 2, 4
MOST_NESTED = 50  # that `unpack` follows
GREETING = b"\xff" + bytes(8) + b"\x7f" + b"\x03\x00" + b"NULL".ljust(20, b"\0") + b"\0" + bytes(31)


# ------------------------------------------------------------------ msgpack


@dataclass(frozen=True)
class Raw:
    """Bytes that stand in a header as they are, whatever they say."""

    data: bytes


def pack(value: object) -> bytes:
    """msgpack of a value; integers beyond 64 bits become floats."""
    match value:
        case Raw():
            return value.data
        case None:
            return b"\xc0"
        case bool():
            return b"\xc3" if value else b"\xc2"
        case int():
            return _pack_int(value)
        case float():
            return b"\xcb" + struct.pack(">d", value)
        case str():
            return _head(len(data := value.encode()), 0xA0, 32, (0xD9, 0xDA, 0xDB)) + data
        case bytes():
            return _head(len(value), None, 0, (0xC4, 0xC5, 0xC6)) + value
        case list() | tuple():
            return _head(len(value), 0x90, 16, (None, 0xDC, 0xDD)) + b"".join(map(pack, value))
        case dict():
            body = b"".join(pack(k) + pack(v) for k, v in value.items())
            return _head(len(value), 0x80, 16, (None, 0xDE, 0xDF)) + body
    raise TypeError(f"cannot pack {type(value).__name__}")


def _pack_int(value: int) -> bytes:
    if 0 <= value < 128:
        return bytes([value])
    if -32 <= value < 0:
        return struct.pack(">b", value)
    if 0 <= value < 2**64:
        return b"\xcf" + struct.pack(">Q", value)
    if -(2**63) <= value < 0:
        return b"\xd3" + struct.pack(">q", value)
    return pack(float(value) if abs(value) < 2**1000 else math.inf)


def _head(n: int, small: int | None, below: int, codes: Sequence[int | None]) -> bytes:
    if small is not None and n < below:
        return bytes([small | n])
    for code, form, most in zip(codes, (">B", ">H", ">I"), (2**8, 2**16, 2**32), strict=True):
        if code is not None and n < most:
            return bytes([code]) + struct.pack(form, n)
    raise ValueError(f"{n} is too long for msgpack")


def unpack(data: bytes) -> object:
    """The value of msgpack bytes. Raises ValueError where they are none."""
    try:
        value, _ = _unpack(data, 0)
    except (IndexError, TypeError, struct.error, OverflowError, MemoryError) as error:
        raise ValueError(f"no msgpack: {error}") from None
    return value


_FIXED = {0xC0: None, 0xC2: False, 0xC3: True}
_NUMBERS = {0xCA: ">f", 0xCB: ">d", 0xCC: ">B", 0xCD: ">H", 0xCE: ">I", 0xCF: ">Q"}
_NUMBERS |= {0xD0: ">b", 0xD1: ">h", 0xD2: ">i", 0xD3: ">q"}
_LENGTHS = {0xC4: ">B", 0xC5: ">H", 0xC6: ">I", 0xD9: ">B", 0xDA: ">H", 0xDB: ">I"}
_LENGTHS |= {0xDC: ">H", 0xDD: ">I", 0xDE: ">H", 0xDF: ">I"}


def _unpack(data: bytes, at: int, depth: int = 0) -> tuple[object, int]:
    if depth > MOST_NESTED:
        raise ValueError("nested too deep")
    code, at = data[at], at + 1
    if code < 0x80:
        return code, at
    if code >= 0xE0:
        return code - 256, at
    if code in _FIXED:
        return _FIXED[code], at
    if (form := _NUMBERS.get(code)) is not None:
        size = struct.calcsize(form)
        return struct.unpack(form, data[at : at + size])[0], at + size
    if code < 0xC0:
        kind, n = (
            ("map", code & 15) if code < 0x90 else ("list", code & 15) if code < 0xA0 else ("str", code & 31)
        )
    elif (form := _LENGTHS.get(code)) is not None:
        size = struct.calcsize(form)
        n, at = struct.unpack(form, data[at : at + size])[0], at + size
        kind = "bytes" if code < 0xC7 else "str" if code < 0xDC else "list" if code < 0xDE else "map"
    else:
        raise ValueError(f"msgpack code {code:#x}")
    if kind in ("str", "bytes"):
        text = data[at : at + n]
        return (text.decode() if kind == "str" else text), at + n
    items = []
    for _ in range(n if kind == "list" else 2 * n):
        item, at = _unpack(data, at, depth + 1)
        items.append(item)
    return (items if kind == "list" else dict(zip(items[::2], items[1::2], strict=True))), at


# ------------------------------------------------------------------ ZMTP 3.0, NULL


def frame(body: bytes, flags: int = 0) -> bytes:
    if len(body) < 256:
        return bytes([flags, len(body)]) + body
    return bytes([flags | LONG]) + struct.pack(">Q", len(body)) + body


def multipart(parts: Sequence[bytes]) -> bytes:
    last = len(parts) - 1
    return b"".join([frame(part, MORE if i < last else 0) for i, part in enumerate(parts)])


def _property(name: bytes, value: bytes) -> bytes:
    return bytes([len(name)]) + name + struct.pack(">I", len(value)) + value


def ready(identity: bytes) -> bytes:
    body = b"\x05READY" + _property(b"Socket-Type", b"DEALER") + _property(b"Identity", identity)
    return frame(body, COMMAND)


def host_port(address: str) -> tuple[str, int]:
    parts = urlsplit(address)
    assert parts.hostname is not None and parts.port is not None, address
    return parts.hostname, parts.port


def dial(address: str, timeout_s: float = 5.0) -> socket.socket:
    """A plain TCP connection, no byte said."""
    return socket.create_connection(host_port(address), timeout_s)


def _frame_at(data: bytes, at: int) -> tuple[int, bytes, int] | None:
    """Flags and body of the frame that begins at `at`, and where it ends, if all of it is there."""
    if len(data) < at + 2:
        return None
    begin = at + (9 if data[at] & LONG else 2)
    if len(data) < begin:
        return None
    end = begin + (struct.unpack_from(">Q", data, at + 1)[0] if data[at] & LONG else data[at + 1])
    return None if len(data) < end else (data[at], data[begin:end], end)


class RawPeer:
    """A DEALER without keys whose every byte can be chosen. Reads what comes only when asked to."""

    def __init__(self, address: str, identity: bytes, timeout_s: float = 5.0) -> None:
        self.socket = dial(address, timeout_s)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._unread = b""
        self._parts: Message = []
        self.socket.sendall(GREETING + ready(identity))
        self._read_exactly(64)

    def send(self, messages: Iterable[Message]) -> None:
        """All of them in one write. Raises OSError once the other side has closed, or takes nothing."""
        self.socket.sendall(b"".join([multipart(parts) for parts in messages]))

    def send_bytes(self, data: bytes) -> None:
        self.socket.sendall(data)

    def drain(self) -> int:
        """Throws away what has come. Bytes; raises OSError once the other side has closed."""
        self.socket.setblocking(False)
        n = 0
        try:
            while n < 1 << 20:
                data = self.socket.recv(65536)
                if not data:
                    raise ConnectionResetError("closed by the edge")
                n += len(data)
        except BlockingIOError:
            pass
        finally:
            self.socket.settimeout(5.0)
        return n

    def come(self) -> list[Message]:
        """Whole messages that have come, without waiting. Raises OSError once the other side has closed."""
        self.socket.setblocking(False)
        try:
            while len(self._unread) < 1 << 22:
                self._fill()
        except BlockingIOError:
            pass
        finally:
            self.socket.settimeout(5.0)
        out: list[Message] = []
        at = 0
        while (found := _frame_at(self._unread, at)) is not None:
            flags, body, at = found
            if flags & COMMAND:
                if body[:5] == b"\x04PING":
                    self.socket.sendall(frame(b"\x04PONG" + body[7:], COMMAND))
                continue
            self._parts.append(body)
            if not flags & MORE:
                out.append(self._parts)
                self._parts = []
        self._unread = self._unread[at:]
        return out

    def hear(self, timeout_s: float = 2.0) -> list[Message]:
        """Whole messages that have come, waiting for the first; pings of the link are answered."""
        self.socket.settimeout(timeout_s)
        out: list[Message] = []
        parts: Message = []
        end = time.monotonic() + timeout_s
        while time.monotonic() < end or parts:
            try:
                flags, body = self._frame()
            except TimeoutError:
                return out
            if flags & COMMAND:
                if body[:5] == b"\x04PING":
                    self.socket.sendall(frame(b"\x04PONG" + body[7:], COMMAND))
                continue
            parts.append(body)
            if not flags & MORE:
                out.append(parts)
                parts = []
                self.socket.settimeout(0.05)
        return out

    def _frame(self) -> tuple[int, bytes]:
        """The next frame; what is not whole yet stays. Raises TimeoutError."""
        while (found := _frame_at(self._unread, 0)) is None:
            self._fill()
        flags, body, end = found
        self._unread = self._unread[end:]
        return flags, body

    def _fill(self) -> None:
        data = self.socket.recv(65536)
        if not data:
            raise ConnectionResetError("closed by the edge")
        self._unread += data

    def _read_exactly(self, n: int) -> bytes:
        while len(self._unread) < n:
            self._fill()
        out, self._unread = self._unread[:n], self._unread[n:]
        return out

    def close(self, reset: bool = False) -> None:
        """reset: by RST, so that nothing of it lingers."""
        if reset:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.socket.close()
