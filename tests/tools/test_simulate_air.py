"""Policies on shared air."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
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


@pytest.mark.slow
def test_an_agent_alone_on_its_air_waits_for_nobody(tmp_path: Path) -> None:
    delays_ms = {}
    for options in ([], ["--alone"]):
        kept = tmp_path / f"rows{len(options)}.json"
        only = ["--agents", "6", "--air", "shared-2.5", "--seeds", "401:402", "--seconds", "20"]
        command = [sys.executable, str(TOOL), *only, "--policies", "constant@1:0.5", "--json", str(kept)]
        done = subprocess.run([*command, *options], capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stderr
        agents = json.loads(kept.read_text())[0]["agents"]
        assert {hz for agent in agents.values() for hz in agent["rate_hz"]} == {1.0, 0.5}
        delays_ms[len(options)] = [
            np.mean(np.subtract(agent["delay_ms"], agent["answer_ms"])) for agent in agents.values()
        ]
    assert np.mean(delays_ms[1]) < 0.8 * np.mean(delays_ms[0])


@pytest.mark.parametrize(
    ("policy", "expected"),
    [("shair", "expected one of share, share-paper"), ("constant@1", "expected constant@A:R")],
)
def test_an_unknown_policy_is_refused(policy: str, expected: str) -> None:
    command = [sys.executable, str(TOOL), "--policies", policy]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert f"--policies {policy}: {expected}" in done.stderr
