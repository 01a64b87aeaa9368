"""Several rooms in one world."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[2] / "tools" / "experiments" / "simulate_scale.py"


@pytest.mark.slow
def test_separate_rooms_are_separate_maps(tmp_path: Path) -> None:
    kept = tmp_path / "rows.json"
    only = ["--agents", "--rooms-of", "2x2", "--seeds", "401:402", "--workers", "1", "--json", str(kept)]
    done = subprocess.run([sys.executable, str(TOOL), *only], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    rows = json.loads(kept.read_text())
    assert [row["policy"] for row in rows] == ["covins-g", "share"]
    assert all(row["maps"] == 2 and len(row["agents"]) == 4 for row in rows)
    assert all(0 < row["solving"] < row["busy"] < 1 and row["passed_over"] == 0 for row in rows)
    assert len(done.stdout.splitlines()) == 4


def test_invalid_size_is_refused() -> None:
    done = subprocess.run([sys.executable, str(TOOL), "--rooms-of", "10"], capture_output=True, text=True)
    assert done.returncode == 2
    assert "'10': expected ROOMSxAGENTS" in done.stderr
