"""What the kernel knows of a TCP connection that libzmq owns (Linux).

The descriptor is libzmq's: it may close it, and the number may come to mean another connection, at any time.
So each is known by its inode as well, and is never closed here.
"""

from __future__ import annotations

import array
import ctypes
import fcntl
import os
import socket
import stat
import struct
import termios
from contextlib import closing, suppress

_INFO_BYTES = 136
_RECEIVED_AT = 128  # tcpi_bytes_received in struct tcp_info, linux/tcp.h
_libc = ctypes.CDLL(None, use_errno=True)


def inode(descriptor: int) -> int | None:
    """None where it is no socket, or closed."""
    try:
        status = os.fstat(descriptor)
    except OSError:
        return None
    return status.st_ino if stat.S_ISSOCK(status.st_mode) else None


def addresses(descriptor: int) -> tuple[str, int] | None:
    """The host at the other end and the port at ours; None where it is not connected."""
    try:
        with closing(socket.socket(fileno=os.dup(descriptor))) as copy:
            return str(copy.getpeername()[0]), int(copy.getsockname()[1])
    except (OSError, IndexError, TypeError):  # a socket of another family has other names
        return None


def bytes_read(descriptor: int) -> int | None:
    """By whoever reads it, since it was connected; None where it is closed."""
    info = ctypes.create_string_buffer(_INFO_BYTES)
    size = ctypes.c_uint(_INFO_BYTES)
    if _libc.getsockopt(descriptor, socket.IPPROTO_TCP, socket.TCP_INFO, info, ctypes.byref(size)) != 0:
        return None
    (received,) = struct.unpack_from("=Q", info, _RECEIVED_AT)
    queued = array.array("i", [0])
    try:
        fcntl.ioctl(descriptor, termios.FIONREAD, queued)
    except OSError:
        return None
    return int(received) - queued[0]


def cut(descriptor: int, number: int) -> bool:
    """Shuts the connection with the inode `number` down, and throws away what it sent and nobody has read.
    Whether it was there."""
    try:
        copy = socket.socket(fileno=os.dup(descriptor))
    except OSError:
        return False
    with closing(copy):
        if inode(copy.fileno()) != number:
            return False
        with suppress(OSError):
            copy.shutdown(socket.SHUT_RDWR)
        waste = bytearray(65536)
        with suppress(OSError):
            while copy.recv_into(waste, 0, socket.MSG_TRUNC | socket.MSG_DONTWAIT):
                pass
    return True
