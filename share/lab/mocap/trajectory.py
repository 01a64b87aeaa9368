"""Poses of a motion capture, validated, and the gaps in them; checks of the IMU's stamps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from share.checks import checked_array
from share.errors import DataError
from share.geometry import se3
from share.types import F64, I64, ImuBatch

_GAP_FACTOR = 5  # times the median spacing of samples
_MAX_IMU_GAP_NS = 100_000_000  # linear interpolation does not hold across longer gaps
_MAX_SPACING_NS = 750_000_000  # of half the samples; what is slower shows no turn within a second
_MAX_DURATION_NS = 6 * 3600 * 10**9  # allowed however rarely the body is seen
_MAX_HIDDEN_FACTOR = 100  # longer recordings: at most this times the time in which it is seen
_LONGEST_NS = 24 * 3600 * 10**9  # in any case: clocks are found by rotations every 10 ms of all of it


@dataclass(frozen=True, eq=False)
class MocapTrajectory:
    """Poses T (M, 4, 4) of the mocap's body (its markers') in the mocap's world at stamps_ns (M,), rising,
    in the mocap's clock. source: what tracked it, for messages. Raises DataError for invalid ones."""

    stamps_ns: I64
    T: F64
    source: str = "mocap"

    def __post_init__(self) -> None:
        n = len(self.stamps_ns)
        if n < 2:
            raise DataError(f"{self.source}: {n} poses; at least two are needed, record again")
        check_stamps(self.source, self.stamps_ns)
        self._check_span()
        try:
            object.__setattr__(self, "T", checked_array("T", self.T, (n, 4, 4), np.float64))
        except ValueError as error:
            raise DataError(
                f"{self.source}: {error}; remove the samples where the body was not seen"
            ) from None
        R = self.T[:, :3, :3]
        bad = np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max((1, 2)) > 1e-3
        bad |= np.linalg.det(R) < 0
        if bad.any():
            raise DataError(
                f"{self.source}: pose {int(bad.argmax()) + 1} of {n} is not a rigid transform; remove it"
            )

    def _check_span(self) -> None:
        """Raise DataError for stamps in another unit, with an outlier or a clock step."""
        t = self.stamps_ns
        if self.spacing_ns > _MAX_SPACING_NS:
            raise DataError(
                f"{self.source}: poses are {self.spacing_ns * 1e-9:,.1f} s apart, {_MAX_SPACING_NS * 1e-9:g} "
                "s at most are needed; are the stamps in ms or µs? TUM files have seconds, CSV has ns"
            )
        seen_ns = len(t) * self.spacing_ns
        if t[-1] - t[0] <= min(max(_MAX_DURATION_NS, _MAX_HIDDEN_FACTOR * seen_ns), _LONGEST_NS):
            return
        i = int(np.diff(t).argmax())
        raise DataError(
            f"{self.source}: stamps jump by {(t[i + 1] - t[i]) * 1e-9:.0f} s at sample {i + 2}, from {t[i]} "
            f"to {t[i + 1]} ns; cut there"
        )

    @cached_property
    def spacing_ns(self) -> int:
        """Median time between samples."""
        return int(np.median(np.diff(self.stamps_ns)))

    def between(self, start_ns: int, end_ns: int) -> MocapTrajectory:
        """Return the samples within [start_ns, end_ns]. Raises DataError if there are fewer than two."""
        keep = (self.stamps_ns >= start_ns) & (self.stamps_ns <= end_ns)
        return replace(self, stamps_ns=self.stamps_ns[keep], T=self.T[keep])

    def thinned(self, min_spacing_ns: int) -> MocapTrajectory:
        """Return the first sample in every `min_spacing_ns`."""
        slot = (self.stamps_ns - self.stamps_ns[0]) // min_spacing_ns
        keep = np.diff(slot, prepend=-1) > 0
        return self if keep.all() else replace(self, stamps_ns=self.stamps_ns[keep], T=self.T[keep])

    def rotated(self, R: F64) -> MocapTrajectory:
        """Return the poses in a world rotated by R (3, 3)."""
        return replace(self, T=se3.from_rt(R, np.zeros(3)) @ self.T)

    def shifted(self, offset_ns: int) -> MocapTrajectory:
        """Return the poses with `offset_ns` added to every stamp."""
        return replace(self, stamps_ns=self.stamps_ns + offset_ns)

    def is_covered(self, stamps_ns: I64) -> np.ndarray:
        """Return (N,) bool: stamps between two neighbouring samples without a gap."""
        i = np.searchsorted(self.stamps_ns, stamps_ns, "right")
        inside = (i > 0) & (i < len(self.stamps_ns))
        i = np.clip(i, 1, len(self.stamps_ns) - 1)
        spacing = self.stamps_ns[i] - self.stamps_ns[i - 1]
        return np.asarray(inside & (spacing <= _GAP_FACTOR * self.spacing_ns), bool)

    def interpolate(self, stamps_ns: I64) -> F64:
        """Return poses (N, 4, 4) interpolated between samples, at constant rates, across gaps too."""
        i = np.clip(np.searchsorted(self.stamps_ns, stamps_ns, "right"), 1, len(self.stamps_ns) - 1)
        before, after = self.T[i - 1], self.T[i]
        fraction = (stamps_ns - self.stamps_ns[i - 1]) / (self.stamps_ns[i] - self.stamps_ns[i - 1])
        rotation = se3.so3_log(before[:, :3, :3].swapaxes(1, 2) @ after[:, :3, :3])
        t = before[:, :3, 3] + fraction[:, None] * (after[:, :3, 3] - before[:, :3, 3])
        return se3.from_rt(before[:, :3, :3] @ se3.so3_exp(fraction[:, None] * rotation), t)


def find_gaps(stamps_ns: I64, min_gap_ns: int) -> I64:
    """Return (G, 2) ns: neighbouring stamps more than `min_gap_ns` apart."""
    gap_rows = np.flatnonzero(np.diff(stamps_ns) > min_gap_ns)
    return np.stack([stamps_ns[gap_rows], stamps_ns[gap_rows + 1]], axis=1)


def check_imu(imu: ImuBatch) -> None:
    """Raise DataError for an IMU that cannot be integrated from end to end."""
    if len(imu) < 2:
        raise DataError(f"IMU: {len(imu)} samples; at least two are needed, record again")
    check_stamps("IMU", imu.stamps_ns)
    missing = find_gaps(imu.stamps_ns, _MAX_IMU_GAP_NS)
    if len(missing):
        start, end = (missing[0] - imu.stamps_ns[0]) * 1e-9
        raise DataError(
            f"IMU: no samples from {start:.3f} to {end:.3f} s after its start; "
            "fit the parts before and after separately"
        )


def check_stamps(name: str, stamps_ns: I64) -> None:
    """Raise DataError unless stamps rise strictly."""
    backward = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if len(backward):
        i = int(backward[0]) + 1
        raise DataError(
            f"{name}: stamp {stamps_ns[i]} ns of sample {i + 1} is not later than the one before; "
            "sort the samples by time and remove duplicates"
        )
