"""A wearer's session: by its secret a page comes back without a code, for twelve hours, to the edge that let
it in.

The secret says whose it is and when it ends, under a signature (HMAC, RFC 2104) that only this machine can
make, so a server that has started again knows it too. The end is told by a clock that nobody sets, that of
the machine's running; only after a start of the machine by the wall clock.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac

import msgspec

from share.headset.pairing import PairingError

SESSION_S = 12 * 3600.0
_SIGNATURE_BYTES = 16
_MAX_LENGTH = 2048  # characters of a secret


class SessionOverError(PairingError):
    """A session is good no more; its page forgets it."""


class SessionMoment(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A moment by two clocks. boot: tells one running of the machine from another; empty: not known. up_s:
    since its start, sleep included. wall_s: of the wall clock, which may be set meanwhile."""

    boot: str
    up_s: float
    wall_s: float

    def after(self, seconds: float) -> SessionMoment:
        return SessionMoment(self.boot, self.up_s + seconds, self.wall_s + seconds)

    def seconds_to(self, later: SessionMoment) -> float:
        if self.boot and self.boot == later.boot:
            return later.up_s - self.up_s
        return later.wall_s - self.wall_s


class WearerSession(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Whose a session is. agent: whose device sits on the headset; None: none's. edge: where its page is
    served. number: rises with each session of a wearer there. nonce: tells it from all others."""

    name: str
    agent: str | None
    edge: str
    number: int
    end: SessionMoment
    nonce: str

    def is_over(self, now: SessionMoment) -> bool:
        """Return whether it has ended, or says that it would end later than any can."""
        return not 0 < now.seconds_to(self.end) <= SESSION_S


_decoder = msgspec.json.Decoder(WearerSession)


def seal(key: bytes, session: WearerSession) -> str:
    """Return the session as its holder's secret."""
    payload = msgspec.json.encode(session)
    return base64.urlsafe_b64encode(_signature(key, payload) + payload).decode()


def unseal(key: bytes, secret: str, edge: str, now: SessionMoment) -> WearerSession:
    """Return the session of a secret, if it is good at an edge. Raises SessionOverError."""
    unknown = SessionOverError("this session is not known here; pair again with the code of the edge")
    if len(secret) > _MAX_LENGTH:
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
    if session.edge != edge:
        raise unknown
    check_end(session, now)
    return session


def check_end(session: WearerSession, now: SessionMoment) -> None:
    """Raises SessionOverError."""
    if session.is_over(now):
        raise SessionOverError("this session is over; pair again with the code of the edge")


def _signature(key: bytes, payload: bytes) -> bytes:
    return hmac.digest(key, b"share headset session " + payload, hashlib.sha256)[:_SIGNATURE_BYTES]
