"""What happened to every frame of one agent's run, and the report that comes of it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

from share.metrics.frame_columns import CSV_HEADER, FrameColumns, line_of_correction, line_of_frame, read
from share.metrics.latency import latency
from share.types import TrackState, Wait


class Lines(Protocol):
    """Where the lines of a run go, and come from again."""

    def write(self, line: str) -> None:
        """One more, without its end."""

    def read(self) -> Iterable[str]:
        """All of them, in order."""


class InMemory:
    """For runs that end before that matters."""

    def __init__(self) -> None:
        self._lines: list[str] = []

    def write(self, line: str) -> None:
        self._lines.append(line)

    def read(self) -> Iterable[str]:
        return self._lines


@dataclass
class RunLog:
    """Frames as their fate becomes known; corrections come later, and name the frame by its stamp.

    Nothing of a frame is kept but its line in `lines`: a run of hours takes no more memory than one of
    seconds, until its report is made.
    """

    lines: Lines = field(default_factory=InMemory)
    cpu_s: float = 0.0  # process CPU time of the tracking pipeline
    decode_s: float = 0.0  # CPU time of image decoding
    contradicted: int = 0  # frames in which images and IMU told of different motions
    waited: Counter[Wait] = field(default_factory=Counter)  # frames, by what was still waited for
    stretches: int = 0  # of unbroken odometry; poses of different ones do not compare
    imu_doubted: int = 0  # samples of the IMU that the tracker did not believe
    _frames: int = 0
    _begun: bool = False  # the first line, the columns' names, is written

    def __len__(self) -> int:
        """How many frames."""
        return self._frames

    def add(
        self, stamp_ns: int, track_ms: float, state: TrackState, keyframe: bool, sent: bool = False
    ) -> None:
        self._write(line_of_frame(stamp_ns, track_ms, state, keyframe, sent))
        self._frames += 1

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
        """Of a frame that was added; a later mark of the same frame replaces this one."""
        self._write(line_of_correction(stamp_ns, corrected_ms))

    def _write(self, line: str) -> None:
        if not self._begun:
            self.lines.write(CSV_HEADER)
            self._begun = True
        self.lines.write(line)

    def frames(self) -> FrameColumns:
        """In order of time, which is not the order in which their fate was known."""
        return read(self.lines.read())

    def csv(self) -> Iterator[str]:
        """The whole of latency.csv, in parts."""
        return self.frames().csv()

    def report(self) -> dict[str, Any]:
        """The fields of report.json that come from frames alone (docs/architecture.md)."""
        rows = self.frames()
        frames = len(rows)
        parts = latency(rows.track_ms, rows.corrected_ms)
        sent = int(rows.sent.sum())
        return {
            "frames": frames,
            "tracked": int(rows.has_pose.sum()),
            "keyframes": int(rows.keyframe.sum()),
            "sent": sent,
            "lost_s": rows.lost_s,
            "stretches": self.stretches,
            "contradicted": self.contradicted,
            "imu_doubted": self.imu_doubted,
            "track_ms": parts.track_ms.report(),
            "corrected_ms": parts.corrected_ms.report(),
            "latency_ms": parts.latency_ms.report(),
            "over_20ms": None if math.isnan(parts.over_20ms) else parts.over_20ms,
            "cpu_ms_per_frame": 1e3 * self.cpu_s / frames if frames else None,
            "decode_ms_per_frame": 1e3 * self.decode_s / frames if frames else None,
            "rate_hz": sent / rows.span_s if rows.span_s else None,
            "init_s": rows.init_s,
            "waited": {str(wait): frames for wait, frames in self.waited.items()},
        }
