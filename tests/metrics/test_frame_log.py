"""The report of a run's frames, which take no memory while the run lasts."""

from __future__ import annotations

import itertools
import json
import math
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from share.errors import DataError
from share.files.line_file import Spool
from share.metrics.frame_log import MemoryLineStore, RunLog, latency
from share.types import TrackState, WaitReason

STATES = list(TrackState)


class Rows:
    """A list of every frame, as plainly as can be: what `RunLog` has to agree with to the last byte."""

    def __init__(self) -> None:
        self.rows: list[list[Any]] = []
        self.by_stamp: dict[int, list[Any]] = {}

    def add(self, stamp_ns: int, track_ms: float, state: TrackState, keyframe: bool, sent: bool) -> None:
        row = [stamp_ns, track_ms, math.nan, state, keyframe, sent]
        self.rows.append(row)
        self.by_stamp[stamp_ns] = row

    def add_correction(self, stamp_ns: int, corrected_ms: float) -> None:
        self.by_stamp[stamp_ns][2] = corrected_ms

    def csv(self) -> str:
        lines = ["stamp_ns,track_ms,corrected_ms,state,keyframe,sent"]
        for stamp, track, corrected, state, keyframe, sent in sorted(self.rows, key=lambda row: row[0]):
            reported = "" if math.isnan(corrected) else f"{corrected:.3f}"
            lines.append(f"{stamp},{track:.3f},{reported},{state},{int(keyframe)},{int(sent)}")
        return "\n".join(lines) + "\n"

    def report(self) -> dict[str, Any]:
        rows = sorted(self.rows, key=lambda row: row[0])
        parts = latency([row[1] for row in rows], [row[2] for row in rows])
        poses = [row[0] for row in rows if row[3].has_pose]
        later = itertools.pairwise(rows)
        lost_ns = sum(after[0] - row[0] for row, after in later if row[3] is TrackState.LOST)
        span_s = (rows[-1][0] - rows[0][0]) * 1e-9 if len(rows) > 1 else 0.0
        sent = sum(row[5] for row in rows)
        return {
            "frames": len(rows),
            "tracked": len(poses),
            "states": {str(state): sum(row[3] is state for row in rows) for state in TrackState},
            "keyframes": sum(row[4] for row in rows),
            "sent": sent,
            "lost_s": lost_ns * 1e-9,
            "track_ms": parts.track_ms.report(),
            "corrected_ms": parts.corrected_ms.report(),
            "latency_ms": parts.latency_ms.report(),
            "over_20ms": None if math.isnan(parts.over_20ms) else parts.over_20ms,
            "rate_hz": sent / span_s if span_s else None,
            "init_s": (poses[0] - rows[0][0]) * 1e-9 if poses else None,
        }


def drive(logs: list[Any], n: int, seed: int) -> None:
    """Frames out of order, some of one stamp; corrections of frames of late, some of them twice."""
    draw, stamps = np.random.default_rng(seed), []
    for k in range(n):
        stamp = 1_700_000_000_000_000_000 + k * 33_333_333 + int(draw.integers(-40_000_000, 40_000_000))
        stamps.append(stamps[-1] if stamps and draw.random() < 0.02 else stamp)
        state, track_ms = STATES[draw.integers(len(STATES))], float(draw.gamma(3, 5))
        keyframe, sent = draw.random() < 0.3, draw.random() < 0.2
        late = stamps[-1 - int(draw.integers(min(len(stamps), 50)))], float(draw.gamma(3, 30))
        corrected = draw.random() < 0.2
        for log in logs:
            log.add(stamps[-1], track_ms, state, bool(keyframe), bool(sent))
            if corrected:
                log.add_correction(*late)


@pytest.mark.parametrize("n", [0, 1, 2, 3, 20, 3000])
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("in_a_folder", [True, False])
def test_report_equals_that_of_all_rows(n: int, seed: int, in_a_folder: bool, tmp_path: Path) -> None:
    spool = Spool(tmp_path / "latency.csv.partial" if in_a_folder else None, print)
    rows, spooled, in_memory = Rows(), RunLog(spool), RunLog()
    drive([rows, spooled, in_memory], n, seed)
    assert len(spooled) == n
    for log in (spooled, in_memory):
        reported = log.report()
        assert json.dumps({key: reported[key] for key in rows.report()}) == json.dumps(rows.report())
        assert "".join(log.csv_chunks()) == rows.csv()
    spool.close()


def test_counts_beside_the_rows_are_reported() -> None:
    log = RunLog()
    log.add(5, 2.0, TrackState.OK, False)
    log.cpu_s = 0.5
    log.add_decode_time(0.25)
    for waits in (WaitReason.IMU, WaitReason.IMU, None):
        log.add_result(waits is None, waits is not None, waits)
    reported = log.report()
    assert (reported["cpu_ms_per_frame"], reported["decode_ms_per_frame"]) == (500.0, 250.0)
    assert (reported["segments"], reported["inconsistent_frames"], reported["waiting_frames"]) == (
        1,
        1,
        {"imu": 2},
    )


def test_memory_does_not_grow_with_frames(tmp_path: Path) -> None:
    """Rows that were kept took 0.3 kB a frame: tens of MB an hour."""
    spool = Spool(tmp_path / "latency.csv.partial", print)
    log = RunLog(spool)
    log.add(0, 1.0, TrackState.OK, False)
    tracemalloc.start()
    for k in range(1, 5000):
        log.add(k, k / 7, TrackState.OK, True, True)
        log.add_correction(k, k / 3)
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 50_000
    assert (len(log), len(log.frames())) == (5000, 5000)
    spool.close()


def test_changed_line_is_refused() -> None:
    lines = MemoryLineStore()
    log = RunLog(lines)
    log.add(5, 2.0, TrackState.OK, False)
    lines.write("5,what,,OK,0,0")
    with pytest.raises(DataError, match="the log of this run's frames was changed during the run"):
        log.report()
