"""Which session of each wearer is the newest, kept beside the key that signs them: one that was ended by a
newer pairing stays so when the server starts again.

Edges of one user on one machine share it, as they share the key.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from share.errors import UsageError
from share.files.locks import folder_locked
from share.files.reading import MB, read_bytes
from share.files.writing import write_private
from share.headset.pairing import SESSION_S, WearerSession

LEDGER_FILE = "headset.sessions"
_MAX_KNOWN = 1024  # names
_LOCK_S = 0.2  # all pages of the server wait meanwhile
_decoder = msgspec.json.Decoder(dict[str, WearerSession])


class SessionLedger:
    """The newest session by name. folder: None: in memory alone. Raises UsageError if the file is damaged."""

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._newest = self._read()

    def is_newest(self, session: WearerSession) -> bool:
        """Return whether none of the name is known that was issued later. Of two the one that ends later was
        issued later."""
        newest = self._newest.get(session.name)
        return newest is None or newest.nonce == session.nonce or session.end_s > newest.end_s

    def end_of_new(self, name: str, now_s: float) -> float:
        """Return when a session ends that is issued now: after all of the name, even if the clock was put
        back."""
        newest = self._newest.get(name)
        end_s = now_s + SESSION_S
        return end_s if newest is None or newest.end_s < end_s else newest.end_s + 1e-3

    def note(self, session: WearerSession, now_s: float) -> None:
        """Make a session the newest of its name, on disk too. Raises ShareError or OSError if that fails; it
        is noted all the same."""
        known = self._newest.get(session.name)
        if known is not None and known.nonce == session.nonce:
            return
        self._newest[session.name] = session
        if self._folder is None:
            return
        with folder_locked(self._folder, _LOCK_S):
            for name, other in self._read().items():  # of another edge
                if other.end_s > self._newest.get(name, other).end_s or name not in self._newest:
                    self._newest[name] = other
            valid = [one for one in self._newest.values() if one.end_s > now_s]  # the others say so
            kept = sorted(valid, key=lambda one: one.end_s)[-_MAX_KNOWN:]
            self._newest = {one.name: one for one in kept}
            write_private(self._folder / LEDGER_FILE, msgspec.json.encode(self._newest), replaces=True)

    def _read(self) -> dict[str, WearerSession]:
        if self._folder is None or not (path := self._folder / LEDGER_FILE).exists():
            return {}
        try:
            return _decoder.decode(read_bytes(path, MB))
        except (OSError, msgspec.DecodeError, ValueError, RecursionError):
            raise UsageError(
                f"{path}: cannot be read, or is damaged; remove it and headset.secret beside it, and all "
                "wearers pair anew"
            ) from None
