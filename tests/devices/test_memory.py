"""Memory and disk space that this process may still take."""

import shutil
from pathlib import Path

import pytest

from share.devices.host import free_disk_bytes, free_memory_bytes

GB = 1_000_000_000


def machine(
    folder: Path, available: int | None, group: str = "", files: dict[str, str] | None = None
) -> int | None:
    proc, groups = folder / "proc", folder / "groups"
    (proc / "self").mkdir(parents=True)
    if available is not None:
        (proc / "meminfo").write_text(f"MemTotal: 1 kB\nMemAvailable:   {available // 1024} kB\n")
    (proc / "self" / "cgroup").write_text(group)
    for name, text in (files or {}).items():
        (groups / name).parent.mkdir(parents=True, exist_ok=True)
        (groups / name).write_text(text + "\n")
    return free_memory_bytes(proc, groups)


@pytest.mark.parametrize(
    ("group", "files", "free"),
    [
        ("", {}, 3 * GB),
        ("0::/\n", {"memory.max": "max", "memory.current": "5"}, 3 * GB),
        ("0::/\n", {"memory.max": str(GB), "memory.current": str(GB // 4)}, 3 * GB // 4),
        ("0::/a/b\n", {"a/memory.max": str(GB), "a/memory.current": "0", "a/b/memory.max": "max"}, GB),
        ("0::/a\n", {"a/memory.max": "5", "a/memory.current": "9"}, 0),
        (
            "4:cpu:/x\n3:memory:/d\n",
            {"memory/d/memory.limit_in_bytes": "7", "memory/d/memory.usage_in_bytes": "2"},
            5,
        ),
    ],
)
def test_the_smallest_limit_counts(tmp_path, group, files, free):
    assert machine(tmp_path, 3 * GB, group, files) == (free if free != 3 * GB else free // 1024 * 1024)


def test_free_memory_may_be_unknown(tmp_path):
    assert machine(tmp_path, None) is None


def test_free_memory_of_this_machine():
    assert free_memory_bytes() > 10_000_000


def test_free_disk_space_is_that_of_the_nearest_folder(tmp_path: Path) -> None:
    existing, free = free_disk_bytes(tmp_path / "not" / "yet")
    assert existing == tmp_path and free == pytest.approx(shutil.disk_usage(tmp_path).free, rel=0.2)
