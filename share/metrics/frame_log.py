"""The frames of a run in columns, and the lines that they are kept as while it lasts.

A line is one of latency.csv, with all digits of its numbers. What is only known later, the time to the
correction, is a line of its own: it has the frame's stamp and no state.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from share.errors import DataError
from share.types import F64, I64, TrackState, WaitReason

CSV_HEADER = "stamp_ns,track_ms,corrected_ms,state,keyframe,sent"
_LINE_DTYPE = np.dtype(
    [
        *(("stamp_ns", "i8"), ("track_ms", "f8"), ("corrected_ms", "f8")),
        *(("state", "S14"), ("keyframe", "i1"), ("sent", "i1")),
    ]
)
_CHUNK_LINES = 65_536  # lines


def frame_line(stamp_ns: int, track_ms: float, state: TrackState, keyframe: bool, sent: bool) -> str:
    return f"{stamp_ns},{float(track_ms)!r},nan,{state},{int(keyframe)},{int(sent)}"


def correction_line(stamp_ns: int, corrected_ms: float) -> str:
    return f"{stamp_ns},nan,{float(corrected_ms)!r},,0,0"


@dataclass(frozen=True, eq=False)
class FrameTable:
    """N frames in order of their stamps: each (N,). state: names of `TrackState`, as bytes.
    corrected_ms: NaN where no correction came of the frame."""

    stamp_ns: I64
    track_ms: F64
    corrected_ms: F64
    state: NDArray[Any]
    keyframe: NDArray[np.bool_]
    sent: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def in_state(self, state: TrackState) -> NDArray[np.bool_]:
        """Which frames were in that state."""
        mask: NDArray[np.bool_] = self.state == state.encode()
        return mask

    @property
    def has_pose(self) -> NDArray[np.bool_]:
        return np.isin(self.state, [state.encode() for state in TrackState if state.has_pose])

    @property
    def span_s(self) -> float:
        """From the first frame to the last."""
        return int(self.stamp_ns[-1] - self.stamp_ns[0]) * 1e-9 if len(self) else 0.0

    @property
    def lost_s(self) -> float:
        """Time from each LOST frame to the next frame."""
        lost = self.in_state(TrackState.LOST)[:-1]
        return float((np.diff(self.stamp_ns) * lost).sum() * 1e-9)

    @property
    def init_s(self) -> float | None:
        """From the first frame to the first with a pose; None if there was none."""
        first = np.flatnonzero(self.has_pose)[:1]
        return int(self.stamp_ns[first[0]] - self.stamp_ns[0]) * 1e-9 if first.size else None

    def csv_chunks(self) -> Iterator[str]:
        """latency.csv, in parts of whole lines."""
        yield CSV_HEADER + "\n"
        columns = (self.stamp_ns, self.track_ms, self.corrected_ms, self.state, self.keyframe, self.sent)
        for k in range(0, len(self), _CHUNK_LINES):
            rows = zip(*(column[k : k + _CHUNK_LINES].tolist() for column in columns), strict=True)
            yield "".join(_csv_line(*row) for row in rows)


def _csv_line(
    stamp_ns: int, track_ms: float, corrected_ms: float, state: bytes, keyframe: bool, sent: bool
) -> str:
    corrected = "" if math.isnan(corrected_ms) else f"{corrected_ms:.3f}"
    return f"{stamp_ns},{track_ms:.3f},{corrected},{state.decode()},{int(keyframe)},{int(sent)}\n"


def read_frames(lines: Iterable[str]) -> FrameTable:
    """Of the lines, the first of which is CSV_HEADER, where there are any. Raises DataError."""
    rows = _parse(lines)
    rows = rows[np.argsort(rows["stamp_ns"], kind="stable")]  # of one stamp: as they came
    is_frame = rows["state"] != b""
    frames, corrections = rows[is_frame], rows[~is_frame]
    frame_counts = np.cumsum(is_frame)[~is_frame]  # how many frames, in this order, of each correction
    corrections, frame_counts = corrections[frame_counts > 0], frame_counts[frame_counts > 0]
    matches = frames["stamp_ns"][frame_counts - 1] == corrections["stamp_ns"]
    corrected_ms = np.ascontiguousarray(frames["corrected_ms"])
    corrected_ms[frame_counts[matches] - 1] = corrections["corrected_ms"][
        matches
    ]  # of several of a frame, the last
    return FrameTable(
        np.ascontiguousarray(frames["stamp_ns"]),
        np.ascontiguousarray(frames["track_ms"]),
        corrected_ms,
        np.ascontiguousarray(frames["state"]),
        frames["keyframe"].astype(bool),
        frames["sent"].astype(bool),
    )


def _parse(lines: Iterable[str]) -> NDArray[Any]:
    """As many of _LINE, a part at a time: parsing takes several times the memory of what is parsed."""
    rest = itertools.islice(lines, 1, None)
    parts = [np.empty(0, _LINE_DTYPE)]
    try:
        while chunk := list(itertools.islice(rest, _CHUNK_LINES)):
            parts.append(np.loadtxt(chunk, _LINE_DTYPE, delimiter=",", ndmin=1, comments=None))
    except ValueError as error:
        raise DataError(f"the run's own latencies were changed by somebody: {error}") from None
    return np.concatenate(parts)


# ---- What happened to every frame of one agent's run, and the report that comes of it.


class LineStore(Protocol):
    """Where the lines of a run go, and come from again."""

    def write(self, line: str) -> None:
        """One more, without its end."""

    def read(self) -> Iterable[str]:
        """All of them, in order."""


class MemoryLineStore:
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

    lines: LineStore = field(default_factory=MemoryLineStore)
    cpu_s: float = 0.0  # process CPU time of the tracking pipeline
    decode_s: float = 0.0  # CPU time of image decoding
    inconsistent_frames: int = 0  # frames in which images and IMU told of different motions
    waiting_frames: Counter[WaitReason] = field(
        default_factory=Counter
    )  # frames, by what was still waited for
    segments: int = 0  # of unbroken odometry; poses of different ones do not compare
    imu_outliers: int = 0  # samples of the IMU that the tracker did not believe
    _frames: int = 0
    _has_header: bool = False  # the first line, the columns' names, is written

    def __len__(self) -> int:
        """How many frames."""
        return self._frames

    def add(
        self, stamp_ns: int, track_ms: float, state: TrackState, keyframe: bool, sent: bool = False
    ) -> None:
        self._write(frame_line(stamp_ns, track_ms, state, keyframe, sent))
        self._frames += 1

    def add_result(self, new_segment: bool, is_consistent: bool, waiting_for: WaitReason | None) -> None:
        """Of a frame: whether odometry broke before it, whether images and IMU agree, and what is still
        waited for; None: nothing."""
        self.segments += new_segment
        self.inconsistent_frames += not is_consistent
        if waiting_for is not None:
            self.waiting_frames[waiting_for] += 1

    def add_decode_time(self, cpu_s: float) -> None:
        self.decode_s += cpu_s

    def add_correction(self, stamp_ns: int, corrected_ms: float) -> None:
        """Of a frame that was added; a later mark of the same frame replaces this one."""
        self._write(correction_line(stamp_ns, corrected_ms))

    def _write(self, line: str) -> None:
        if not self._has_header:
            self.lines.write(CSV_HEADER)
            self._has_header = True
        self.lines.write(line)

    def frames(self) -> FrameTable:
        """In order of time, which is not the order in which their fate was known."""
        return read_frames(self.lines.read())

    def csv_chunks(self) -> Iterator[str]:
        """The whole of latency.csv, in parts."""
        return self.frames().csv_chunks()

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
            "segments": self.segments,
            "inconsistent_frames": self.inconsistent_frames,
            "imu_outliers": self.imu_outliers,
            "track_ms": parts.track_ms.report(),
            "corrected_ms": parts.corrected_ms.report(),
            "latency_ms": parts.latency_ms.report(),
            "over_20ms": None if math.isnan(parts.over_20ms) else parts.over_20ms,
            "cpu_ms_per_frame": 1e3 * self.cpu_s / frames if frames else None,
            "decode_ms_per_frame": 1e3 * self.decode_s / frames if frames else None,
            "rate_hz": sent / rows.span_s if rows.span_s else None,
            "init_s": rows.init_s,
            "waiting_frames": {str(reason): frames for reason, frames in self.waiting_frames.items()},
        }


# ---- Latency as every table means it (docs/architecture.md; docs/evaluation.md).

NOTICEABLE_LATENCY_MS = 20.0  # a headset wearer notices more


class ReplayQueue:
    """How long a frame of a recording would wait if frames came at the recording's pace: for what the one
    before left to do."""

    def __init__(self) -> None:
        self._stamp_ns, self._busy_ms = 0, 0.0

    def wait_ms(self, stamp_ns: int) -> float:
        """Of the next frame."""
        return max(0.0, self._busy_ms - (stamp_ns - self._stamp_ns) * 1e-6)

    def finish_frame(self, stamp_ns: int, busy_ms: float) -> None:
        """busy_ms: from when the frame came until all work on it was done, its wait included."""
        self._stamp_ns, self._busy_ms = stamp_ns, busy_ms


@dataclass(frozen=True)
class Summary:
    """Of n values; all NaN where n is 0. Percentiles interpolate linearly."""

    n: int
    mean: float
    p50: float
    p95: float
    p99: float
    max: float

    def report(self) -> dict[str, float | None]:
        """For JSON, which knows no NaN: None instead."""
        return {k: None if math.isnan(v) else v for k, v in dataclasses.asdict(self).items()}


@dataclass(frozen=True)
class Latency:
    """Of one agent over a run, ms. over_20ms: share of frames (0..1) whose track_ms exceeds 20."""

    track_ms: Summary
    corrected_ms: Summary
    latency_ms: Summary
    over_20ms: float


def summary(values: ArrayLike) -> Summary:
    """Of values (N,), N >= 0. Raises ValueError where one is not finite."""
    v = np.asarray(values, np.float64)
    if not np.isfinite(v).all():
        raise ValueError("summary: has values that are not finite")
    if v.size == 0:
        return Summary(0, math.nan, math.nan, math.nan, math.nan, math.nan)
    p50, p95, p99 = map(float, np.percentile(v, [50, 95, 99]))
    return Summary(v.size, float(v.mean()), p50, p95, p99, float(v.max()))


def latency(track_ms: ArrayLike, corrected_ms: ArrayLike) -> Latency:
    """track_ms: of every frame; corrected_ms: of every corrected frame (NaN: was not corrected).

    An agent's latency is the mean over the multiset of both: a frame that was corrected counts twice,
    once for its local pose and once for its place in the shared map.
    """
    track = np.asarray(track_ms, np.float64)
    corrected = np.asarray(corrected_ms, np.float64)
    corrected = corrected[~np.isnan(corrected)]
    over = float((track > NOTICEABLE_LATENCY_MS).mean()) if track.size else math.nan
    both = np.concatenate([track, corrected])
    return Latency(summary(track), summary(corrected), summary(both), over)
