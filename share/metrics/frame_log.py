"""The log of an agent's frames during a run, latency.csv and the frame part of report.json.

While the run lasts, a frame is a line as in latency.csv with all digits. A correction, known later, is a
line of its own with the frame's stamp and no state.
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
_CHUNK_LINES = 65_536


def frame_line(stamp_ns: int, track_ms: float, state: TrackState, keyframe: bool, sent: bool) -> str:
    return f"{stamp_ns},{float(track_ms)!r},nan,{state},{int(keyframe)},{int(sent)}"


def correction_line(stamp_ns: int, corrected_ms: float) -> str:
    return f"{stamp_ns},nan,{float(corrected_ms)!r},,0,0"


@dataclass(frozen=True, eq=False)
class FrameTable:
    """N frames in order of their stamps, all columns (N,). state: names of `TrackState`, as bytes.
    corrected_ms: NaN without a correction."""

    stamp_ns: I64
    track_ms: F64
    corrected_ms: F64
    state: NDArray[Any]
    keyframe: NDArray[np.bool_]
    sent: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def in_state(self, state: TrackState) -> NDArray[np.bool_]:
        """Return a mask (N,) of the frames in that state."""
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
        """From the first frame to the first with a pose; None without one."""
        first = np.flatnonzero(self.has_pose)[:1]
        return int(self.stamp_ns[first[0]] - self.stamp_ns[0]) * 1e-9 if first.size else None

    def csv_chunks(self) -> Iterator[str]:
        """Yield latency.csv in parts of whole lines."""
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
    """Return the frames in these lines, the first of which is CSV_HEADER. Raises DataError if they are
    damaged."""
    rows = _parse(lines)
    rows = rows[np.argsort(rows["stamp_ns"], kind="stable")]  # same stamp: in order of arrival
    is_frame = rows["state"] != b""
    frames, corrections = rows[is_frame], rows[~is_frame]
    frame_counts = np.cumsum(is_frame)[~is_frame]  # frames before each correction
    corrections, frame_counts = corrections[frame_counts > 0], frame_counts[frame_counts > 0]
    matches = frames["stamp_ns"][frame_counts - 1] == corrections["stamp_ns"]
    corrected_ms = np.ascontiguousarray(frames["corrected_ms"])
    # the last of several corrections of a frame wins
    corrected_ms[frame_counts[matches] - 1] = corrections["corrected_ms"][matches]
    return FrameTable(
        np.ascontiguousarray(frames["stamp_ns"]),
        np.ascontiguousarray(frames["track_ms"]),
        corrected_ms,
        np.ascontiguousarray(frames["state"]),
        frames["keyframe"].astype(bool),
        frames["sent"].astype(bool),
    )


def _parse(lines: Iterable[str]) -> NDArray[Any]:
    """Return the lines as rows of _LINE_DTYPE. Parsed in chunks: parsing takes several times their memory."""
    rest = itertools.islice(lines, 1, None)
    parts = [np.empty(0, _LINE_DTYPE)]
    try:
        while chunk := list(itertools.islice(rest, _CHUNK_LINES)):
            parts.append(np.loadtxt(chunk, _LINE_DTYPE, delimiter=",", ndmin=1, comments=None))
    except ValueError as error:
        raise DataError(f"the log of this run's frames was changed during the run: {error}") from None
    return np.concatenate(parts)


class LineStore(Protocol):
    """Storage of a run's lines."""

    def write(self, line: str) -> None:
        """Append a line, given without its end."""

    def read(self) -> Iterable[str]:
        """Return all lines in order."""


class MemoryLineStore:
    """Keeps the lines in memory, for short runs."""

    def __init__(self) -> None:
        self._lines: list[str] = []

    def write(self, line: str) -> None:
        self._lines.append(line)

    def read(self) -> Iterable[str]:
        return self._lines


