"""A damaged map file: what is whole of it goes into a fresh one, and it is kept beside as FILE.damaged-1.

The fresh file is made first, under the name FILE.salvaged; then the damaged one with its log gives its
name up. A break in between leaves FILE.salvaged, and the next opening goes on from there.
"""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path

from share.io.files import fresh, sync_folder, writing
from share.io.map_store import connect, rows, schema
from share.io.map_store.connect import BROKEN
from share.io.map_store.rows import insert
from share.io.map_store.scan import Found, whole_rows, with_copies
from share.io.regular_file import open_regular
from share.io.sqlite_file import log_of

# What hangs on rows that are lost. A keyframe that its agent still has may come again under its number.
_ORPHANS = (
    "DELETE FROM keyframe WHERE run NOT IN (SELECT key FROM run)",
    "DELETE FROM link WHERE (run, id) NOT IN (SELECT run, id FROM keyframe)",
    "DELETE FROM loop WHERE (a_run, a_id) NOT IN (SELECT run, id FROM keyframe)"
    " OR (b_run, b_id) NOT IN (SELECT run, id FROM keyframe)",
)

# Stretches whose own row is lost.
_NAMELESS = (
    "SELECT DISTINCT run, stretch FROM keyframe"
    " WHERE (run, stretch) NOT IN (SELECT run, nth FROM stretch) ORDER BY number"
)


@contextlib.contextmanager
def copied(path: Path, folder: Path | None = None) -> Iterator[Path]:
    """A copy of `path` and its log for the time of the block, below `folder` or where temporary files are."""
    with tempfile.TemporaryDirectory(prefix=".map.", dir=folder) as name:
        copy = Path(name) / path.name
        with writing(Path(name)):
            for old, new in ((path, copy), (log_of(path), log_of(copy))):
                if old == path or old.exists():
                    with open_regular(old) as source, fresh(new) as sink:
                        shutil.copyfileobj(source, sink)
        yield copy


def whole_of(path: Path, folder: Path | None = None) -> Found:
    """What is whole of a damaged file, read from a copy; with a first page of our own, if that finds more.

    The first page says where tables begin. It is the same in all maps, but for counters.
    """
    with copied(path, folder) as copy:
        as_it_is = _found(copy)
        log_of(copy).unlink(missing_ok=True)
        with writing(copy), copy.open("r+b") as file:
            file.write(schema.first_page())
        return max(as_it_is, _found(copy), key=Found.size)


def salvage(path: Path) -> tuple[Found, Path]:
    """Replace `path` by what is whole of it. Also answers the damaged file's new name. Raises ShareError."""
    found = with_copies(whole_of(path, path.parent))
    part = path.with_name(path.name + ".salvaged.part")
    part.unlink(missing_ok=True)
    with connect.complaints(part, "written"), writing(part):
        _write(found, part)
        part.replace(_finished(path))
    return found, finish(path)


def finish(path: Path) -> Path:
    """The last steps, each of which may be done already; `path` itself if there is nothing to finish."""
    if not _finished(path).exists():
        return path
    with writing(path):
        kept = set_aside(path)
        _finished(path).replace(path)
    sync_folder(path.parent)
    return kept


def set_aside(path: Path) -> Path:
    """A map that nobody has open, and its log, get another name, which is answered. Raises ShareError."""
    kept = _free_name(path)
    with writing(path):
        for old, new in ((log_of(path), log_of(kept)), (path, kept)):
            if old.exists():
                old.replace(new)
        path.with_name(path.name + "-shm").unlink(missing_ok=True)
    return kept


def _finished(path: Path) -> Path:
    return path.with_name(path.name + ".salvaged")


def _free_name(path: Path) -> Path:
    number = 1
    while (name := path.with_name(f"{path.name}.damaged-{number}")).exists():
        number += 1
    return name


def _found(copy: Path) -> Found:
    bare = sqlite3.connect(copy, isolation_level=None)
    with contextlib.closing(connect.for_so_long(bare, copy)) as connection:
        with contextlib.suppress(*BROKEN):  # moves the log into the file, as far as that is whole
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        return whole_rows(connection)


def _write(found: Found, part: Path) -> None:
    with contextlib.closing(sqlite3.connect(part, isolation_level=None)) as connection:
        connection.execute(f"PRAGMA page_size = {schema.PAGE_BYTES}")
        connection.execute("BEGIN")
        schema.create(connection)
        for table, numbered in found.tables.items():
            for number, row in numbered:
                if table != "about":
                    insert(connection, table, row, number)
        own = {run for _, (run, *_) in found.tables["run"]}
        for run, voice in rows.voices(found.tables["about"]).items():
            if run in own:
                insert(connection, "about", rows.of_voice(run, voice))
        for statement in _ORPHANS:
            connection.execute(statement)
        for stretch in connection.execute(_NAMELESS).fetchall():
            insert(connection, "stretch", stretch)
        connection.execute("COMMIT")
