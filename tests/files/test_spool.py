"""Lines that a run writes and reads again at its end."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from share.errors import ShareError
from share.files.line_file import Spool
from share.metrics.frame_log import RunLog
from share.runtime.run_files import AgentFiles
from share.types import TrackState

LINES = [f"line {k}, {'é' * (k % 50)}" for k in range(30_000)]  # more than is read at once


@pytest.mark.parametrize("in_a_folder", [True, False])
def test_all_lines_come_back_in_order_while_it_is_open(in_a_folder: bool, tmp_path: Path) -> None:
    spool = Spool(tmp_path / "x.partial" if in_a_folder else None, print)
    assert list(spool.read()) == []
    for line in LINES:
        spool.write(line)
    assert list(spool.read()) == LINES
    spool.write("another")
    assert list(spool.read())[-1] == "another"
    spool.close()


def test_a_spool_without_a_name_leaves_no_file_and_no_handle() -> None:
    before = os.listdir("/proc/self/fd")
    there = set(os.listdir("/var/tmp"))
    spool = Spool(None, print)
    spool.write("one")
    assert set(os.listdir("/var/tmp")) <= there
    spool.close()
    assert len(os.listdir("/proc/self/fd")) == len(before)


def test_a_removed_file_is_still_read(tmp_path: Path) -> None:
    spool = Spool(tmp_path / "x.partial", print)
    spool.write("one")
    (tmp_path / "x.partial").unlink()
    spool.write("two")
    assert list(spool.read()) == ["one", "two"]
    spool.close()


def test_a_truncated_file_is_reported(tmp_path: Path) -> None:
    spool = Spool(tmp_path / "x.partial", print)
    spool.write("one")
    os.truncate(tmp_path / "x.partial", 2)
    with pytest.raises(ShareError, match="was truncated by another process"):
        list(spool.read())
    spool.close()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_reported_once() -> None:
    said: list[str] = []
    spool = Spool(Path("/dev/full"), said.append)
    log = RunLog(spool)
    for k in range(100):
        log.add(k, 1.0, TrackState.OK, False)
    assert said == ["/dev/full: cannot be written: No space left on device; the run goes on without it"]
    assert len(log) == 100
    with pytest.raises(ShareError, match="/dev/full: is not complete: No space left on device"):
        spool.check()
    spool.close()


def test_latencies_stay_readable_after_a_kill(tmp_path: Path) -> None:
    killed = AgentFiles(tmp_path, print)
    RunLog(killed.frame_lines).add(7, 1.5, TrackState.OK, True, True)
    lines = (tmp_path / "latency.csv.partial").read_text().splitlines()
    assert lines == ["stamp_ns,track_ms,corrected_ms,state,keyframe,sent", "7,1.5,nan,OK,1,1"]
    killed.release()

    files = AgentFiles(tmp_path, print)
    assert not (tmp_path / "latency.csv.partial").exists()
    log = RunLog(files.frame_lines)
    log.add(9, 2.5, TrackState.LOST, False)
    files.finish(log, log.report())
    files.release()
    assert (tmp_path / "latency.csv").read_text().splitlines()[1:] == ["9,2.500,,LOST,0,0"]
    assert sorted(os.listdir(tmp_path)) == ["latency.csv", "map.tum", "odom.tum", "report.json"]


def test_a_run_without_a_folder_leaves_nothing() -> None:
    files = AgentFiles(None, print)
    log = RunLog(files.frame_lines)
    log.add(9, 2.5, TrackState.OK, False)
    files.finish(log, log.report())
    assert log.report()["frames"] == 1
    files.release()
