"""Keys that an edge lends a process of its own, so that it can be a client under each name that the edge's
list has: one key for a name, made of one secret that both know, in memory only.

What such a key may do is what the list lets the name do, as it says now; so each client has its own rights.
"""

from __future__ import annotations

import hashlib

from share.net.keys import KeyPair


class LentKeys:
    """secret: 32 random bytes."""

    def __init__(self, secret: bytes) -> None:
        self._secret = secret

    def pair(self, name: str) -> KeyPair:
        """Return the pair of a name (BLAKE2, keyed; RFC 7693)."""
        import zmq
        from zmq.utils import z85

        drawn = hashlib.blake2b(name.encode(), digest_size=32, key=self._secret).digest()
        secret = z85.encode(drawn).decode()
        return KeyPair(name, zmq.curve_public(secret.encode()).decode(), secret)
