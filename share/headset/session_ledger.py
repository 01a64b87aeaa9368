"""Which session of each wearer is the newest at an edge, kept beside the key that signs them: one that a
newer pairing ended stays so when the server starts again.

Edges of one user on one machine share the file, as they share the key; each session is of one edge.
"""

from __future__ import annotations

import secrets
import time
from functools import cache
from pathlib import Path

import msgspec

from share.errors import UsageError
from share.files.locks import folder_locked
from share.files.reading import MB, read_bytes
from share.files.writing import write_private
from share.headset.wearer_session import SESSION_S, SessionMoment, WearerSession

LEDGER_FILE = "headset.sessions"
_MAX_KNOWN = 1024  # wearers of all edges; the others are those that paired longest ago
_LOCK_S = 0.2  # all pages of the server wait meanwhile
_BOOT_FILE = Path("/proc/sys/kernel/random/boot_id")
_decoder = msgspec.json.Decoder(list[WearerSession])
_Wearer = tuple[str, str]  # edge and name


class SessionLedger:
    """The newest session of each wearer of an edge. edge: where its page is served. folder: None: in memory
    alone. Raises UsageError if the file is damaged."""

    def __init__(self, edge: str, folder: Path | None = None) -> None:
        self.edge, self._folder = edge, folder
        self._newest = self._read()

    def is_newest(self, session: WearerSession) -> bool:
        """Return whether none of the wearer is known that was issued later."""
        newest = self._newest.get(_wearer(session))
        return newest is None or newest.nonce == session.nonce or session.number > newest.number

    def new_session(self, name: str, agent: str | None, now: SessionMoment) -> WearerSession:
        """Return a session that is issued now, after all of the wearer."""
        newest = self._newest.get((self.edge, name))
        by_clock = round(now.wall_s * 1000)  # later than one of a ledger that was lost
        number = by_clock if newest is None else max(newest.number + 1, by_clock)
        return WearerSession(name, agent, self.edge, number, now.after(SESSION_S), secrets.token_urlsafe(12))

    def note(self, session: WearerSession) -> None:
        """Make a session the newest of its wearer, on disk too. Raises ShareError or OSError if that fails;
        it is noted all the same."""
        known = self._newest.get(_wearer(session))
        if known is not None and known.nonce == session.nonce:
            return
        self._newest[_wearer(session)] = session
        if self._folder is None:
            return
        with folder_locked(self._folder, _LOCK_S):
            of_others = {key: one for key, one in self._read().items() if key[0] != self.edge}
            own = {key: one for key, one in self._newest.items() if key[0] == self.edge}
            kept = sorted((of_others | own).values(), key=lambda one: one.number)[-_MAX_KNOWN:]
            self._newest = {_wearer(one): one for one in kept}
            write_private(self._folder / LEDGER_FILE, msgspec.json.encode(kept), replaces=True)

    def _read(self) -> dict[_Wearer, WearerSession]:
        if self._folder is None or not (path := self._folder / LEDGER_FILE).exists():
            return {}
        try:
            return {_wearer(one): one for one in _decoder.decode(read_bytes(path, MB))}
        except (OSError, msgspec.DecodeError, ValueError, RecursionError):
            raise UsageError(
                f"{path}: cannot be read, or is damaged; remove it and headset.secret beside it, and all "
                "wearers pair anew"
            ) from None


def moment_now() -> SessionMoment:
    """Return the moment by this machine's clocks."""
    return SessionMoment(_boot(), time.clock_gettime(time.CLOCK_BOOTTIME), time.time())


@cache
def _boot() -> str:
    try:
        return read_bytes(_BOOT_FILE, 100).decode("ascii", "replace").strip()
    except OSError:  # a sandbox without it: by the wall clock alone
        return ""


def _wearer(session: WearerSession) -> _Wearer:
    return session.edge, session.name
