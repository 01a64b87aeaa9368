"""Statistics of a fit's residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.lab.mocap.factors import ImuChain
from share.types import F64


@dataclass(frozen=True, eq=False)
class FitResiduals:
    """position_mm, rotation_deg: rms distance of the path from the inlier mocap samples. position_sigmas: the
    former in units of the stated mocap noise. position_p95_mm, rotation_p95_deg: of all samples. samples:
    their number. doubted: outlier fraction.

    imu_sigmas (6,): rms residual of rotation (x, y, z) and velocity change (x, y, z) between nodes, in units
    of the data sheet's noise. gyro (3,) rad/s, accel (3,) m/s^2: the same as mean rates.
    """

    position_mm: float
    rotation_deg: float
    position_sigmas: float
    position_p95_mm: float
    rotation_p95_deg: float
    samples: int
    doubted: float
    imu_sigmas: F64
    gyro: F64
    accel: F64


def compute_residuals(
    chain: ImuChain, dt: F64, inflation: float, distances: F64, angles: F64, inliers: np.ndarray, noise: float
) -> FitResiduals:
    """Return statistics of a chain with intervals dt (M,) s and inflated noise, and of distances (K,) m
    and angles (K,) rad from the mocap. noise: stated sigma of the mocap on each axis, m."""
    rows = [0, 1, 2, 6, 7, 8]
    sigma = np.sqrt(np.diagonal(chain.cov, axis1=1, axis2=2))[:, rows] / inflation
    raw = chain.raw[:, rows]
    rates = _rms(raw / dt[:, None])
    mm, deg = distances * 1e3, np.degrees(angles)
    return FitResiduals(
        position_mm=float(_rms(mm[inliers])),
        rotation_deg=float(_rms(deg[inliers])),
        position_sigmas=float(_rms(distances[inliers])) / (noise * np.sqrt(3)),
        position_p95_mm=float(np.percentile(mm, 95)),
        rotation_p95_deg=float(np.percentile(deg, 95)),
        samples=len(mm),
        doubted=float(1 - inliers.mean()),
        imu_sigmas=_rms(raw / sigma),
        gyro=rates[:3],
        accel=rates[3:],
    )


def _rms(values: F64) -> F64:
    return np.asarray(np.sqrt((values**2).mean(0)), np.float64)
