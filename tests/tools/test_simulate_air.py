"""Policies on shared air."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[2] / "tools" / "experiments" / "simulate_air.py"


@pytest.mark.slow
def test_every_agent_is_sampled_from_its_first_keyframe_to_the_end(tmp_path: Path) -> None:
    kept = tmp_path / "rows.json"
    only = ["--agents", "3", "--air", "shared-8", "--seeds", "401:402", "--policies", "share", "fixed@0.5"]
    command = [sys.executable, str(TOOL), *only, "--halved", "20:40", "--json", str(kept)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    rows = json.loads(kept.read_text())
    assert [row["policy"] for row in rows] == ["share", "fixed@0.5"]
    for row in rows:
        assert set(row["agents"]) == {"ar0", "ar1", "robot2"} and 0 < row["busy"] < 1
        for agent in row["agents"].values():
            assert len(agent["qoe"]) > 110 and all(0 <= qoe <= 1 for qoe in agent["qoe"])
            assert agent["sent"] > 2
    assert set(rows[1]["agents"]["ar0"]["rate_hz"]) == {0.5}
    assert len(done.stdout.splitlines()) == 4


def test_an_unknown_policy_is_refused() -> None:
    command = [sys.executable, str(TOOL), "--policies", "shair"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert "--policies shair: expected one of share, share-paper" in done.stderr
