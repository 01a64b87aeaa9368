"""Effect of faults on the inertial tracker. Prints JSON, one fault of one agent a line, and a table.

    python tools/experiments/measure_faults.py [--seconds S] [--faults A,B] [--out FILE] SESSION/NAME ...

Each fault of `sensor_faults.py` on its own, on the first S seconds. `ate_cm`: causal poses, SE3
alignment, of the longest segment (`scored`: its share of all frames with a pose); `ratio`: to the clean run.
`states`: % of the frames. `lost_s`: as in report.json; `stretches`: `segments` there.
`wrong_ok`: % of all frames that are OK
although the position errs by more than 5 cm and more than three of its sigmas; aligned at the first pose of
the segment by yaw, or in full where the tracker has no gravity. `changed`: % of cam0's pixels that differ
from the recording's, in frames that differ. `cpu_ms`: median of a frame, keyframe included. The table is
written to FILE after each row.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from consistency import deviations  # noqa: E402
from sensor_faults import FAULTS, Fault, MeasurementFilter, apply_fault  # noqa: E402

from share.config import Config  # noqa: E402
from share.errors import ShareError, UsageError  # noqa: E402
from share.geometry.camera import Rig  # noqa: E402
from share.geometry.interpolation import interpolate  # noqa: E402
from share.metrics.ate import ate  # noqa: E402
from share.metrics.frame_log import RunLog  # noqa: E402
from share.odometry.inertial_tracker import InertialTracker  # noqa: E402
from share.odometry.track_result import TrackResult  # noqa: E402
from share.recordings.trajectory import Trajectory  # noqa: E402
from share.runtime.pipeline import read_frames  # noqa: E402
from share.runtime.source import Source, open_source  # noqa: E402
from share.sensors.measurement import Measurement  # noqa: E402
from share.sensors.sequencer import SequencerCounters  # noqa: E402
from share.types import Frame, TrackState  # noqa: E402

Row = dict[str, Any]
SIGMAS, FAR_M = 3.0, 0.05
HEAD = (
    "session",
    "fault",
    "ATE cm",
    "× clean",
    "worst cm",
    "states %",
    "lost s",
    "stretches (scored %)",
    "wrong OK %",
)


@dataclass(frozen=True, eq=False)
class Case:
    """A part of a recording with decoded frames and ground truth."""

    name: str
    source: Source
    frames: list[Frame]
    truth: Trajectory


@dataclass(frozen=True, eq=False)
class FaultRun:
    """The tracker's results for each frame."""

    frames: list[Frame]
    results: list[TrackResult]
    log: RunLog

    @property
    def trajectory(self) -> Trajectory:
        """Return the frames with a pose."""
        tracked = [(f.stamp_ns, r.T_odom_body) for f, r in zip(self.frames, self.results, strict=True)]
        there = [(stamp, T) for stamp, T in tracked if T is not None]
        stamps = np.array([stamp for stamp, _ in there], np.int64)
        return Trajectory(stamps, np.array([T for _, T in there]).reshape(-1, 4, 4))

    def stretches(self) -> list[FaultRun]:
        """Return the frames with a pose by unbroken segment, without segments of less than three."""
        number = np.cumsum([r.new_segment for r in self.results])
        has_pose = np.array([r.T_odom_body is not None for r in self.results])
        chosen = [np.flatnonzero(has_pose & (number == n)) for n in np.unique(number)]
        return [
            FaultRun([self.frames[k] for k in some], [self.results[k] for k in some], self.log)
            for some in chosen
            if len(some) >= 3
        ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("sessions", nargs="+", metavar="SESSION/NAME")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--faults", type=_faults, default=list(FAULTS), metavar="A,B")
    parser.add_argument("--out", type=Path, metavar="FILE")
    options = parser.parse_args()
    rows: list[Row] = []
    for name in options.sessions:
        for row in rows_of(case(name, options.seconds), options.faults):
            rows.append(row)
            print(json.dumps(row), flush=True)
            if options.out:
                options.out.write_text(table(rows))
    print("\n" + table(rows))


def case(name: str, seconds: float) -> Case:
    """Return the first seconds of a recording. Raises UsageError where it has no ground truth."""
    whole = open_source(name)
    source = open_source(name, frames=slice(0, round(seconds * whole.rate_hz)))
    truth = whole.truth()
    if truth is None:
        raise UsageError(f"{name}: has no ground truth")
    return Case(name, source, list(read_frames(source, Config(), SequencerCounters())), truth)


def rows_of(case: Case, faults: Sequence[str]) -> Iterator[Row]:
    """Yield a row a fault; the clean run is always first."""
    clean: float | None = None
    for name in dict.fromkeys(("clean", *faults)):
        row: Row = {"session": case.name, "fault": name} | measured(case, FAULTS[name])
        clean = row["ate_cm"] if name == "clean" else clean
        yield row | {"ratio": _ratio(row["ate_cm"], clean)}


def measured(case: Case, fault: Fault) -> Row:
    frames = faulty(case, fault)
    run = tracked(case.source.rig, frames)
    return scored(run, case.truth) | {"changed": changed(case.frames, frames)}


def faulty(case: Case, fault: Fault) -> list[Frame]:
    """Return the sequencer's output with the fault."""
    frames = case.frames
    if fault.change_measurements is not None:
        door = Door(case.source, fault.change_measurements)
        frames = list(read_frames(door, Config(), SequencerCounters()))
    return apply_fault(fault, frames, case.source.rig, case.truth)


def tracked(rig: Rig, frames: list[Frame]) -> FaultRun:
    """Run one tracker over all frames."""
    config, log, results = Config(), RunLog(), []
    tracker = InertialTracker(rig, config.inertial)
    for frame in frames:
        began = time.process_time()
        result = tracker.track(frame)
        if result.keyframe_ready:
            tracker.make_keyframe(frame)
            tracker.finish_keyframe()
        log.add(frame.stamp_ns, 1e3 * (time.process_time() - began), result.state, result.keyframe_ready)
        log.segments += result.new_segment
        results.append(result)
    return FaultRun(frames, results, log)


def scored(run: FaultRun, truth: Trajectory) -> Row:
    """Return the figures; errors are None in a run without a pose."""
    report, states = run.log.report(), Counter(str(r.state) for r in run.results)
    parts = run.stretches()
    longest = max(parts, key=lambda part: len(part.results), default=None)
    found = longest and ate(longest.trajectory, truth)
    wrong = sum(int(wrongly_ok(part, truth).sum()) for part in parts)
    return {
        "frames": len(run.frames),
        "ate_cm": found and round(100 * found.rmse, 2),
        "worst_cm": found and round(100 * found.max, 2),
        "states": {state: _percent(count, len(run.frames)) for state, count in states.items()},
        "init_s": report["init_s"] and round(report["init_s"], 2),
        "lost_s": round(report["lost_s"], 2),
        "stretches": report["segments"],
        "scored": _percent(len(longest.results), report["tracked"]) if longest else 0.0,
        "wrong_ok": _percent(wrong, len(run.frames)),
        "cpu_ms": round(report["track_ms"]["p50"], 1),
    }


def wrongly_ok(part: FaultRun, truth: Trajectory) -> np.ndarray:
    """Return which frames (N,) of a segment with ground truth are OK although they are wrong."""
    estimate = part.trajectory
    known, true = interpolate(*truth, estimate.stamps_ns)
    results = [r for r, k in zip(part.results, known, strict=True) if k]
    if not results:
        return np.zeros(0, bool)
    T, cov = estimate.T[known], np.array([r.cov for r in results])
    found = deviations(T, cov, true, np.zeros(len(T), np.int64))
    error, C = found.errors[:, 3:], found.cov[:, 3:, 3:]
    distance = np.linalg.norm(error, axis=1)
    way = error / distance.clip(1e-9)[:, None]
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", way, C, way))
    ok = np.array([r.state is TrackState.OK for r in results])
    return np.asarray(ok & (distance > FAR_M) & (distance > SIGMAS * sigma))


def changed(clean: list[Frame], frames: list[Frame]) -> float:
    """Return % of cam0's pixels that differ, over frames with the same stamp that differ; 0 where none
    does."""
    before = {frame.stamp_ns: frame.image0 for frame in clean}
    shares = [
        float((before[f.stamp_ns] != f.image0).mean())
        for f in frames
        if f.stamp_ns in before and before[f.stamp_ns] is not f.image0
    ]
    shares = [share for share in shares if share > 0]
    return round(100 * float(np.mean(shares)), 1) if shares else 0.0


class Door(Source):
    """A source that changes measurements before the sequencer."""

    def __init__(self, source: Source, arriving: MeasurementFilter) -> None:
        self.name, self.rig, self.notes = source.name, source.rig, source.notes
        self._source, self._arriving = source, arriving

    def stamps(self) -> dict[str, Any]:
        return self._source.stamps()

    def measurements(self) -> Iterator[Measurement]:
        return iter(self._arriving(list(self._source.measurements())))

    def truth(self) -> Trajectory | None:
        return self._source.truth()


def table(rows: Sequence[Row]) -> str:
    """Return a Markdown table."""
    lines = [_cells(HEAD), "|" + "---|" * len(HEAD), *map(_line, rows)]
    return "\n".join(lines) + "\n"


def _line(row: Row) -> str:
    states = ", ".join(f"{state} {share:g}" for state, share in row["states"].items())
    fault = row["fault"] + (
        f" ({row['changed']:.0f} % of the view)" if row["fault"].startswith("mover") else ""
    )
    cells = (row["session"], fault, row["ate_cm"], row["ratio"], row["worst_cm"], states, row["lost_s"])
    scored = f"{row['stretches']} ({row['scored']:g})"
    return _cells((*cells, scored, row["wrong_ok"]))


def _cells(values: Sequence[Any]) -> str:
    return "| " + " | ".join(map(str, values)) + " |"


def _ratio(value: float | None, clean: float | None) -> float | None:
    return round(value / clean, 2) if value is not None and clean else None


def _percent(part: int, whole: int) -> float:
    return round(100 * part / whole, 1) if whole else 0.0


def _faults(text: str) -> list[str]:
    names = text.split(",")
    if unknown := [name for name in names if name not in FAULTS]:
        raise argparse.ArgumentTypeError(f"'{unknown[0]}' is not known; known: {', '.join(FAULTS)}")
    return names


if __name__ == "__main__":
    try:
        main()
    except ShareError as error:
        sys.exit(str(error))
