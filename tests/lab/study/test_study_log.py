"""The log of a study on disks that fill up and in power cuts: no line but the last is lost."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path
from typing import Any

import pytest
from helpers.study_folder import begin, goal_events, small_plan

from share.errors import ShareError
from share.files.json_file import read_json_lines
from share.lab.study.study_log import StudyLog
from share.lab.study.trials import read_trials, trial_folder

PLAN, _ = small_plan()
P01 = PLAN.participants[0].name
LINES = [begin(PLAN, P01, 1), *goal_events(1, 1, 8.0, 10.0)]


def written(path: Path, lines: list[dict[str, Any]]) -> None:
    log = StudyLog(path)
    for line in lines:
        log.append(line)
    log.close()


def test_a_power_cut_at_any_byte_costs_the_last_line_at_most(tmp_path: Path) -> None:
    path = trial_folder(tmp_path, P01, 1) / "events.jsonl"
    written(path, LINES)
    data = path.read_bytes()
    second = {"event": "interrupted", "t_s": 20.0, "reason": "power"}
    for cut in range(1, len(data) + 1):
        path.write_bytes(data[:cut])
        whole = data[:cut].count(b"\n")
        log = StudyLog(path)
        log.append(second if whole else LINES[0])
        log.close()
        assert log.was_torn == (not data[:cut].endswith(b"\n"))
        assert read_json_lines(path) == [*LINES[:whole], second if whole else LINES[0]]
        read_trials(tmp_path, PLAN)


def test_a_line_longer_than_a_block_is_found_torn(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    path.write_bytes(b'{"a": 1}\n' + b"x" * 200_000)
    written(path, [{"b": 2}])
    assert path.read_text() == '{"a": 1}\n{"b": 2}\n'


@pytest.mark.parametrize("taken", [0, 7])
def test_a_full_disk_leaves_no_half_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, taken: int) -> None:
    path = tmp_path / "a.jsonl"
    log = StudyLog(path)
    log.append({"a": 1})
    real, calls = os.write, []

    def write(handle: int, data: bytes) -> int:
        calls.append(data)
        if len(calls) == 1 and taken:
            return real(handle, data[:taken])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", write)
        with pytest.raises(ShareError, match=r"a\.jsonl: cannot be written: No space left"):
            log.append({"b": 2})
    assert path.read_text() == '{"a": 1}\n'
    log.append({"c": 3})
    assert path.read_text() == '{"a": 1}\n{"c": 3}\n'


def test_a_line_is_synced_before_append_returns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[bytes] = []
    real = os.fsync

    def fsync(handle: int) -> None:
        if os.path.isfile(f"/proc/self/fd/{handle}"):
            synced.append(Path(f"/proc/self/fd/{handle}").read_bytes())
        real(handle)

    monkeypatch.setattr(os, "fsync", fsync)
    log = StudyLog(tmp_path / "new" / "a.jsonl")
    for k in range(3):
        log.append({"k": k})
        assert [json.loads(line)["k"] for line in synced[-1].splitlines()] == list(range(k + 1))


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "target").write_text("")
    (tmp_path / "a.jsonl").symlink_to(tmp_path / "target")
    with pytest.raises(ShareError, match="cannot be written"):
        StudyLog(tmp_path / "a.jsonl").append({"a": 1})
    assert (tmp_path / "target").read_text() == ""
