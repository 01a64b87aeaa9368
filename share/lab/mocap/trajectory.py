"""A motion capture's record as the fit takes it: checked, and where it has holes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from share.errors import DataError
from share.geometry import se3
from share.types import F64, I64, ImuBatch, checked_array

_GAP_FACTOR = 5  # times the usual spacing of samples
_MAX_IMU_GAP_NS = 100_000_000  # longer, and straight lines between samples are no motion
_MAX_DURATION_NS = 6 * 3600 * 10**9  # so long a recording may last however little is seen in it
_MAX_HIDDEN_FACTOR = 100  # a longer one, so many times what is seen


@dataclass(frozen=True, eq=False)
class MocapTrajectory:
    """Poses T (M, 4, 4) of the mocap's body (its markers') in the mocap's world at stamps_ns (M,), in
    the mocap's clock, rising. Raises DataError for what is none."""

    stamps_ns: I64
    T: F64

    def __post_init__(self) -> None:
        n = len(self.stamps_ns)
        if n < 2:
            raise DataError(f"mocap: {n} poses; at least two are needed, record again")
        check_stamps("mocap", self.stamps_ns)
        self._check_span()
        try:
            object.__setattr__(self, "T", checked_array("T", self.T, (n, 4, 4), np.float64))
        except ValueError as error:
            raise DataError(f"mocap: {error}; leave out the samples where the body was not seen") from None
        R = self.T[:, :3, :3]
        bad = np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max((1, 2)) > 1e-3
        bad |= np.linalg.det(R) < 0
        if bad.any():
            raise DataError(
                f"mocap: pose {int(bad.argmax()) + 1} of {n} is not a rigid transform; leave it out"
            )

    def _check_span(self) -> None:
        """Raises DataError for stamps of which one is astray, or that are by a clock that was set."""
        t = self.stamps_ns
        if t[-1] - t[0] <= max(_MAX_DURATION_NS, _MAX_HIDDEN_FACTOR * len(t) * self.spacing_ns):
            return
        i = int(np.diff(t).argmax())
        raise DataError(
            f"mocap: stamps jump by {(t[i + 1] - t[i]) * 1e-9:.0f} s at sample {i + 2}, from {t[i]} to "
            f"{t[i + 1]} ns; cut there"
        )

    @cached_property
    def spacing_ns(self) -> int:
        """The usual time between samples: their median."""
        return int(np.median(np.diff(self.stamps_ns)))

    def between(self, start_ns: int, end_ns: int) -> MocapTrajectory:
        """Samples within [start_ns, end_ns]. Raises DataError if there are fewer than two."""
        keep = (self.stamps_ns >= start_ns) & (self.stamps_ns <= end_ns)
        return MocapTrajectory(self.stamps_ns[keep], self.T[keep])

    def thinned(self, min_spacing_ns: int) -> MocapTrajectory:
        """At most one sample, the first, in every `min_spacing_ns`."""
        slot = (self.stamps_ns - self.stamps_ns[0]) // min_spacing_ns
        keep = np.diff(slot, prepend=-1) > 0
        return self if keep.all() else MocapTrajectory(self.stamps_ns[keep], self.T[keep])

    def rotated(self, R: F64) -> MocapTrajectory:
        """The same in a world that is turned by R (3, 3)."""
        return MocapTrajectory(self.stamps_ns, se3.from_rt(R, np.zeros(3)) @ self.T)

    def shifted(self, offset_ns: int) -> MocapTrajectory:
        """The same with `offset_ns` added to every stamp."""
        return MocapTrajectory(self.stamps_ns + offset_ns, self.T)

    def is_covered(self, stamps_ns: I64) -> np.ndarray:
        """(N,) bool: stamps that lie between two neighbouring samples with no hole between."""
        i = np.searchsorted(self.stamps_ns, stamps_ns, "right")
        inside = (i > 0) & (i < len(self.stamps_ns))
        i = np.clip(i, 1, len(self.stamps_ns) - 1)
        spacing = self.stamps_ns[i] - self.stamps_ns[i - 1]
        return np.asarray(inside & (spacing <= _GAP_FACTOR * self.spacing_ns), bool)

    def interpolate(self, stamps_ns: I64) -> F64:
        """Poses (N, 4, 4) between samples, straight and at even rate, holes or not."""
        i = np.clip(np.searchsorted(self.stamps_ns, stamps_ns, "right"), 1, len(self.stamps_ns) - 1)
        before, after = self.T[i - 1], self.T[i]
        fraction = (stamps_ns - self.stamps_ns[i - 1]) / (self.stamps_ns[i] - self.stamps_ns[i - 1])
        rotation = se3.so3_log(before[:, :3, :3].swapaxes(1, 2) @ after[:, :3, :3])
        t = before[:, :3, 3] + fraction[:, None] * (after[:, :3, 3] - before[:, :3, 3])
        return se3.from_rt(before[:, :3, :3] @ se3.so3_exp(fraction[:, None] * rotation), t)


def find_gaps(stamps_ns: I64, min_gap_ns: int) -> I64:
    """(G, 2) ns: neighbouring stamps that lie more than `min_gap_ns` apart."""
    gap_rows = np.flatnonzero(np.diff(stamps_ns) > min_gap_ns)
    return np.stack([stamps_ns[gap_rows], stamps_ns[gap_rows + 1]], axis=1)


def check_imu(imu: ImuBatch) -> None:
    """Raises DataError for an IMU that cannot be integrated from end to end."""
    if len(imu) < 2:
        raise DataError(f"IMU: {len(imu)} samples; at least two are needed, record again")
    check_stamps("IMU", imu.stamps_ns)
    missing = find_gaps(imu.stamps_ns, _MAX_IMU_GAP_NS)
    if len(missing):
        start, end = (missing[0] - imu.stamps_ns[0]) * 1e-9
        raise DataError(
            f"IMU: no samples from {start:.3f} to {end:.3f} s after its start; "
            "fit the parts before and after apart"
        )


def check_stamps(name: str, stamps_ns: I64) -> None:
    """Raises DataError unless strictly rising."""
    backward = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if len(backward):
        i = int(backward[0]) + 1
        raise DataError(
            f"{name}: stamp {stamps_ns[i]} ns of sample {i + 1} is not later than the one before; "
            "sort the samples by time and leave out double ones"
        )
