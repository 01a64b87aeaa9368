"""Files appear whole or not at all; what cannot be written is found out first."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from share.errors import UsageError
from share.io.files import atomic_write, check_writable, writable_dir


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


def test_a_reader_never_sees_half(tmp_path):
    """Another process writes as fast as it can; every read is one of its two texts, whole."""
    path = tmp_path / "x"
    code = (
        "import sys; from pathlib import Path; from share.io.files import atomic_write\n"
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


def test_paths_that_cannot_be_written(tmp_path):
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
