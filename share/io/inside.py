"""Paths that a file tells of: they stay in that file's folder."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from share.errors import DataError

_LONGEST = 1000  # bytes of a path, 255 of a name: what file systems take


def inside(folder: Path, name: str, where: str) -> Path:
    """The file that `where` calls `name`, below `folder`. Raises DataError for a name that leads out of it.

    Links in the folder are followed: who made the folder may keep the images on another disk.
    """
    parts = PurePosixPath(name).parts
    leads_out = name.startswith("/") or ".." in parts or "\0" in name or not parts
    if leads_out or len(name.encode()) > _LONGEST or max(len(part.encode()) for part in parts) > 255:
        raise DataError(f"{where}: '{name:.80}' is no name of a file below {folder}")
    return folder / name
