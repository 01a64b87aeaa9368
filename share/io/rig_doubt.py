"""How far the cameras of a camchain may be off, by what `share calibrate camera` left beside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from share.calibration.bundle import shared
from share.calibration.projection import intrinsics, names
from share.errors import DataError
from share.geometry.camera import Camera, Rig
from share.geometry.lens import RADTAN
from share.io.camera_report import REPORT
from share.io.earlier import failed
from share.io.json_file import read_json
from share.types import F64

_SAME = 1e-9  # what a file may do to a number


@dataclass(frozen=True, eq=False)
class RigDoubt:
    """covariance (P, P) in the order of `bundle.Solution`, None where nobody told it; where: the report that
    did, or why none; passed: whether that report believes its cameras."""

    covariance: F64 | None
    where: str
    passed: bool = True


UNTOLD = RigDoubt(None, "the recording's own calibration does not tell it")


def rig_doubt(chain: Path, rig: Rig) -> RigDoubt:
    """Of the cameras `rig` that were read from `chain`. A report that is of others tells nothing of them.

    Raises DataError for one that is damaged.
    """
    report = chain.with_name(REPORT)
    for path in (report, failed(report)):
        if path.is_file() and (found := _told(path, rig)):
            return found
    return RigDoubt(None, f"beside {chain} is no {REPORT} of these cameras")


def _told(path: Path, rig: Rig) -> RigDoubt | None:
    told = read_json(path)
    try:
        if not _same(told, rig):
            return None
        covariance = np.array(told["covariance"], np.float64)
        passed = bool(told["passed"])
    except (KeyError, TypeError, ValueError):
        return None if "covariance" not in told else _damaged(path)
    size = shared(_cameras(rig))
    if covariance.shape != (size, size) or not np.isfinite(covariance).all():
        return _damaged(path)
    return RigDoubt(covariance, str(path), passed)


def _damaged(path: Path) -> RigDoubt:
    raise DataError(f"{path}: is damaged; calibrate the cameras again, or move it away")


def _cameras(rig: Rig) -> list[Camera]:
    return [camera for camera in (rig.cam0, rig.cam1) if camera is not None]


def _same(told: dict[str, Any], rig: Rig) -> bool:
    """Whether a report is of these very numbers."""
    cameras = _cameras(rig)
    if len(told["cameras"]) != len(cameras):
        return False
    if any(
        one.get("lens", RADTAN) != camera.model for one, camera in zip(told["cameras"], cameras, strict=True)
    ):
        return False
    pairs = [
        ([one["parameters"][name] for name in names(camera)], intrinsics(camera))
        for one, camera in zip(told["cameras"], cameras, strict=True)
    ]
    if rig.T_cam1_cam0 is not None:
        pairs.append((told["T_cam1_cam0"], rig.T_cam1_cam0))
    return all(np.allclose(a, b, rtol=_SAME, atol=_SAME) for a, b in pairs)
