"""The frames of a run in columns, and the lines that they are kept as while it lasts.

A line is one of latency.csv, with all digits of its numbers. What is only known later, the time to the
correction, is a line of its own: it has the frame's stamp and no state.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from share.errors import DataError
from share.types import F64, I64, TrackState

CSV_HEADER = "stamp_ns,track_ms,corrected_ms,state,keyframe,sent"
_LINE = np.dtype(
    [
        *(("stamp_ns", "i8"), ("track_ms", "f8"), ("corrected_ms", "f8")),
        *(("state", "S14"), ("keyframe", "i1"), ("sent", "i1")),
    ]
)
_AT_ONCE = 65_536  # lines


def line_of_frame(stamp_ns: int, track_ms: float, state: TrackState, keyframe: bool, sent: bool) -> str:
    return f"{stamp_ns},{float(track_ms)!r},nan,{state},{int(keyframe)},{int(sent)}"


def line_of_correction(stamp_ns: int, corrected_ms: float) -> str:
    return f"{stamp_ns},nan,{float(corrected_ms)!r},,0,0"


@dataclass(frozen=True, eq=False)
class FrameColumns:
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

    def has(self, state: TrackState) -> NDArray[np.bool_]:
        """Which frames were in that state."""
        found: NDArray[np.bool_] = self.state == state.encode()
        return found

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
        lost = self.has(TrackState.LOST)[:-1]
        return float((np.diff(self.stamp_ns) * lost).sum() * 1e-9)

    @property
    def init_s(self) -> float | None:
        """From the first frame to the first with a pose; None if there was none."""
        first = np.flatnonzero(self.has_pose)[:1]
        return int(self.stamp_ns[first[0]] - self.stamp_ns[0]) * 1e-9 if first.size else None

    def csv(self) -> Iterator[str]:
        """latency.csv, in parts of whole lines."""
        yield CSV_HEADER + "\n"
        columns = (self.stamp_ns, self.track_ms, self.corrected_ms, self.state, self.keyframe, self.sent)
        for k in range(0, len(self), _AT_ONCE):
            rows = zip(*(column[k : k + _AT_ONCE].tolist() for column in columns), strict=True)
            yield "".join(_csv_line(*row) for row in rows)


def _csv_line(
    stamp_ns: int, track_ms: float, corrected_ms: float, state: bytes, keyframe: bool, sent: bool
) -> str:
    corrected = "" if math.isnan(corrected_ms) else f"{corrected_ms:.3f}"
    return f"{stamp_ns},{track_ms:.3f},{corrected},{state.decode()},{int(keyframe)},{int(sent)}\n"


def read(lines: Iterable[str]) -> FrameColumns:
    """Of the lines, the first of which is CSV_HEADER, where there are any. Raises DataError."""
    told = _parsed(lines)
    told = told[np.argsort(told["stamp_ns"], kind="stable")]  # of one stamp: as they came
    is_frame = told["state"] != b""
    frames, corrections = told[is_frame], told[~is_frame]
    before = np.cumsum(is_frame)[~is_frame]  # how many frames, in this order, of each correction
    corrections, before = corrections[before > 0], before[before > 0]
    meant = frames["stamp_ns"][before - 1] == corrections["stamp_ns"]
    corrected_ms = np.ascontiguousarray(frames["corrected_ms"])
    corrected_ms[before[meant] - 1] = corrections["corrected_ms"][meant]  # of several of a frame, the last
    return FrameColumns(
        np.ascontiguousarray(frames["stamp_ns"]),
        np.ascontiguousarray(frames["track_ms"]),
        corrected_ms,
        np.ascontiguousarray(frames["state"]),
        frames["keyframe"].astype(bool),
        frames["sent"].astype(bool),
    )


def _parsed(lines: Iterable[str]) -> NDArray[Any]:
    """As many of _LINE, a part at a time: parsing takes several times the memory of what is parsed."""
    rest = itertools.islice(lines, 1, None)
    parts = [np.empty(0, _LINE)]
    try:
        while some := list(itertools.islice(rest, _AT_ONCE)):
            parts.append(np.loadtxt(some, _LINE, delimiter=",", ndmin=1, comments=None))
    except ValueError as error:
        raise DataError(f"the run's own latencies were changed by somebody: {error}") from None
    return np.concatenate(parts)
