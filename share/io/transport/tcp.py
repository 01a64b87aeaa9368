"""What the kernel knows of a TCP connection that libzmq owns, and of this process (Linux).

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
from contextlib import closing

_INFO_BYTES = 136
_RECEIVED_AT = 128  # tcpi_bytes_received in struct tcp_info, linux/tcp.h
_TRIES = 4
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_NOWHERE = bytes(16)  # a sockaddr of AF_UNSPEC: connect(2) to it ends a TCP connection with a reset
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


def bytes_read(descriptor: int) -> tuple[int, bool] | None:
    """By whoever reads it, since it was connected, and whether exactly so many or at least; None where it is
    closed."""
    before = _received(descriptor)
    for _ in range(_TRIES):
        queued = array.array("i", [0])
        try:
            fcntl.ioctl(descriptor, termios.FIONREAD, queued)
        except OSError:
            return None
        after = _received(descriptor)
        if before is None or after is None:
            return None
        if before == after:  # else some of what is queued came since
            return after - queued[0], True
        least, before = before - queued[0], after
    return least, False


def _received(descriptor: int) -> int | None:
    """Bytes that came so far."""
    info = ctypes.create_string_buffer(_INFO_BYTES)
    size = ctypes.c_uint(_INFO_BYTES)
    if _libc.getsockopt(descriptor, socket.IPPROTO_TCP, socket.TCP_INFO, info, ctypes.byref(size)) != 0:
        return None
    return int(struct.unpack_from("=Q", info, _RECEIVED_AT)[0])


def resident_bytes() -> int:
    """Memory of this process that is really there."""
    with open("/proc/self/statm", "rb") as file:
        return int(file.read().split()[1]) * _PAGE_BYTES


def cut(descriptor: int, number: int) -> bool:
    """Breaks the connection with the inode `number` off, which also throws away what it sent and nobody has
    read: after a shutdown that could still be read, up to 32 MB. Whether it was there."""
    try:
        copy = os.dup(descriptor)
    except OSError:
        return False
    try:
        return inode(copy) == number and _libc.connect(copy, _NOWHERE, len(_NOWHERE)) == 0
    finally:
        os.close(copy)
