"""Output of `share calibrate mocap`, and reading the mounting back."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from share.errors import UsageError
from share.files.yaml_file import read_yaml
from share.lab.calibrate.handeye import HandEyeCheck
from share.lab.calibrate.report import matrix_lines, yaml_list
from share.lab.mocap.fit import MocapFit
from share.lab.mocap.verdict import fit_warnings, mounting_warning, shared_sigmas
from share.types import F64

MOCAP_FILE = "mocap.yaml"
_MIN_SIGMA = 1e-4  # rad, m: no mounting is more precise


def mocap_yaml(fit: MocapFit, name: str, truth: str) -> str:
    """Return the text of mocap.yaml."""
    sigma = shared_sigmas(fit)
    return "\n".join(
        [
            f"# share calibrate mocap: {name} with {truth}",
            "# p_body = T_body_mocap p_mocap: from the motion capture's body to the IMU",
            "T_body_mocap:",
            *matrix_lines(fit.T_body_mocap),
            "# p_mocap = R_mocap_world p_world: the world is level, z up",
            "R_mocap_world:",
            *matrix_lines(fit.R_mocap_world),
            f"up: {fit.up}  # axis of the motion capture's world nearest to vertical; tilt: its angle to it",
            f"tilt_deg: {fit.tilt_deg:.5f}",
            f"timeshift_imu_mocap: {fit.offset_ns * 1e-9:.9f}  # s, IMU's clock minus mocap's, at mid-time",
            f"drift_ppm: {fit.drift_ppm:.3f}",
            "sigma:",
            f"  rotation_deg: {yaml_list(np.degrees(sigma[2:5]))}",
            f"  position_m: {yaml_list(sigma[5:8])}",
            f"  tilt_deg: {yaml_list(np.degrees(sigma[:2]))}",
            f"  timeshift_s: {sigma[8]:.3e}",
            f"  drift_ppm: {sigma[9] * 1e6:.3f}",
            "",
        ]
    )


def read_mounting(path: Path) -> tuple[F64, tuple[float, float]]:
    """Read T_body_mocap (4, 4) from a mocap.yaml or the folder with it, and its uncertainty, rad and m: twice
    the worst axis' sigma, as real recordings show.

    Raises UsageError, ConfigError.
    """
    file = path / MOCAP_FILE if path.is_dir() else path
    if not file.is_file():
        raise UsageError(f"{file}: no such file; `share calibrate mocap` makes one")
    top = read_yaml(file)
    sigma = top.section("sigma")
    turn, shift = (max(sigma.numbers(key, (3,))) for key in ("rotation_deg", "position_m"))
    return top.pose("T_body_mocap"), (
        max(2 * float(np.radians(turn)), _MIN_SIGMA),
        max(2 * shift, _MIN_SIGMA),
    )


def report_values(
    fit: MocapFit, name: str, truth: str, hand_eye_check: HandEyeCheck | None
) -> dict[str, Any]:
    """Return the contents of mocap-report.json."""
    sigma = shared_sigmas(fit)
    return {
        "source": name,
        "truth": truth,
        "T_body_mocap": fit.T_body_mocap.tolist(),
        "R_mocap_world": fit.R_mocap_world.tolist(),
        "up": fit.up,
        "tilt_deg": fit.tilt_deg,
        "timeshift_imu_mocap_s": fit.offset_ns * 1e-9,
        "drift_ppm": fit.drift_ppm,
        "sigma": {
            "rotation_deg": np.degrees(sigma[2:5]).tolist(),
            "position_m": sigma[5:8].tolist(),
            "tilt_deg": np.degrees(sigma[:2]).tolist(),
            "timeshift_s": float(sigma[8]),
            "drift_ppm": float(sigma[9] * 1e6),
        },
        "scale_error_percent": (100 * fit.scale_error).tolist(),
        "scale_error_sigma_percent": (100 * fit.scale_error_sigma).tolist(),
        "mounting_warning": mounting_warning(fit),
        "warnings": fit_warnings(fit),
        "residuals": {
            k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in asdict(fit.residuals).items()
        },
        "hand_eye": None if hand_eye_check is None else _hand_eye_values(hand_eye_check),
    }


def _hand_eye_values(hand_eye_check: HandEyeCheck) -> dict[str, Any]:
    estimate = hand_eye_check.hand_eye
    return {
        "T_body_mocap": estimate.T_a_b.tolist(),
        "rotation_error_deg": float(np.degrees(hand_eye_check.rotation_error_rad)),
        "translation_error_m": hand_eye_check.translation_error_m,
        "sigmas": hand_eye_check.sigmas,
        "agrees": hand_eye_check.agrees,
        "motions": estimate.motions,
        "rotation_rms_deg": np.degrees(estimate.rotation_rms_by_axis).tolist(),
    }
