"""A CurveZMQ client made by hand (RFC 26) on top of `raw_zmtp`: it has a key that the edge lets in, and then
says what libzmq never would. The cryptography is that of the libsodium that comes with pyzmq."""

from __future__ import annotations

import ctypes
import secrets
import struct
from pathlib import Path

import pytest
import zmq
from helpers.raw_zmtp import MORE, RawPeer, frame, greeting, metadata
from zmq.utils import z85

from share.net.keys import AgentKeys

_KEY, _MAC = 32, 16


def _sodium() -> ctypes.CDLL:
    folder = Path(zmq.__file__).parent.parent / "pyzmq.libs"
    found = sorted(folder.glob("libsodium*"))
    if not found:
        pytest.skip("this pyzmq comes without a libsodium of its own")
    return ctypes.CDLL(str(found[0]))


class CurvePeer(RawPeer):
    """One that has shaken hands as `keys.own`, with the routing id `identity`. Raises OSError where it is not
    let in."""

    def __init__(self, endpoint: str, identity: bytes, keys: AgentKeys, timeout_s: float = 5.0) -> None:
        super().__init__(endpoint, timeout_s)
        self._lib = _sodium()
        self._count = 0
        try:
            self._shake_hands(identity, keys)
        except OSError:
            self.close()
            raise

    def sealed(self, body: bytes, more: bool = False) -> bytes:
        """A part of a message as it goes over the wire."""
        plain = bytes([MORE if more else 0]) + body
        nonce = self._short_nonce()
        box = self._box_now(b"CurveZMQMESSAGEC" + nonce, plain)
        return frame(b"\x07MESSAGE" + nonce + box)

    def sealed_message(self, *parts: bytes) -> bytes:
        return b"".join(self.sealed(part, more=at < len(parts)) for at, part in enumerate(parts, 1))

    def _shake_hands(self, identity: bytes, keys: AgentKeys) -> None:
        server, secret, public = (z85.decode(key) for key in (keys.edge, keys.own.secret, keys.own.public))
        own_public, own_secret = self._new_pair()
        self.socket.sendall(greeting(b"CURVE"))
        self.hear(64)
        nonce = self._short_nonce()
        signature = self._box(b"CurveZMQHELLO---" + nonce, bytes(64), server, own_secret)
        self.socket.sendall(
            frame(b"\x05HELLO\x01\x00" + bytes(72) + own_public + nonce + signature, command=True)
        )
        welcome = self.hear(2 + 8 + 16 + 144)[2 + 8 :]
        opened = self._open(b"WELCOME-" + welcome[:16], welcome[16:160], server, own_secret)
        server_now, cookie = opened[:_KEY], opened[_KEY:]
        nonce, long_nonce = self._short_nonce(), secrets.token_bytes(16)
        vouch = self._box(b"VOUCH---" + long_nonce, own_public + server, server_now, secret)
        self._shared = self._precomputed(server_now, own_secret)
        initiate = public + long_nonce + vouch + metadata(identity)
        box = self._box_now(b"CurveZMQINITIATE" + nonce, initiate)
        self.socket.sendall(frame(b"\x08INITIATE" + cookie + nonce + box, command=True))
        self.hear(2 + 6 + 8 + _MAC)  # READY

    def _short_nonce(self) -> bytes:
        self._count += 1
        return struct.pack(">Q", self._count)

    def _new_pair(self) -> tuple[bytes, bytes]:
        public, secret = ctypes.create_string_buffer(_KEY), ctypes.create_string_buffer(_KEY)
        self._lib.crypto_box_keypair(public, secret)
        return public.raw, secret.raw

    def _precomputed(self, public: bytes, secret: bytes) -> bytes:
        shared = ctypes.create_string_buffer(_KEY)
        if self._lib.crypto_box_beforenm(shared, public, secret):
            raise ValueError("not a public key")
        return shared.raw

    def _box(self, nonce: bytes, plain: bytes, public: bytes, secret: bytes) -> bytes:
        return self._box_with(nonce, plain, self._precomputed(public, secret))

    def _box_now(self, nonce: bytes, plain: bytes) -> bytes:
        return self._box_with(nonce, plain, self._shared)

    def _box_with(self, nonce: bytes, plain: bytes, shared: bytes) -> bytes:
        box = ctypes.create_string_buffer(len(plain) + _MAC)
        self._lib.crypto_box_easy_afternm(box, plain, ctypes.c_ulonglong(len(plain)), nonce, shared)
        return box.raw

    def _open(self, nonce: bytes, box: bytes, public: bytes, secret: bytes) -> bytes:
        plain = ctypes.create_string_buffer(len(box) - _MAC)
        shared = self._precomputed(public, secret)
        if self._lib.crypto_box_open_easy_afternm(plain, box, ctypes.c_ulonglong(len(box)), nonce, shared):
            raise ValueError("the box does not open")
        return plain.raw
