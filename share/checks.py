"""Checks of values on construction, with one clear line for each. Arrays come back read-only."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

# Limits, so that no computation overflows; no real room or sensor comes near them.
MAX_POSITION_M = 1e5  # m, of a position or a landmark
MAX_ODOM_M = 1e4  # m from the odometry origin; map poses, composed of several, stay below MAX_POSITION_M
MAX_ID = 2**31 - 1  # of keyframes, frames and revisions: 13 years at 5 Hz
MAX_SIGMA = 1e6  # of any quantity, in its unit
MAX_MAP_ID_LENGTH = 96  # characters: a run's key has up to 81, a segment's number up to 11
MAX_STAMP_NS = 2**62 - 1  # either side of 0: 146 years; differences fit 64 bits


def checked_array(
    name: str, value: ArrayLike, shape: tuple[int | None, ...], dtype: DTypeLike, finite: bool = True
) -> NDArray[Any]:
    """Return `value` as a read-only array of `dtype`; None in `shape` admits any length.

    Raises ValueError naming the field if the shape differs or (unless `finite=False`) a value is
    not finite.
    """
    array = np.asarray(value, dtype)
    fits = array.shape == shape or (
        array.ndim == len(shape)
        and all(want in (None, have) for have, want in zip(array.shape, shape, strict=True))
    )
    if not fits:
        raise ValueError(f"{name}: shape {array.shape}, expected {shape}")
    if finite and array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"{name}: has values that are not finite")
    array = array.view()
    array.flags.writeable = False
    return array


def checked_pose(name: str, value: ArrayLike, max_m: float = MAX_POSITION_M) -> NDArray[np.float64]:
    """Return `value` as a read-only rigid transform (4, 4). Raises ValueError if it is not one (tolerance
    1e-3) or its translation exceeds `max_m`."""
    T = checked_array(name, value, (4, 4), np.float64)
    check_poses(name, T[None], max_m)
    return T


def is_pose(T: NDArray[np.floating[Any]]) -> bool:
    """Return whether T (4, 4) is as `checked_pose` wants it."""
    try:
        checked_pose("pose", T)
    except ValueError:
        return False
    return True


def check_poses(name: str, poses: NDArray[np.floating[Any]], max_m: float = MAX_POSITION_M) -> None:
    """Raise ValueError unless all poses (N, 4, 4), finite, are as `checked_pose` wants them."""
    for rows in poses.tolist():
        if not _is_rigid(*rows):
            raise ValueError(f"{name}: is not a rigid transform")
        if not max(abs(row[3]) for row in rows) <= max_m:
            raise ValueError(f"{name}: is more than {max_m:g} m away")


def checked_id(name: str, value: int, minimum: int = 0) -> int:
    """Return `value`. Raises ValueError outside `minimum` .. MAX_ID."""
    if not minimum <= value <= MAX_ID:
        raise ValueError(f"{name}: {value} is outside {minimum} .. {MAX_ID}")
    return value


def checked_map_id(map_id: str) -> str:
    """Return the name of a map, which comes from a peer or a file. Raises ValueError unless it is 1 to
    MAX_MAP_ID_LENGTH printable characters."""
    if not (0 < len(map_id) <= MAX_MAP_ID_LENGTH and map_id.isprintable()):
        raise ValueError(f"map_id: 1 to {MAX_MAP_ID_LENGTH} printable characters")
    return map_id


def checked_stamp(name: str, value: int) -> int:
    """Return `value`, ns. Raises ValueError beyond ±MAX_STAMP_NS."""
    if abs(value) > MAX_STAMP_NS:
        raise ValueError(f"{name}: {value} ns is beyond any clock")
    return value


def checked_up(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return `value` as a read-only unit vector (3,), or zeros if unknown. Raises ValueError (tolerance
    1e-3)."""
    up = checked_array(name, value, (3,), np.float64)
    x, y, z = up.tolist()
    if any(up) and not abs(x * x + y * y + z * z - 1) <= 1e-3:
        raise ValueError(f"{name}: is not a unit vector")
    return up


def _is_rigid(x: list[float], y: list[float], z: list[float], bottom: list[float]) -> bool:
    """Return whether the rows of T (4, 4), finite, are a rigid transform. Plain floats, which take a fraction
    of numpy's time: every pose of every message is checked."""
    (a, b, c, _), (d, e, f, _), (g, h, i, _), (p, q, r, s) = x, y, z, bottom
    return (
        # R R' = 1; squares first: once they are bounded nothing below overflows
        abs(a * a + b * b + c * c - 1) <= 1e-3
        and abs(d * d + e * e + f * f - 1) <= 1e-3
        and abs(g * g + h * h + i * i - 1) <= 1e-3
        and abs(a * d + b * e + c * f) <= 1e-3
        and abs(a * g + b * h + c * i) <= 1e-3
        and abs(d * g + e * h + f * i) <= 1e-3
        and a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0  # det R
        and max(abs(p), abs(q), abs(r), abs(s - 1)) <= 1e-9
    )


def checked_cov(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return `value` as a read-only covariance (6, 6). Raises ValueError unless symmetric and positive
    semidefinite: another one would stop the solver for the whole map."""
    cov = checked_array(name, value, (6, 6), np.float64)
    check_covs(name, cov[None])
    return cov


def check_covs(name: str, covs: NDArray[np.float64]) -> None:
    """Raise ValueError unless all covariances (N, 6, 6), finite, are as `checked_cov` wants them."""
    sizes = np.abs(covs).max(axis=(1, 2), initial=0.0)
    if (sizes > 1e12).any():  # first: the difference of larger values may overflow
        raise ValueError(f"{name}: exceeds 1e12")
    asymmetries = np.abs(covs - covs.transpose(0, 2, 1)).max(axis=(1, 2), initial=0.0)
    if (asymmetries > 1e-6 * sizes).any():
        raise ValueError(f"{name}: is not symmetric")
    if sizes.any() and (np.linalg.eigvalsh(covs)[:, 0] < -1e-9 * sizes).any():
        raise ValueError(f"{name}: has a negative variance")


def checked_sigma(name: str, value: float) -> float:
    """Return `value` as a float. Raises ValueError if it is negative or exceeds MAX_SIGMA."""
    sigma = float(value)
    if not 0 <= sigma <= MAX_SIGMA:
        raise ValueError(f"{name}: {sigma} is outside 0 .. {MAX_SIGMA:g}")
    return sigma
