"""Common parts of the calibration reports: file names, JSON, verdict on corners, cells with sigmas."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from share.files.json_file import nan_to_none
from share.lab.calibrate import corners
from share.recordings.calibration import CAMCHAIN
from share.types import F64

AXIS_COLOURS = ("#00798c", "#d1495b", "#edae49")
MAX_OUTLIER_SHARE = 0.05  # of the corners
_FAILED_SUFFIX = ".failed"


def to_json(values: Mapping[str, Any]) -> str:
    """Return the text of a report, with null for NaN."""
    return json.dumps(nan_to_none(values), indent=1)


def output_paths(out: Path, passed: bool, *names: str) -> tuple[Path, ...]:
    """Return where to write files: under their names in `out`; or all as NAME.failed.EXT, if the calibration
    failed and one of them exists.

    A failed calibration never replaces an earlier one.
    """
    paths = tuple(out / name for name in names)
    keeps_previous = not passed and any(path.exists() for path in paths)
    return tuple(failed_path(path) for path in paths) if keeps_previous else paths


def failed_path(path: Path) -> Path:
    """Return NAME.failed.EXT."""
    return path.with_name(path.stem + _FAILED_SUFFIX + path.suffix)


def failure_message(chain: Path, reasons: Iterable[str]) -> str:
    """Return why a calibration is unreliable, and where `output_paths` put its camchain."""
    kept = "" if chain.name == CAMCHAIN else f"; the existing {CAMCHAIN} and its report are kept"
    return f"unreliable result ({chain} is written{kept}): {'; '.join(reasons)}"


def chain_heading(command: str, source: str, passed: bool, report: str) -> str:
    """Return the first remark of a camchain. report: name of the file with the reasons of a failure."""
    return f"share calibrate {command} {source}: {'passed' if passed else f'FAILED, see {report}'}"


def matrix_lines(matrix: F64) -> list[str]:
    """Return a matrix (N, M) as lines of YAML, one a row."""
    return [f"- {yaml_list(row)}" for row in matrix]


def yaml_list(values: F64) -> str:
    """Return numbers as a list of YAML, nine digits each."""
    return "[" + ", ".join(f"{value:.9g}" for value in values) + "]"


def cells_with_sigmas(values: F64, sigmas: F64, digits: int) -> list[str]:
    """Return texts such as "+1.23 ± 0.04"."""
    return [f"{v:+.{digits}f} ± {s:.{digits}f}" for v, s in zip(values, sigmas, strict=True)]


def corner_failures(cam: int, residuals: F64, sigma_px: float, max_rms_px: float, hint: str) -> list[str]:
    """Return why a camera's corners with residuals (N, 2) px fail: too large an rms of the inliers, or too
    many outliers beyond `max_rms_px`. hint: what may be wrong."""
    out, rms = [], corners.rms(residuals[corners.inlier_mask(residuals, sigma_px)])
    if len(residuals) and not rms <= max_rms_px:
        out.append(f"cam{cam}: {rms:.2f} px RMS, at most {max_rms_px:g} allowed: {hint}")
    outliers = corners.count_outliers(residuals, sigma_px, max_rms_px)
    if outliers > MAX_OUTLIER_SHARE * len(residuals):
        out.append(
            f"cam{cam}: {outliers} of {len(residuals)} corners do not fit within {max_rms_px:g} px, at most "
            f"{MAX_OUTLIER_SHARE:.0%} allowed"
        )
    return out
