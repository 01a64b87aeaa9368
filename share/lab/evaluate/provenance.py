"""Which machine and which code made something, to record beside measurements."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import share
from share.devices.host import core_count

# Modules by package; a frozen program has no metadata of packages.
_LIBRARIES = {"numpy": "numpy", "opencv-python-headless": "cv2", "pyzmq": "zmq", "scipy": "scipy"}
_DIGEST_DIGITS = 10


def describe_machine() -> dict[str, Any]:
    """Return plain data. load: mean number of runnable processes over the last minute."""
    return {
        "cpu": _cpu_name() or platform.processor() or platform.machine(),
        "cores": core_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: import_module(module).__version__ for name, module in _LIBRARIES.items()},
        "load": round(os.getloadavg()[0], 2),
    }


def busy_text(load: float, cores: int, run: str) -> str:
    """Return a line where other programs kept the machine busy before `run`; "" where they did not."""
    if load <= 0.5 * cores:
        return ""
    return f"other programs kept this machine busy (load {load:g} on {cores} cores before {run})"


def _cpu_name() -> str | None:
    """Return the CPU's model name from /proc/cpuinfo, None if absent."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), None)


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
