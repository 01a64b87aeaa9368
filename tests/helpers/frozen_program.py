"""The frozen program of this checkout."""

from __future__ import annotations

import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = ROOT / "dist" / "share" / "share"
SOURCES = ["Makefile", "setup.cfg", "share/**/*.py", "tools/share.spec", "tools/frozen_entry.py"]
SOURCES += ["tools/slim.py", "tools/stub_library.py", "tools/left_out.py"]


def frozen_program() -> Path:
    """dist/share/share, built anew unless it is younger than what it is made of."""
    newest = max(path.stat().st_mtime for pattern in SOURCES for path in ROOT.glob(pattern))
    if not PROGRAM.exists() or PROGRAM.stat().st_mtime < newest:
        made = subprocess.run(["make", "freeze"], cwd=ROOT, capture_output=True, text=True, check=False)
        assert made.returncode == 0, made.stdout + made.stderr
    return PROGRAM
