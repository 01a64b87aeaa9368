"""docs/start/first-room.md, word by word: half an hour, most of it in real time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent


@pytest.mark.slow
def test_everything_that_is_typed_works(tmp_path: Path) -> None:
    pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed", exc_type=ImportError)
    paths = os.pathsep.join(map(str, (HERE.parent, HERE.parents[1])))
    done = subprocess.run(
        [sys.executable, str(HERE / "follow.py"), "--at", str(tmp_path)],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=3600,
    )
    assert done.returncode == 0, done.stderr
    laptop = tmp_path / "laptop"
    aligned = json.loads((laptop / "room1" / "align.json").read_text())
    assert set(aligned) == {"ann", "turtle"}
    assert (laptop / "compared" / "report.html").stat().st_size > 10_000
    assert (laptop / "room").is_dir()
