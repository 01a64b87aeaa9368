"""`share doctor --acceptance` as a user starts it, with a camera of software in place of a device."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed", exc_type=ImportError)

CHILD = Path(__file__).with_name("live_child.py")
PYTHONPATH = os.pathsep.join(map(str, CHILD.parents[1:3]))  # tests, and the checkout


@pytest.mark.slow
def test_a_person_is_led_through_the_steps_and_gets_a_report(tmp_path: Path, plain_session: Path) -> None:
    words = (
        "doctor",
        "--acceptance",
        "--minutes",
        "0.3",
        "--mode",
        "640x480@15",
        "--out",
        tmp_path,
        "--json",
    )
    done = subprocess.run(
        [sys.executable, str(CHILD), str(plain_session / "ar1"), *map(str, words)],
        env={**os.environ, "PYTHONPATH": PYTHONPATH},
        capture_output=True,
        text=True,
        timeout=240,
    )
    steps = [line for line in done.stderr.splitlines() if " of 4, " in line]
    assert [line[:6] for line in steps] == ["1 of 4", "2 of 4", "3 of 4", "4 of 4"], done.stderr
    (report,) = tmp_path.glob("acceptance-*.json")
    assert f"report to send: {report}" in done.stderr
    written, printed = json.loads(report.read_text()), json.loads(done.stdout)
    assert written["findings"] == printed["findings"] and not printed["ok"]  # there is no USB here
    found = {one["name"]: one for one in printed["findings"]}
    for name in ("cam0 rate", "cam1 rate", "gyro rate", "accel rate", "samples lost", "device clock", "rest"):
        assert name in found
    for name in ("tracking", "loop", "pose latency", "processor", "memory", "heat"):
        assert name in found
    assert found["rest"]["state"] == "FAIL"  # it is carried about, or the time is too short
    assert found["rest"]["mend"]
    assert done.returncode == 1 and "share: doctor:" in done.stderr.splitlines()[-1]
    measured = written["measured"]
    assert measured["tracking"]["frames"] > 100 and len(measured["computer"]) >= 3
    assert written["serial"] and "jpeg" not in report.read_text()
