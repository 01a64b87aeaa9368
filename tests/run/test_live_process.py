"""`share track realsense` and `share agent realsense` as processes, ended by Ctrl-C."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from share.geometry.camera import ImuBias
from share.recordings.trajectory import read_tum
from share.runtime.imu_bias_store import SavedBias, save_bias

pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed", exc_type=ImportError)

CHILD = Path(__file__).with_name("live_child.py")
PYTHONPATH = os.pathsep.join(map(str, CHILD.parents[1:3]))  # tests, and the checkout
MODE = ("--mode", "640x480@15")


@contextmanager
def running(seen: Path, *arguments: object) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """The process, whose stderr is a terminal, and the end of that terminal that can be read."""
    here, there = pty.openpty()
    command = [sys.executable, str(CHILD), str(seen), *map(str, arguments)]
    env = {**os.environ, "PYTHONPATH": PYTHONPATH}
    child = subprocess.Popen(command, env=env, text=True, stdout=subprocess.PIPE, stderr=there)
    os.close(there)
    try:
        yield child, here
    finally:
        child.kill()
        child.communicate()
        os.close(here)


def shown(terminal: int) -> str:
    """What is written there until a rate is known, which takes a second."""
    text, end = "", time.monotonic() + 30
    while not re.search(r"cam0 [1-9]", text):
        assert time.monotonic() < end, text[-300:]
        text += os.read(terminal, 4096).decode()
    return text


def ended(child: subprocess.Popen[str], terminal: int) -> tuple[str, str]:
    """After Ctrl-C: stdout, and what the terminal shows after it."""
    child.send_signal(signal.SIGINT)
    reported, _ = child.communicate(timeout=40)
    text = ""
    try:
        while piece := os.read(terminal, 4096).decode():
            text += piece
    except OSError:  # nobody writes there any more
        pass
    return reported, text


@pytest.mark.long
def test_ctrl_c_ends_tracking_with_poses_and_a_report(tmp_path: Path, plain_session: Path) -> None:
    out, report = tmp_path / "a.tum", tmp_path / "a.json"
    line = ("track", "realsense:0123", *MODE, "--out", out, "--report", report)
    with running(plain_session / "ar1", *line) as (child, terminal):
        live = shown(terminal)
        reported, after = ended(child, terminal)
    assert child.returncode == 0, (child.returncode, after[-500:])
    assert re.search(r"\r\x1b\[K\d+ frames  tracking OK  camera OK  accel", live), live
    assert "camera: missing " in reported
    known = json.loads(report.read_text())
    assert known["camera"]["health"] == "OK"
    assert known["camera"]["streams"]["gyro"]["dropped"] == 0
    assert len(read_tum(out).stamps_ns) == known["tracked"] > 10
    assert (np.diff(read_tum(out).stamps_ns) > 0).all()


@pytest.mark.long
def test_ctrl_c_completes_the_files_of_an_agent(tmp_path: Path, plain_session: Path) -> None:
    who = ("agent", "realsense", *MODE, "--name", "ann", "--profile", "d435i-n100-headset")
    save_bias("0123", SavedBias(10**9 * int(time.time() - 60), ImuBias([0.0] * 3, [0.0] * 3, 1e-3, 1e-2)))
    with running(plain_session / "ar1", *who, "--edge", "tcp://127.0.0.1:9", "--out", tmp_path) as (child, t):
        live = shown(t)
        reported, after = ended(child, t)
    assert child.returncode == 1
    assert "no edge answered" in after
    assert re.search(r"\r\x1b\[K\d+ OK.* camera OK cam0 \d+ Hz dropped \d+  sent 0", live), live
    assert "camera: missing " in reported
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["camera"]["streams"]["accel"]["dropped"] == 0
    assert f"imu bias: from the run of {report['imu_bias']['learnt_at']}\n" in reported
    assert report["track_ms"]["p50"] > 0  # from the image's arrival
    assert len(read_tum(tmp_path / "odom.tum").stamps_ns) == report["tracked"] > 10