@dataclass
class RunLog:
    """Collects frames as they are done, and corrections later, which name a frame by its stamp.

    A frame is kept only as a line in `lines`, so memory does not grow with the run until the report is made.
    """

    lines: LineStore = field(default_factory=MemoryLineStore)
    cpu_s: float = 0.0  # process CPU time of the tracking pipeline
    decode_s: float = 0.0  # CPU time of image decoding
    inconsistent_frames: int = 0  # frames in which images and IMU disagree about the motion
    # frames without a first pose, by what the tracker waited for
    waiting_frames: Counter[WaitReason] = field(default_factory=Counter)
    segments: int = 0  # of odometry; poses of different segments are not comparable
    imu_outliers: int = 0  # IMU samples that the tracker rejected
    _frames: int = 0
    _has_header: bool = False  # CSV_HEADER is written

    def __len__(self) -> int:
        """Number of frames."""
        return self._frames

    def add(
        self, stamp_ns: int, track_ms: float, state: TrackState, keyframe: bool, sent: bool = False
    ) -> None:
        self._write(frame_line(stamp_ns, track_ms, state, keyframe, sent))
        self._frames += 1

    def add_result(self, new_segment: bool, is_consistent: bool, waiting_for: WaitReason | None) -> None:
        """Add a frame's result: whether it starts a segment, whether images and IMU agree, and what the
        tracker waits for, None if nothing."""
        self.segments += new_segment
        self.inconsistent_frames += not is_consistent
        if waiting_for is not None:
            self.waiting_frames[waiting_for] += 1

    def add_decode_time(self, cpu_s: float) -> None:
        self.decode_s += cpu_s

    def add_correction(self, stamp_ns: int, corrected_ms: float) -> None:
        """Add a correction of a frame that was added; a later one of the same frame replaces it."""
        self._write(correction_line(stamp_ns, corrected_ms))

    def _write(self, line: str) -> None:
        if not self._has_header:
            self.lines.write(CSV_HEADER)
            self._has_header = True
        self.lines.write(line)

    def frames(self) -> FrameTable:
        """Return the frames in order of their stamps."""
        return read_frames(self.lines.read())

    def csv_chunks(self) -> Iterator[str]:
        """Yield latency.csv in parts of whole lines."""
        return self.frames().csv_chunks()

    def report(self) -> dict[str, Any]:
        """Return the fields of report.json that come from frames alone (docs/understand/architecture.md)."""
        rows = self.frames()
        frames = len(rows)
        parts = latency(rows.track_ms, rows.corrected_ms)
        sent = int(rows.sent.sum())
        return {
            "frames": frames,
            "tracked": int(rows.has_pose.sum()),
            "states": {str(state): int(rows.in_state(state).sum()) for state in TrackState},
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


# Latency as in all tables (docs/understand/architecture.md, docs/do/evaluate.md).
NOTICEABLE_LATENCY_MS = 20.0  # a headset wearer notices more


class ReplayQueue:
    """Models the queue of a recording played in real time: how long a frame would wait for the work on the
    previous one."""

    def __init__(self) -> None:
        self._stamp_ns, self._busy_ms = 0, 0.0

    def wait_ms(self, stamp_ns: int) -> float:
        """Return the waiting time of the next frame, ms."""
        return max(0.0, self._busy_ms - (stamp_ns - self._stamp_ns) * 1e-6)

    def finish_frame(self, stamp_ns: int, busy_ms: float) -> None:
        """Record a frame. busy_ms: from its arrival until all work on it was done, waiting included."""
        self._stamp_ns, self._busy_ms = stamp_ns, busy_ms


@dataclass(frozen=True)
class Summary:
    """Statistics of n values; all NaN if n is 0. Percentiles interpolate linearly."""

    n: int
    mean: float
    p50: float
    p95: float
    p99: float
    max: float

    def report(self) -> dict[str, float | None]:
        """Return a mapping for JSON, with None for NaN."""
        return {k: None if math.isnan(v) else v for k, v in dataclasses.asdict(self).items()}


@dataclass(frozen=True)
class Latency:
    """Latency of one agent over a run, ms. over_20ms: share of frames (0..1) with track_ms over 20."""

    track_ms: Summary
    corrected_ms: Summary
    latency_ms: Summary
    over_20ms: float


def summary(values: ArrayLike) -> Summary:
    """Return statistics of values (N,), N >= 0. Raises ValueError if one is not finite."""
    v = np.asarray(values, np.float64)
    if not np.isfinite(v).all():
        raise ValueError("summary: non-finite values")
    if v.size == 0:
        return Summary(0, math.nan, math.nan, math.nan, math.nan, math.nan)
    p50, p95, p99 = map(float, np.percentile(v, [50, 95, 99]))
    return Summary(v.size, float(v.mean()), p50, p95, p99, float(v.max()))


def latency(track_ms: ArrayLike, corrected_ms: ArrayLike) -> Latency:
    """Return the latency of an agent. track_ms: of every frame. corrected_ms: of corrected frames; NaN
    entries are ignored.

    `latency_ms` is over both together: a corrected frame counts twice, once for its local pose and once for
    its pose in the shared map.
    """
    track = np.asarray(track_ms, np.float64)
    corrected = np.asarray(corrected_ms, np.float64)
    corrected = corrected[~np.isnan(corrected)]
    over = float((track > NOTICEABLE_LATENCY_MS).mean()) if track.size else math.nan
    both = np.concatenate([track, corrected])
    return Latency(summary(track), summary(corrected), summary(both), over)
