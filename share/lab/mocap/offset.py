"""Time offset of two clocks by correlating the rotation of mocap body and IMU.

The angle turned in a short window is equal for all parts of a rigid body, whatever their frames. Its masked
normalised correlation over all lags (Padfield, *Masked Object Registration in the Fourier Domain*, IEEE TIP
21(5), 2012, eq. 10) peaks at the offset.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.errors import CalibrationMismatchError
from share.geometry import se3
from share.geometry.interpolation import subsample_peak
from share.lab.mocap.factors import preintegrate
from share.lab.mocap.trajectory import MocapTrajectory
from share.types import F64, I64, ImuBatch

WINDOW_NS = 100_000_000
_OFFSET_STEP_NS = 10_000_000
_MIN_OVERLAP_S = 5.0
_MIN_CORRELATION = 0.6
_INDEPENDENT_NS = 500_000_000  # correlation time of the rotation rate
_PEAK_WIDTH_NS = 250_000_000  # peaks nearer than this are one


@dataclass(frozen=True)
class OffsetPeak:
    """offset_ns: IMU clock minus mocap clock, to a few ms. correlation: there; next_correlation: at the
    next best peak, 0 without one. lead: log likelihood ratio of the two peaks."""

    offset_ns: int
    correlation: float
    next_correlation: float
    lead: float


def find_offset(imu: ImuBatch, mocap: MocapTrajectory, within_s: float | None) -> OffsetPeak:
    """Find the offset of the IMU's clock from the mocap's by `correlate_rotations`."""
    return correlate_rotations(imu_rotations(imu), mocap_rotations(mocap), within_s, ("mocap", "IMU"))


def correlate_rotations(
    a: tuple[I64, F64], b: tuple[I64, F64], within_s: float | None, names: tuple[str, str]
) -> OffsetPeak:
    """Find the offset with the best correlation of rotations a and b: centres (N,) ns and vectors (N, 3)
    rad of each.

    within_s: search range; None: all offsets with an overlap of 5 s (or nearly all of the shorter). names:
    of b and a. Raises CalibrationMismatchError if the rotations match at no offset.
    """
    a_angles, a_ok, a_start = _angles_on_grid(*a)
    b_angles, b_ok, b_start = _angles_on_grid(*b)
    is_plausible = b_angles <= 1.5 * a_angles.max()  # faster rotations are outliers
    b_angles, b_ok = b_angles * is_plausible, b_ok * is_plausible
    score, count = _masked_correlation(a_angles, a_ok, b_angles, b_ok)
    lags = np.arange(len(score)) - (len(b_angles) - 1)  # a[i + lag] belongs to b[i]
    offsets = (a_start - b_start) + lags * _OFFSET_STEP_NS
    if within_s is not None:
        score = np.where(np.abs(offsets) <= within_s * 1e9, score, -1.0)
    if score.max() < _MIN_CORRELATION:
        raise CalibrationMismatchError(
            f"the rotations of {names[0]} and {names[1]} match at no time offset (correlation "
            f"{score.max():.2f}, {_MIN_CORRELATION} needed); are both of one recording, the clocks as "
            "close as stated, and does the body turn?"
        )
    evidence = _log_evidence(score, count)
    best = int(np.where(score >= _MIN_CORRELATION, evidence, -1.0).argmax())
    offset_ns = int(offsets[best] + round(subsample_peak(score, best) * _OFFSET_STEP_NS))
    next_peak = _next_peak(score, evidence, best)
    if next_peak is None:
        return OffsetPeak(offset_ns, float(score[best]), 0.0, float(evidence[best]))
    return OffsetPeak(
        offset_ns, float(score[best]), float(score[next_peak]), float(evidence[best] - evidence[next_peak])
    )


def _log_evidence(score: F64, count: F64) -> F64:
    """Return each lag's log likelihood ratio to no relation: of a Gaussian pair, -n/2 log(1 - r^2), for n
    independent samples."""
    alike = np.clip(score, 0.0, 0.999999)
    return np.asarray(-0.5 * count * (_OFFSET_STEP_NS / _INDEPENDENT_NS) * np.log1p(-(alike**2)), np.float64)


def _next_peak(score: F64, evidence: F64, best: int) -> int | None:
    """Return the lag of the next best peak."""
    is_peak = (score[1:-1] >= score[:-2]) & (score[1:-1] >= score[2:]) & (score[1:-1] > 0)
    peaks = np.flatnonzero(is_peak) + 1
    peaks = peaks[np.abs(peaks - best) * _OFFSET_STEP_NS > _PEAK_WIDTH_NS]
    return int(peaks[evidence[peaks].argmax()]) if len(peaks) else None


def imu_rotations(imu: ImuBatch) -> tuple[I64, F64]:
    """Return centres (N,) ns of windows and the rotation vectors (N, 3) rad in them, body frame."""
    start = np.arange(imu.stamps_ns[0], imu.stamps_ns[-1] - WINDOW_NS, _OFFSET_STEP_NS)
    zero = np.zeros((len(start), 3))
    increments = preintegrate(imu, start, start + WINDOW_NS, zero, zero).dR
    return start + WINDOW_NS // 2, se3.so3_log(increments)


def mocap_rotations(mocap: MocapTrajectory) -> tuple[I64, F64]:
    """Return the same in the frame of a tracked body, for windows without a gap."""
    start = np.arange(mocap.stamps_ns[0], mocap.stamps_ns[-1] - WINDOW_NS, _OFFSET_STEP_NS)
    start = start[mocap.is_covered(start) & mocap.is_covered(start + WINDOW_NS)]
    R0, R1 = mocap.interpolate(start)[:, :3, :3], mocap.interpolate(start + WINDOW_NS)[:, :3, :3]
    return start + WINDOW_NS // 2, se3.so3_log(R0.swapaxes(1, 2) @ R1)


def _angles_on_grid(stamps: I64, rotations: F64) -> tuple[F64, F64, int]:
    """Return angles on an even grid, 0 where unknown; a mask, 1 where known; and the grid's first stamp."""
    if len(stamps) == 0:
        return np.zeros(1), np.zeros(1), 0
    cells = (stamps - stamps[0]) // _OFFSET_STEP_NS
    value, known = np.zeros(cells[-1] + 1), np.zeros(cells[-1] + 1)
    value[cells], known[cells] = np.linalg.norm(rotations, axis=1), 1.0
    return value, known, int(stamps[0])


def _masked_correlation(a: F64, a_ok: F64, b: F64, b_ok: F64) -> tuple[F64, F64]:
    """Return the Pearson correlation of the overlap for every lag of b against a, -1 where that is too
    short, and its number of samples."""
    size = len(a) + len(b) - 1

    def correlate(x: F64, y: F64) -> F64:
        return np.fft.irfft(np.fft.rfft(x, size) * np.fft.rfft(y[::-1], size), size)

    n = correlate(a_ok, b_ok)
    min_samples = min(_MIN_OVERLAP_S * 1e9 / _OFFSET_STEP_NS, 0.9 * a_ok.sum(), 0.9 * b_ok.sum())
    has_overlap = n >= max(min_samples, 10)
    n = np.maximum(n, 1)
    sum_a, sum_b = correlate(a, b_ok), correlate(a_ok, b)
    var_a = np.maximum(correlate(a**2, b_ok) - sum_a**2 / n, 1e-12)
    var_b = np.maximum(correlate(a_ok, b**2) - sum_b**2 / n, 1e-12)
    score = (correlate(a, b) - sum_a * sum_b / n) / np.sqrt(var_a * var_b)
    return np.where(has_overlap, score, -1.0), n
