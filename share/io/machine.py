"""On which machine, and with which libraries, something was measured."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

_LIBRARIES = ("numpy", "opencv-python-headless", "pyzmq", "scipy")


def describe_machine() -> dict[str, Any]:
    """Plain data. load: how many processes wanted a core over the last minute."""
    return {
        "cpu": _cpu() or platform.processor() or platform.machine(),
        "cores": cores(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: version(name) for name in _LIBRARIES},
        "load": round(os.getloadavg()[0], 2),
    }


def cores() -> int:
    """That this process may run on."""
    return len(os.sched_getaffinity(0))


def _cpu() -> str | None:
    """Its name, as Linux gives it."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), None)
