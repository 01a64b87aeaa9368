"""The work folder of a session, so that a session of a given name is always complete.

.NAME.partial/DIGEST/    room, brightness, chunks of frames: reused by the next attempt
.NAME.partial/session/   made again in each attempt, and renamed at the end
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import TracebackType

from share.errors import ShareError, UsageError
from share.files.writing import lock_folder, sync_folder


class PartialSession:
    """Work folder of the session `out`, with an exclusive lock as a context manager. Work of other digests is
    removed. After an error drawn frames are kept, and the error says so."""

    def __init__(self, out: Path, digest: str) -> None:
        self.out = out
        self._folder = out.with_name(f".{out.name}.partial")
        self.work, self.session = self._folder / digest, self._folder / "session"

    @property
    def room(self) -> Path:
        """Return the folder of the finished room."""
        return self.work / "room"

    def frames(self, name: str) -> Path:
        """Return the folder of the chunks of agent `name`."""
        return self.work / "frames" / name

    def drawn_chunks(self) -> list[Path]:
        """Return all chunks drawn so far."""
        return sorted(self.work.glob("frames/*/*.chunk"))

    def check_new(self) -> None:
        """Raise UsageError where `out` exists or cannot be created."""
        if self.out.exists() or self.out.is_symlink():
            raise UsageError(f"{self.out}: exists already; give the name of a new folder")
        parent = next(folder for folder in self.out.absolute().parents if folder.exists())
        if not parent.is_dir():
            raise UsageError(f"{self.out}: its parent {parent} is a file; give another --out")

    def finish(self) -> None:
        """Give the session its name and remove the work folder."""
        shutil.rmtree(self.work)
        self.session.rename(self.out)
        sync_folder(self.out.parent)
        shutil.rmtree(self._folder)

    def __enter__(self) -> PartialSession:
        self._created_folders = _missing_parents(self._folder)
        self._handle = lock_folder(self._folder)
        self.check_new()  # another process may have finished it since
        for leftover in self._folder.iterdir():
            if leftover != self.work:
                shutil.rmtree(leftover)
        self.work.mkdir(exist_ok=True)
        (self.session / "truth").mkdir(parents=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if isinstance(error, ShareError) and self._folder.exists():
                self._keep_or_remove(error)
        finally:
            os.close(self._handle)

    def _keep_or_remove(self, error: ShareError) -> None:
        if self.drawn_chunks():
            raise type(error)(f"{error}; run the same command again to resume") from None
        shutil.rmtree(self._folder)
        for folder in self._created_folders:
            folder.rmdir()


def _missing_parents(folder: Path) -> list[Path]:
    """Return the parents that do not exist yet, innermost first."""
    return [parent for parent in folder.parents if not parent.exists()]
