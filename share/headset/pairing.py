"""Who may use the headset page: a code of eight digits lets one wearer in; by a signed session it comes back.

The code is shown to the operator alone. It changes once it has been used, or after some wrong ones. A session
says whose it is and when it ends, under a signature (HMAC, RFC 2104) that only this machine can make, so a
server that has started again knows it too. Times and randomness are passed in.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
from collections.abc import Callable
from dataclasses import dataclass

import msgspec

from share.timing import TokenBucket, TokenBuckets

CODE_DIGITS = 8
MAX_WRONG = 1000  # codes given, after which a new one is shown: fewer would let a stranger change it at will
SESSION_S = 12 * 3600.0
_ADDRESS_LIMIT = (3.0, 0.1)  # codes at once, and a second, of an address
_LIMIT = (20.0, 2.0)  # of all together, which twenty addresses use up: a guess hits with 0.007 % in an hour
_MAX_ADDRESSES = 1024
_SIGNATURE_BYTES = 16
_MAX_SESSION_LENGTH = 1024  # characters


class PairingError(Exception):
    """A wearer is not let in; the text is for it."""


class SessionOverError(PairingError):
    """A session is good no more; its page forgets it."""


class WearerSession(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Whose a session is. agent: whose device sits on the headset; None: none's. end_s: wall clock. nonce:
    tells it from other sessions of this wearer."""

    name: str
    agent: str | None
    end_s: float
    nonce: str


_decoder = msgspec.json.Decoder(WearerSession)


def seal(key: bytes, session: WearerSession) -> str:
    """Return the session as its holder's secret."""
    payload = msgspec.json.encode(session)
    return base64.urlsafe_b64encode(_signature(key, payload) + payload).decode()


def unseal(key: bytes, secret: str, now_s: float) -> WearerSession:
    """Return the session of a secret. now_s: wall clock. Raises SessionOverError."""
    unknown = SessionOverError("this session is not known here; pair again with the code of the edge")
    if len(secret) > _MAX_SESSION_LENGTH:
        raise unknown
    try:
        data = base64.b64decode(secret, altchars=b"-_", validate=True)
    except (binascii.Error, ValueError):
        raise unknown from None
    signature, payload = data[:_SIGNATURE_BYTES], data[_SIGNATURE_BYTES:]
    if not hmac.compare_digest(signature, _signature(key, payload)):
        raise unknown
    try:
        session = _decoder.decode(payload)
    except msgspec.DecodeError:  # of another release
        raise unknown from None
    if not now_s < session.end_s <= now_s + 2 * SESSION_S:
        raise SessionOverError("this session is over; pair again with the code of the edge")
    return session


def _signature(key: bytes, payload: bytes) -> bytes:
    return hmac.digest(key, b"share headset session " + payload, hashlib.sha256)[:_SIGNATURE_BYTES]


@dataclass
class PairingDesk:
    """Checks codes. draw: returns a random integer below its argument."""

    draw: Callable[[int], int]

    def __post_init__(self) -> None:
        self.code, self.wrong_count = "", 0
        self._wrong_of_code = 0
        self._of_all, self._of_address = TokenBucket(*_LIMIT), TokenBuckets(*_ADDRESS_LIMIT)
        self.renew()

    def renew(self) -> None:
        """Show another code."""
        old = self.code
        while self.code == old:
            self.code = f"{self.draw(10**CODE_DIGITS):0{CODE_DIGITS}d}"
        self._wrong_of_code = 0

    def check(self, given: str, address: str, now_ns: int) -> None:
        """Check a code from an address. Raises PairingError. Whoever is let in by it renews it."""
        is_crowded = self._of_address.count_used(now_ns) >= _MAX_ADDRESSES
        if is_crowded or not self._of_address.bucket(address, now_ns).take(now_ns):
            raise PairingError("too many codes from this address; wait ten seconds")
        if not self._of_all.take(now_ns):
            raise PairingError("too many codes were tried; wait some seconds")
        if hmac.compare_digest(given.encode(), self.code.encode()):
            return
        self.wrong_count += 1
        self._wrong_of_code += 1
        if self._wrong_of_code >= MAX_WRONG:
            self.renew()
        raise PairingError("this is not the code that the edge shows")
