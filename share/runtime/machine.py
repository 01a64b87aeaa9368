"""What this process may use of the machine: cores and memory."""

from __future__ import annotations

import os
from pathlib import Path


def core_count() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def free_memory_bytes(proc: Path = Path("/proc"), cgroups: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Return the memory that this process may still take: the machine's available memory, or less where a
    control group (container, systemd unit) has a limit. None if unknown."""
    candidates = [
        free
        for free in (_available_bytes(proc / "meminfo"), *_free_in_cgroups(proc, cgroups))
        if free is not None
    ]
    return min(candidates, default=None)


def _available_bytes(meminfo: Path) -> int | None:
    lines = meminfo.read_text().splitlines() if meminfo.exists() else []
    match = next((line for line in lines if line.startswith("MemAvailable:")), None)
    return None if match is None else 1024 * int(match.split()[1])


def _free_in_cgroups(proc: Path, cgroups: Path) -> list[int]:
    """Return the free bytes of this process's control group and its ancestors, of those with a limit."""
    cgroup_file = proc / "self" / "cgroup"
    lines = cgroup_file.read_text().splitlines() if cgroup_file.exists() else []
    out = []
    for line in lines:
        _, kinds, name = line.split(":", 2)
        if kinds == "":  # version 2
            root, limit, used = cgroups, "memory.max", "memory.current"
        elif "memory" in kinds.split(","):
            root, limit, used = cgroups / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes"
        else:
            continue
        folder = root / name.lstrip("/")
        while folder.is_relative_to(root):
            max_bytes, used_bytes = _read_int(folder / limit), _read_int(folder / used)
            if max_bytes is not None and used_bytes is not None:
                out.append(max(0, max_bytes - used_bytes))
            if folder == root:
                break
            folder = folder.parent
    return out


def _read_int(file: Path) -> int | None:
    """Return the number in `file`; None for "max" or a missing file."""
    try:
        text = file.read_text().strip()
    except OSError:
        return None
    return int(text) if text.isdecimal() else None
