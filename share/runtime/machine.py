"""Facts of this machine and this code, to record beside measurements: CPU, libraries, memory, code digest."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import share

_LIBRARIES = ("numpy", "opencv-python-headless", "pyzmq", "scipy")
_DIGEST_DIGITS = 10


def describe_machine() -> dict[str, Any]:
    """Return plain data. load: mean number of runnable processes over the last minute."""
    return {
        "cpu": _cpu_name() or platform.processor() or platform.machine(),
        "cores": core_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: version(name) for name in _LIBRARIES},
        "load": round(os.getloadavg()[0], 2),
    }


def core_count() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def _cpu_name() -> str | None:
    """Return the CPU's model name from /proc/cpuinfo, None if absent."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), None)


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


@cache
def code_digest() -> str:
    """Return a hexadecimal digest of SHARE's sources, or of the frozen program: the version number does not
    change with each change of the code."""
    frozen = getattr(sys, "frozen", False)
    folder = Path(share.__file__).parent
    files = [Path(sys.executable)] if frozen else sorted(folder.rglob("*.py"))
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.name.encode() if frozen else path.relative_to(folder).as_posix().encode())
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:_DIGEST_DIGITS]
