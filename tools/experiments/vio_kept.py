"""Cache of a run's figures."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import share
from share.files.writing import atomic_write

_NOT_IN_A_RUN = ("cli", "emulate", "merge", "mocap", "wire")  # packages of share/ that a run does not use


def code_version() -> str:
    """Return a digest of all code that a run uses."""
    digest = hashlib.sha256()
    package = Path(share.__file__).parent
    files = [p for p in package.rglob("*.py") if p.relative_to(package).parts[0] not in _NOT_IN_A_RUN]
    for path in sorted(files) + sorted(Path(__file__).parent.glob("vio_run.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def kept(file: Path, made_by: dict[str, Any]) -> dict[str, Any] | None:
    """Return the file's figures if they were made by the same code and session, else None."""
    row: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    return row if {key: row.get(key) for key in made_by} == made_by else None


def keep(file: Path, row: dict[str, Any]) -> None:
    atomic_write(file, json.dumps(row, indent=2) + "\n")
