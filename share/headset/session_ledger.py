"""Which session of each wearer is the newest at an edge, kept beside the key that signs them: one that a
newer pairing ended stays so when the server starts again.

Edges of one user share the file, as they share the key; each session is of one edge. Two that have one
address, as in two containers with one home, know of each other's sessions by it.
"""

from __future__ import annotations

import contextlib
import secrets
import time
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import msgspec

from share.errors import ShareError, UsageError
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


class LedgerDamagedError(UsageError):
    """What the file says of sessions is not known."""


class SessionLedger:
    """The newest session of each wearer of an edge. edge: where its page is served. folder: None: in memory
    alone. Raises LedgerDamagedError."""

    def __init__(self, edge: str, folder: Path | None = None) -> None:
        self.edge, self._folder = edge, folder
        self._newest: dict[_Wearer, WearerSession] = {}
        self._state = self._file_state()
        self._take(self._read())

    def is_newest(self, session: WearerSession) -> bool:
        """Return whether none of the wearer is known that was issued later."""
        self._look()
        newest = self._newest.get(_wearer(session))
        return newest is None or newest.nonce == session.nonce or session.number > newest.number

    def new_session(self, name: str, agent: str | None, now: SessionMoment) -> WearerSession:
        """Return a session that is issued now, after all of the wearer."""
        self._look()
        newest = self._newest.get((self.edge, name))
        by_clock = round(now.wall_s * 1000)  # later than one of a ledger that was lost
        number = by_clock if newest is None else max(newest.number + 1, by_clock)
        return WearerSession(name, agent, self.edge, number, now.after(SESSION_S), secrets.token_urlsafe(12))

    def note(self, session: WearerSession) -> None:
        """Make a session the newest of its wearer, on disk too. Raises ShareError, with what comes of it, if
        that fails; it is noted all the same."""
        known = self._newest.get(_wearer(session))
        if known is not None and known.nonce == session.nonce:
            return
        self._take([session])
        if self._folder is None:
            return
        try:
            with folder_locked(self._folder, _LOCK_S):
                self._take(self._read())
                kept = sorted(self._newest.values(), key=lambda one: one.number)[-_MAX_KNOWN:]
                self._newest = {_wearer(one): one for one in kept}
                write_private(self._folder / LEDGER_FILE, msgspec.json.encode(kept), replaces=True)
                self._state = self._file_state()
        except LedgerDamagedError as error:
            raise ShareError(f"{error}; as it is, the page cannot start again") from None
        except FileNotFoundError:
            raise ShareError(
                f"{self._folder}: is gone, with what the page needs at its next start; start the edge again, "
                "and all wearers pair anew"
            ) from None
        except (ShareError, OSError) as error:
            is_busy = isinstance(error, BlockingIOError)
            why = f"{self._folder}: another process has locked it" if is_busy else error
            raise ShareError(
                f"{why}; after the page's next start an older session of '{session.name}' may be good again"
            ) from None

    def _take(self, sessions: Iterable[WearerSession]) -> None:
        """Know sessions: of each wearer the newest counts, whoever issued it."""
        for one in sessions:
            known = self._newest.get(_wearer(one))
            if known is None or (one.number, one.nonce) > (known.number, known.nonce):
                self._newest[_wearer(one)] = one

    def _look(self) -> None:
        """Read the file again if another edge has written it."""
        if (state := self._file_state()) != self._state:
            self._state = state
            with contextlib.suppress(LedgerDamagedError):  # what is known holds; `note` says it
                self._take(self._read())

    def _file_state(self) -> tuple[int, ...]:
        """Return what changes whenever the file is written."""
        if self._folder is None:
            return ()
        try:
            status = (self._folder / LEDGER_FILE).stat()
        except OSError:
            return ()
        return status.st_mtime_ns, status.st_size, status.st_ino

    def _read(self) -> list[WearerSession]:
        if self._folder is None or not (path := self._folder / LEDGER_FILE).exists():
            return []
        try:
            return _decoder.decode(read_bytes(path, MB))
        except (OSError, msgspec.DecodeError, ValueError, RecursionError):
            raise LedgerDamagedError(
                f"{path}: cannot be read, or is damaged; remove it and headset.secret beside it, and all "
                "wearers pair anew when the page starts"
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
