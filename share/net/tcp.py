"""What the kernel knows of a TCP connection that libzmq owns, and of this process (Linux).

The descriptor is libzmq's: it may close it, and the number may come to mean another connection, at any time.
So each is known by its cookie (SO_COOKIE, which no other socket ever has) as well, and is never closed here.

Calls that cannot wait keep the interpreter's lock: where another thread computes, to take it again may take
5 ms each time.
"""

from __future__ import annotations

import ctypes
import os
import socket
import struct
import termios
from collections.abc import Callable
from contextlib import closing

_INFO_BYTES = 136
_RECEIVED_OFFSET = 128  # tcpi_bytes_received in struct tcp_info, linux/tcp.h
_TRIES = 4
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_UNSPEC_ADDRESS = bytes(16)  # a sockaddr of AF_UNSPEC: connect(2) to it ends a TCP connection with a reset
_SO_ATTACH_FILTER, _SO_DETACH_FILTER, _SO_COOKIE = 26, 27, 57  # asm-generic/socket.h
_libc = ctypes.PyDLL(None)


class _Filter(ctypes.Structure):
    """struct sock_filter: an instruction of classic BPF, linux/filter.h."""

    _fields_ = (
        ("code", ctypes.c_ushort),
        ("jt", ctypes.c_ubyte),
        ("jf", ctypes.c_ubyte),
        ("k", ctypes.c_uint),
    )


class _Program(ctypes.Structure):
    """struct sock_fprog."""

    _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.POINTER(_Filter)))


# `ret #1`: of each segment one byte may pass, and its header always does. So connections are made and ended,
# but their data stay with the sender, who sends them again 0.2 s later, then 0.4, 0.8 ...
_HEADERS_ONLY = _Program(1, ctypes.pointer(_Filter(0x06, 0, 0, 1)))


def socket_cookie(descriptor: int) -> int | None:
    """None where it is no socket, or closed."""
    value = ctypes.c_uint64()
    size = ctypes.c_uint(8)
    status = _libc.getsockopt(
        descriptor, socket.SOL_SOCKET, _SO_COOKIE, ctypes.byref(value), ctypes.byref(size)
    )
    return None if status != 0 else value.value


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
    before = _bytes_received(descriptor)
    for _ in range(_TRIES):
        queued = ctypes.c_int()
        if _libc.ioctl(descriptor, ctypes.c_ulong(termios.FIONREAD), ctypes.byref(queued)) != 0:
            return None
        after = _bytes_received(descriptor)
        if before is None or after is None:
            return None
        if before == after:  # else some of what is queued came since
            return after - queued.value, True
        min_read, before = before - queued.value, after
    return min_read, False


def _bytes_received(descriptor: int) -> int | None:
    """Bytes that came so far."""
    info = ctypes.create_string_buffer(_INFO_BYTES)
    size = ctypes.c_uint(_INFO_BYTES)
    if _libc.getsockopt(descriptor, socket.IPPROTO_TCP, socket.TCP_INFO, info, ctypes.byref(size)) != 0:
        return None
    return int(struct.unpack_from("=Q", info, _RECEIVED_OFFSET)[0])


def resident_bytes() -> int:
    """Memory of this process that is really there."""
    with open("/proc/self/statm", "rb") as file:
        return int(file.read().split()[1]) * _PAGE_BYTES


def abort(descriptor: int, expected_cookie: int) -> bool:
    """Breaks the connection with the cookie `expected_cookie` off, which also throws away what it sent and
    nobody has
    read: after a shutdown that could still be read, up to 32 MB. Whether it was there."""
    return _with_copy(
        descriptor,
        expected_cookie,
        lambda copy: _libc.connect(copy, _UNSPEC_ADDRESS, len(_UNSPEC_ADDRESS)) == 0,
    )


def hold_input(descriptor: int, expected_cookie: int) -> bool:
    """Lets no data in any more by the socket with the cookie `expected_cookie`; where that listens, none by
    what is accepted from now on. Whether that could be done."""
    return _with_copy(
        descriptor, expected_cookie, lambda copy: _set_option(copy, _SO_ATTACH_FILTER, _HEADERS_ONLY)
    )


def release_input(descriptor: int, expected_cookie: int) -> bool:
    """Lets data in again. Whether they were held."""
    return _with_copy(
        descriptor, expected_cookie, lambda copy: _set_option(copy, _SO_DETACH_FILTER, ctypes.c_int())
    )


def _set_option(descriptor: int, option: int, value: ctypes.Structure | ctypes.c_int) -> bool:
    size = ctypes.sizeof(value)
    return bool(_libc.setsockopt(descriptor, socket.SOL_SOCKET, option, ctypes.byref(value), size) == 0)


def _with_copy(descriptor: int, expected_cookie: int, action: Callable[[int], bool]) -> bool:
    """What `action` says of a copy of the descriptor, which stays that socket's; False where it is
    another's."""
    copy = _libc.dup(descriptor)
    if copy < 0:
        return False
    try:
        return socket_cookie(copy) == expected_cookie and action(copy)
    finally:
        _libc.close(copy)
