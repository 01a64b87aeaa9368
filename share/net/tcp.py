"""Kernel state of TCP connections that libzmq owns, and of this process (Linux).

libzmq owns the descriptors: it may close one at any time, and the number may be reused for another
connection. So each is also identified by its cookie (SO_COOKIE, unique to a socket), and never closed here.

Calls that cannot block keep the interpreter's lock (PyDLL): while another thread computes, taking it again
may take 5 ms each time.
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


# `ret #1`: one byte of each segment passes, and headers always do. So connections open and close, but data
# stay with the sender, which resends them after 0.2, 0.4, 0.8 s ...
_HEADERS_ONLY = _Program(1, ctypes.pointer(_Filter(0x06, 0, 0, 1)))


def socket_cookie(descriptor: int) -> int | None:
    """Return the socket's cookie, None if the descriptor is closed or no socket."""
    value = ctypes.c_uint64()
    size = ctypes.c_uint(8)
    status = _libc.getsockopt(
        descriptor, socket.SOL_SOCKET, _SO_COOKIE, ctypes.byref(value), ctypes.byref(size)
    )
    return None if status != 0 else value.value


def addresses(descriptor: int) -> tuple[str, int] | None:
    """Return the peer's host and our port; None if not connected."""
    try:
        with closing(socket.socket(fileno=os.dup(descriptor))) as copy:
            return str(copy.getpeername()[0]), int(copy.getsockname()[1])
    except (OSError, IndexError, TypeError):  # a socket of another family
        return None


def bytes_read(descriptor: int) -> tuple[int, bool] | None:
    """Return how many bytes the application has read since the connection was made, and whether that is exact
    or a lower bound; None if closed."""
    before = _bytes_received(descriptor)
    for _ in range(_TRIES):
        queued = ctypes.c_int()
        if _libc.ioctl(descriptor, ctypes.c_ulong(termios.FIONREAD), ctypes.byref(queued)) != 0:
            return None
        after = _bytes_received(descriptor)
        if before is None or after is None:
            return None
        if before == after:  # else some queued bytes arrived meanwhile
            return after - queued.value, True
        min_read, before = before - queued.value, after
    return min_read, False


def _bytes_received(descriptor: int) -> int | None:
    """Return the bytes received so far."""
    info = ctypes.create_string_buffer(_INFO_BYTES)
    size = ctypes.c_uint(_INFO_BYTES)
    if _libc.getsockopt(descriptor, socket.IPPROTO_TCP, socket.TCP_INFO, info, ctypes.byref(size)) != 0:
        return None
    return int(struct.unpack_from("=Q", info, _RECEIVED_OFFSET)[0])


def resident_bytes(pid: int | None = None) -> int:
    """Return the resident memory of a process; None: of this one. Raises OSError where the system does not
    say."""
    with open(f"/proc/{pid or 'self'}/statm", "rb") as file:
        return int(file.read().split()[1]) * _PAGE_BYTES


def abort(descriptor: int, expected_cookie: int) -> bool:
    """Reset the connection with the cookie `expected_cookie`. Unlike a shutdown this also discards its unread
    data, up to 32 MB. Return whether it existed."""
    return _with_copy(
        descriptor,
        expected_cookie,
        lambda copy: _libc.connect(copy, _UNSPEC_ADDRESS, len(_UNSPEC_ADDRESS)) == 0,
    )


def hold_input(descriptor: int, expected_cookie: int) -> bool:
    """Hold back all data of the socket with the cookie `expected_cookie`; of a listening socket, those of all
    connections accepted from now on. Return whether that succeeded."""
    return _with_copy(
        descriptor, expected_cookie, lambda copy: _set_option(copy, _SO_ATTACH_FILTER, _HEADERS_ONLY)
    )


def release_input(descriptor: int, expected_cookie: int) -> bool:
    """Let data in again. Return whether they were held back."""
    return _with_copy(
        descriptor, expected_cookie, lambda copy: _set_option(copy, _SO_DETACH_FILTER, ctypes.c_int())
    )


def _set_option(descriptor: int, option: int, value: ctypes.Structure | ctypes.c_int) -> bool:
    size = ctypes.sizeof(value)
    return bool(_libc.setsockopt(descriptor, socket.SOL_SOCKET, option, ctypes.byref(value), size) == 0)


def _with_copy(descriptor: int, expected_cookie: int, action: Callable[[int], bool]) -> bool:
    """Return `action` of a duplicate of the descriptor, which keeps naming the same socket; False if the
    cookie differs."""
    copy = _libc.dup(descriptor)
    if copy < 0:
        return False
    try:
        return socket_cookie(copy) == expected_cookie and action(copy)
    finally:
        _libc.close(copy)
