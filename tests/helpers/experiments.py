"""Modules of tools/experiments, which are scripts beside each other and not a package."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

EXPERIMENTS = Path(__file__).resolve().parents[2] / "tools" / "experiments"


def experiment(name: str) -> Any:
    """Return the module, with its folder on the path as when a script there is run."""
    if str(EXPERIMENTS) not in sys.path:
        sys.path.insert(0, str(EXPERIMENTS))
    return importlib.import_module(name)
