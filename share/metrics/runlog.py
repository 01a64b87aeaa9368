"""What happened to every frame of one agent's run, and the report that comes of it."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from share.metrics.latency import latency
from share.types import TrackState, Wait

CSV_HEADER = "stamp_ns,track_ms,corrected_ms,state,keyframe,sent"


@dataclass
class FrameRow:
    """One line of latency.csv. corrected_ms is NaN until a correction based on this frame arrives."""

    stamp_ns: int
    track_ms: float
    state: TrackState
    keyframe: bool
    sent: bool = False
    corrected_ms: float = math.nan

    def csv(self) -> str:
        corrected = "" if math.isnan(self.corrected_ms) else f"{self.corrected_ms:.3f}"
        return (
            f"{self.stamp_ns},{self.track_ms:.3f},{corrected},{self.state},"
            f"{int(self.keyframe)},{int(self.sent)}"
        )


@dataclass
class RunLog:
    """Rows in order of their stamps once read; marks come later, by the frame's stamp."""

    _rows: list[FrameRow] = field(default_factory=list)
    cpu_s: float = 0.0  # process CPU time of the tracking pipeline
    decode_s: float = 0.0  # CPU time of image decoding
    contradicted: int = 0  # frames in which images and IMU told of different motions
    waited: Counter[Wait] = field(default_factory=Counter)  # frames, by what was still waited for
    stretches: int = 0  # of unbroken odometry; poses of different ones do not compare
    _by_stamp: dict[int, FrameRow] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def rows(self) -> list[FrameRow]:
        """In order of time, which is not the order in which their fate was known."""
        return sorted(self._rows, key=lambda row: row.stamp_ns)

    def add(
        self, stamp_ns: int, track_ms: float, state: TrackState, keyframe: bool, sent: bool = False
    ) -> None:
        row = FrameRow(stamp_ns, track_ms, state, keyframe, sent)
        self._rows.append(row)
        self._by_stamp[stamp_ns] = row

    def add_result(self, new_stretch: bool, sound: bool, waits: Wait | None) -> None:
        """Of a frame: whether odometry broke before it, whether images and IMU agree, and what is still
        waited for; None: nothing."""
        self.stretches += new_stretch
        self.contradicted += not sound
        if waits is not None:
            self.waited[waits] += 1

    def add_decode(self, cpu_s: float) -> None:
        self.decode_s += cpu_s

    def mark_corrected(self, stamp_ns: int, corrected_ms: float) -> None:
        self._by_stamp[stamp_ns].corrected_ms = corrected_ms

    def csv(self) -> str:
        """The whole of latency.csv."""
        return "\n".join([CSV_HEADER, *(row.csv() for row in self.rows)]) + "\n"

    def report(self) -> dict[str, Any]:
        """The fields of report.json that come from frames alone (docs/architecture.md)."""
        rows = self.rows
        frames = len(rows)
        parts = latency([r.track_ms for r in rows], [r.corrected_ms for r in rows])
        sent = sum(r.sent for r in rows)
        span_s = (rows[-1].stamp_ns - rows[0].stamp_ns) * 1e-9 if frames > 1 else 0.0
        return {
            "frames": frames,
            "tracked": sum(r.state.has_pose for r in rows),
            "keyframes": sum(r.keyframe for r in rows),
            "sent": sent,
            "lost_s": _lost_s(rows),
            "stretches": self.stretches,
            "contradicted": self.contradicted,
            "track_ms": parts.track_ms.report(),
            "corrected_ms": parts.corrected_ms.report(),
            "latency_ms": parts.latency_ms.report(),
            "over_20ms": None if math.isnan(parts.over_20ms) else parts.over_20ms,
            "cpu_ms_per_frame": 1e3 * self.cpu_s / frames if frames else None,
            "decode_ms_per_frame": 1e3 * self.decode_s / frames if frames else None,
            "rate_hz": sent / span_s if span_s else None,
            "init_s": _init_s(rows),
            "waited": {str(wait): frames for wait, frames in self.waited.items()},
        }


def _lost_s(rows: list[FrameRow]) -> float:
    """Time from each LOST frame to the next frame."""
    stamps = np.array([r.stamp_ns for r in rows], np.int64)
    lost = np.array([r.state is TrackState.LOST for r in rows], bool)
    return float((np.diff(stamps) * lost[:-1]).sum() * 1e-9) if len(rows) > 1 else 0.0


def _init_s(rows: list[FrameRow]) -> float | None:
    """From the first frame to the first with a pose; None if there was none."""
    first = next((r.stamp_ns for r in rows if r.state.has_pose), None)
    return None if first is None else (first - rows[0].stamp_ns) * 1e-9
