"""Which time of one clock is which of another: where the turning of mocap body and IMU look alike.

The angle turned through in a short window is the same for every part of a rigid body, whatever its
frame. Its masked normalised correlation over all lags (Padfield, *Masked Object Registration in the
Fourier Domain*, IEEE TIP 21(5), 2012, eq. 10) has its peak at the offset.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.errors import MisfitError
from share.geometry import se3
from share.geometry.peak import between_steps
from share.lab.mocap.factors import preintegrate
from share.lab.mocap.mocap import Mocap
from share.types import F64, I64, ImuBatch

WINDOW_NS = 100_000_000
_OFFSET_STEP_NS = 10_000_000
_LEAST_OVERLAP_S = 5.0
_LEAST_CORRELATION = 0.6
_ALONE_NS = 500_000_000  # turning keeps its pace about so long: what counts as one independent sample
_NEXT_NS = 250_000_000  # a second peak nearer than that belongs to the first


@dataclass(frozen=True)
class Peak:
    """offset_ns: IMU clock minus mocap clock, to a few ms. correlation: there; rival: at the next best
    peak, 0 without one. lead: by how much the one explains the turning better than the other, as the
    logarithm of a ratio of likelihoods."""

    offset_ns: int
    correlation: float
    rival: float
    lead: float


def coarse_offset(imu: ImuBatch, mocap: Mocap, within_s: float | None) -> int:
    """`find_offset`, the offset alone."""
    return find_offset(imu, mocap, within_s).offset_ns


def find_offset(imu: ImuBatch, mocap: Mocap, within_s: float | None) -> Peak:
    """Where the two turn alike. within_s: search no farther than that; None: all offsets by which the two
    overlap by 5 s (or by the whole of the shorter).

    Raises MisfitError if nowhere do the two turn alike.
    """
    a, a_ok, a_start = _on_grid(*imu_turning(imu))
    b, b_ok, b_start = _on_grid(*mocap_turning(mocap))
    possible = b <= 1.5 * a.max()  # the body never turned faster: an outlier of the mocap did
    b, b_ok = b * possible, b_ok * possible
    score, count = _masked_correlation(a, a_ok, b, b_ok)
    lags = np.arange(len(score)) - (len(b) - 1)  # a[i + lag] belongs to b[i]
    offsets = (a_start - b_start) + lags * _OFFSET_STEP_NS
    if within_s is not None:
        score = np.where(np.abs(offsets) <= within_s * 1e9, score, -1.0)
    if score.max() < _LEAST_CORRELATION:
        raise MisfitError(
            f"mocap and IMU turn nowhere alike (correlation {score.max():.2f} of {_LEAST_CORRELATION} "
            "needed); are both of one recording, the clocks as near as was said, and does the body turn?"
        )
    known = _evidence(score, count)
    best = int(np.where(score >= _LEAST_CORRELATION, known, -1.0).argmax())
    offset_ns = int(offsets[best] + round(between_steps(score, best) * _OFFSET_STEP_NS))
    rival = _rival(score, known, best)
    if rival is None:
        return Peak(offset_ns, float(score[best]), 0.0, float(known[best]))
    return Peak(offset_ns, float(score[best]), float(score[rival]), float(known[best] - known[rival]))


def _evidence(score: F64, count: F64) -> F64:
    """How much likelier (logarithm) each lag makes what was seen than no relation at all would: of a
    Gaussian pair, -n/2 log(1 - r^2), for n independent samples."""
    alike = np.clip(score, 0.0, 0.999999)
    return np.asarray(-0.5 * count * (_OFFSET_STEP_NS / _ALONE_NS) * np.log1p(-(alike**2)), np.float64)


def _rival(score: F64, known: F64, best: int) -> int | None:
    """The lag of the next best peak."""
    top = (score[1:-1] >= score[:-2]) & (score[1:-1] >= score[2:]) & (score[1:-1] > 0)
    tops = np.flatnonzero(top) + 1
    tops = tops[np.abs(tops - best) * _OFFSET_STEP_NS > _NEXT_NS]
    return int(tops[known[tops].argmax()]) if len(tops) else None


def imu_turning(imu: ImuBatch) -> tuple[I64, F64]:
    """Centres (N,) ns of windows and the rotation vectors (N, 3) rad turned in them, body frame."""
    start = np.arange(imu.stamps_ns[0], imu.stamps_ns[-1] - WINDOW_NS, _OFFSET_STEP_NS)
    zero = np.zeros((len(start), 3))
    turned = preintegrate(imu, start, start + WINDOW_NS, zero, zero).dR
    return start + WINDOW_NS // 2, se3.so3_log(turned)


def mocap_turning(mocap: Mocap) -> tuple[I64, F64]:
    """As `imu_turning`, in the mocap body's frame; windows without a hole only."""
    start = np.arange(mocap.stamps_ns[0], mocap.stamps_ns[-1] - WINDOW_NS, _OFFSET_STEP_NS)
    start = start[mocap.known(start) & mocap.known(start + WINDOW_NS)]
    R0, R1 = mocap.at(start)[:, :3, :3], mocap.at(start + WINDOW_NS)[:, :3, :3]
    return start + WINDOW_NS // 2, se3.so3_log(R0.swapaxes(1, 2) @ R1)


def _on_grid(stamps: I64, turned: F64) -> tuple[F64, F64, int]:
    """Angles on an even grid, 0 where unknown; 1 where known; the grid's first stamp."""
    if len(stamps) == 0:
        return np.zeros(1), np.zeros(1), 0
    place = (stamps - stamps[0]) // _OFFSET_STEP_NS
    value, known = np.zeros(place[-1] + 1), np.zeros(place[-1] + 1)
    value[place], known[place] = np.linalg.norm(turned, axis=1), 1.0
    return value, known, int(stamps[0])


def _masked_correlation(a: F64, a_ok: F64, b: F64, b_ok: F64) -> tuple[F64, F64]:
    """Pearson correlation of what overlaps, for every lag of b against a, -1 where too little does; and how
    many samples that is."""
    size = len(a) + len(b) - 1

    def correlate(x: F64, y: F64) -> F64:
        return np.fft.irfft(np.fft.rfft(x, size) * np.fft.rfft(y[::-1], size), size)

    n = correlate(a_ok, b_ok)
    least = min(_LEAST_OVERLAP_S * 1e9 / _OFFSET_STEP_NS, 0.9 * a_ok.sum(), 0.9 * b_ok.sum())
    enough = n >= max(least, 10)
    n = np.maximum(n, 1)
    sum_a, sum_b = correlate(a, b_ok), correlate(a_ok, b)
    var_a = np.maximum(correlate(a**2, b_ok) - sum_a**2 / n, 1e-12)
    var_b = np.maximum(correlate(a_ok, b**2) - sum_b**2 / n, 1e-12)
    score = (correlate(a, b) - sum_a * sum_b / n) / np.sqrt(var_a * var_b)
    return np.where(enough, score, -1.0), n
