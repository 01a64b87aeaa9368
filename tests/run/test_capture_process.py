"""`share capture` as a process on a simulated camera: ended by Ctrl-C, by time, by a power failure."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from share.recordings.mcap.recorder import recover_recording
from share.runtime.source import open_source

pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed", exc_type=ImportError)

CHILD = Path(__file__).with_name("capture_child.py")
ENV = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, CHILD.parents[1:3]))}  # tests, and the checkout


@contextmanager
def capturing(out: Path, *more: str, slow: bool = False) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, str(CHILD), str(out), *more]
    env = ENV | ({"CHILD_SLOW_DISK_S": "0.2"} if slow else {})
    child = subprocess.Popen(command, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        yield child
    finally:
        child.kill()
        child.communicate()


def grown(part: Path, size: int) -> None:
    """Waits until the file has `size` bytes."""
    end = time.monotonic() + 20
    while not part.exists() or part.stat().st_size < size:
        assert time.monotonic() < end, "nothing is recorded"
        time.sleep(0.05)


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_completes_the_file(tmp_path: Path, number: int) -> None:
    out = tmp_path / "a.mcap"
    with capturing(out, "--json") as child:
        grown(tmp_path / "a.mcap.part", 10_000_000)
        child.send_signal(number)
        reported, complaints = child.communicate(timeout=20)
    assert (child.returncode, complaints) == (0, "")
    report = json.loads(reported)
    assert report["end_reason"] == "stopped"
    assert len(open_source(str(out)).stamps()["cam0"]) == report["streams"]["cam0"]["samples"] > 10
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.long
def test_a_terminal_that_is_closed_costs_nothing_of_the_recording(tmp_path: Path) -> None:
    ours, terminal = pty.openpty()
    child = subprocess.Popen(
        [sys.executable, str(CHILD), str(tmp_path / "a.mcap")],
        env=ENV, stdin=terminal, stdout=terminal, stderr=terminal, start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )  # fmt: skip
    try:
        os.close(terminal)
        grown(tmp_path / "a.mcap.part", 10_000_000)
        os.close(ours)
        assert child.wait(timeout=20) == 1  # the table had no reader
    finally:
        child.kill()
        child.wait()
    assert len(open_source(str(tmp_path / "a.mcap")).stamps()["cam0"]) > 10
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.long
def test_a_second_ctrl_c_names_the_command_that_saves_the_file(tmp_path: Path) -> None:
    part = tmp_path / "a.mcap.part"
    with capturing(tmp_path / "a.mcap", slow=True) as child:
        grown(part, 3_000_000)
        child.send_signal(signal.SIGINT)
        time.sleep(0.3)
        child.send_signal(signal.SIGINT)
        reported, complaints = child.communicate(timeout=20)
    assert (child.returncode, reported) == (130, "")
    assert complaints.splitlines() == [
        f"share: {part}: is not closed; `share dataset recover {part} --out {tmp_path / 'a.mcap'}` "
        "saves its contents",
        "share: interrupted",
    ]
    recover_recording(part, tmp_path / "b.mcap")
    assert len(open_source(str(tmp_path / "b.mcap")).stamps()["cam0"]) > 2


@pytest.mark.long
def test_a_recording_cut_off_by_a_power_failure_is_recovered(tmp_path: Path) -> None:
    with capturing(tmp_path / "a.mcap"):
        grown(tmp_path / "a.mcap.part", 20_000_000)
    recover_recording(tmp_path / "a.mcap.part", tmp_path / "b.mcap")
    stamps = open_source(str(tmp_path / "b.mcap")).stamps()
    assert len(stamps["cam0"]) > 25
    np.testing.assert_array_equal(np.diff(stamps["cam0"]), np.full(len(stamps["cam0"]) - 1, 33_333_000))


@pytest.mark.long
def test_it_ends_when_the_time_is_over_and_prints_a_table(tmp_path: Path) -> None:
    with capturing(tmp_path / "a.mcap", "--seconds", "1") as child:
        reported, complaints = child.communicate(timeout=30)
    assert complaints == ""
    assert reported.splitlines()[0].split()[:3] == ["stream", "samples", "seconds"]
    assert reported.splitlines()[-1] == f"{tmp_path / 'a.mcap'} (time is over)"
