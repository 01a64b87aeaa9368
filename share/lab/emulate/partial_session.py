"""Where a session grows until it is whole: nobody ever finds half of one under its name.

.NAME.partial/DIGEST/    room, brightness, chunks of frames: what a break leaves, the next attempt uses
.NAME.partial/session/   begun anew in each attempt, and renamed at the end
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import TracebackType

from share.errors import ShareError, UsageError
from share.files.writing import lock_folder, sync_folder


class PartialSession:
    """Of the session `out`. Context manager: inside, no other process writes there; work for another
    digest is gone. An error leaves what has been drawn, if anything has, and says so."""

    def __init__(self, out: Path, digest: str) -> None:
        self.out = out
        self._folder = out.with_name(f".{out.name}.partial")
        self.work, self.session = self._folder / digest, self._folder / "session"

    @property
    def room(self) -> Path:
        """Folder of the finished room."""
        return self.work / "room"

    def frames(self, name: str) -> Path:
        """Folder of the chunks of agent `name`."""
        return self.work / "frames" / name

    def drawn_chunks(self) -> list[Path]:
        """All chunks that are there."""
        return sorted(self.work.glob("frames/*/*.chunk"))

    def check_new(self) -> None:
        """Raises UsageError where there is something of that name, or there can be nothing."""
        if self.out.exists() or self.out.is_symlink():
            raise UsageError(f"{self.out}: exists already; give the name of a new folder")
        parent = next(folder for folder in self.out.absolute().parents if folder.exists())
        if not parent.is_dir():
            raise UsageError(f"{self.out}: lies below a file, {parent}; give another --out")

    def finish(self) -> None:
        """Give it its name."""
        shutil.rmtree(self.work)
        self.session.rename(self.out)
        sync_folder(self.out.parent)
        shutil.rmtree(self._folder)

    def __enter__(self) -> PartialSession:
        self._created_folders = _missing_parents(self._folder)
        self._handle = lock_folder(self._folder)
        self.check_new()  # another process may have finished it meanwhile
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
            raise type(error)(f"{error}; the same command goes on with what is drawn") from None
        shutil.rmtree(self._folder)
        for folder in self._created_folders:
            folder.rmdir()


def _missing_parents(folder: Path) -> list[Path]:
    """The folders above it that are yet to be made, innermost first."""
    return [parent for parent in folder.parents if not parent.exists()]
