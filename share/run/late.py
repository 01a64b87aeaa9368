"""A loop that cannot keep up leaves frames out and holds its rate: policy `drop_late`."""

from __future__ import annotations

from dataclasses import replace

from share.types import Frame, ImuBatch


class Late:
    """Of frames in order, those that may be tracked. What the IMU said between them stays."""

    def __init__(self, late_ms: float) -> None:
        """late_ms: 0: however late, no frame is left out."""
        self._late_ns = late_ms * 1e6
        self._imu: list[ImuBatch] = []
        self.dropped = 0  # frames

    def take(self, frame: Frame, behind_ns: int, another: bool) -> Frame | None:
        """The frame, with the IMU samples since the last one; None where it is left out: it begins to be
        tracked `behind_ns` after it arrived, and another waits."""
        if another and 0 < self._late_ns < behind_ns:
            self.dropped += 1
            self._imu.append(frame.imu)
            return None
        heard, self._imu = self._imu, []
        return replace(frame, imu=heard[0].join(*heard[1:], frame.imu)) if heard else frame
