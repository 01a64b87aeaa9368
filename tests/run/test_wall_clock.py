"""A real agent and its edge while the wall clock is set by an hour: poses stay the same to the digit."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
from helpers.children import start_agent, start_edge
from helpers.preloaded import WallClock, with_environment


@pytest.mark.slow
def test_setting_the_wall_clock_changes_no_pose(tmp_path: Path, plain_session: Path) -> None:
    clock = WallClock(tmp_path)
    patch = with_environment(clock.env)
    edge, address = start_edge(tmp_path)
    ann = start_agent(tmp_path, "ann", plain_session / "ar1", address)
    patch.undo()
    edge.wait_for("agent joined")
    for off_s in (3600, -3600, 0):
        time.sleep(0.7)
        clock.set(off_s)
    assert ann.wait(60) == 0
    assert edge.said.count("silent") == 0
    bob = start_agent(tmp_path, "bob", plain_session / "ar1", address)  # with a clock that nobody sets
    assert bob.wait(60) == 0
    assert edge.interrupt() == 0
    odometry = [(tmp_path / name / "odom.tum").read_bytes() for name in ("ann", "bob")]
    assert odometry[0] == odometry[1]
    report = json.loads((tmp_path / "ann" / "report.json").read_text())
    assert (report["frames"], report["protocol"]["pending"], report["lost_s"]) == (45, 0, 0)
    assert abs(report["clock"]["offset_ms"]) < 1000
    t_s = [json.loads(line)["t_s"] for line in (tmp_path / "edge" / "events.jsonl").read_text().splitlines()]
    assert t_s == sorted(t_s)
    assert t_s[-1] < 300
