"""Which state of SHARE's code made something: a version number stays while code changes."""

from __future__ import annotations

import hashlib
import sys
from functools import cache
from pathlib import Path

import share

_DIGITS = 10


@cache
def code_state() -> str:
    """Hexadecimal digits that differ where any of SHARE's sources do; of a frozen program, where it does."""
    frozen = getattr(sys, "frozen", False)
    folder = Path(share.__file__).parent
    files = [Path(sys.executable)] if frozen else sorted(folder.rglob("*.py"))
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.name.encode() if frozen else path.relative_to(folder).as_posix().encode())
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:_DIGITS]
