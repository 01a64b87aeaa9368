"""Files appear complete or not at all; unwritable paths are found beforehand."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.special_files import special

from share.errors import ShareError, UsageError
from share.files.line_file import LineFile
from share.files.writing import atomic_write, check_replaceable, check_writable, new_file, writable_dir


def test_atomic_write_replaces_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "report.json"
    atomic_write(path, "old")
    atomic_write(path, b"new")
    assert path.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["report.json"]
    assert path.stat().st_mode & 0o777 == 0o666 & ~current_umask()


def current_umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


@pytest.mark.long
def test_a_reader_never_sees_a_half_written_file(tmp_path):
    """Another process writes as fast as it can; every read is one of its two texts."""
    path = tmp_path / "x"
    code = (
        "import sys; from pathlib import Path; from share.files.writing import atomic_write\n"
        "for i in range(60): atomic_write(Path(sys.argv[1]), 'ab'[i % 2] * 200_000)"
    )
    writer = subprocess.Popen([sys.executable, "-c", code, str(path)])
    seen = set()
    while writer.poll() is None:
        if path.exists():
            text = path.read_text()
            assert len(text) == 200_000
            seen |= set(text)
    assert writer.returncode == 0
    assert seen <= {"a", "b"}
    assert seen


def test_unwritable_paths_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="is a folder"):
        check_writable(tmp_path)
    with pytest.raises(UsageError, match="file"):
        check_writable(tmp_path / "file" / "below" / "x.tum")
    with pytest.raises(UsageError, match="cannot be written"):
        writable_dir(Path("/proc/share-cannot-be-here"))
    with pytest.raises(UsageError, match="cannot be written"):
        atomic_write(tmp_path / "no" / "such" / "x", "text")
    assert check_writable(tmp_path / "new" / "x.tum") == tmp_path / "new" / "x.tum"


@pytest.mark.parametrize("kind", ["pipe", "socket"])
def test_special_files_are_not_written_as_output(tmp_path, kind):
    """Opening a pipe waits for a reader forever; a slow reader delays the writer."""
    path, said = tmp_path / "events.jsonl", []
    special(path, kind)
    with reading(path) if kind == "pipe" else contextlib.nullcontext():
        for refuses in (
            lambda: check_replaceable(path),
            lambda: atomic_write(path, "text"),
            lambda: writable_dir(tmp_path, "edge.json", path.name),
            lambda: new_file(path).__enter__(),
        ):
            with pytest.raises(UsageError, match=f"is a {kind}, where a file is to be written; remove it"):
                refuses()
        file = LineFile(path, said.append)
        file.write("line")
        file.close()
    why = f"it is a {kind}, not a file; remove it"
    assert said == [f"{path}: cannot be written: {why}; the run goes on without it"]
    assert os.listdir(tmp_path) == [path.name]
    assert not path.is_file()


@contextlib.contextmanager
def reading(path: Path) -> Iterator[int]:
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    yield handle
    os.close(handle)


def test_a_named_pipe_needs_a_reader(tmp_path):
    os.mkfifo(path := tmp_path / "poses")
    with pytest.raises(UsageError, match="poses: is a pipe without a reader; give the name of a file"):
        check_writable(path)
    special(socket := tmp_path / "socket", "socket")
    with pytest.raises(UsageError, match="socket: is a socket; give the name of a file"):
        check_writable(socket)


def test_a_pipe_stays_open_until_it_is_written(tmp_path):
    os.mkfifo(path := tmp_path / "poses")
    with reading(path) as handle:
        assert check_writable(path) == path
        with pytest.raises(BlockingIOError):  # b"" would be the end
            os.read(handle, 100)
        atomic_write(path, "some")
        assert os.read(handle, 100) == b"some"
    with pytest.raises(ShareError, match="poses: cannot be written: Broken pipe"):
        atomic_write(path, "more")
    assert path.is_fifo()
