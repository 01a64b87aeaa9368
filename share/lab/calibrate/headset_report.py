"""Output of `share calibrate headset`."""

from __future__ import annotations

from typing import Any

import numpy as np

from share.lab.calibrate.headset import HeadsetMount
from share.lab.calibrate.report import matrix_lines, yaml_list

HEADSET_FILE = "headset.yaml"


def headset_yaml(mount: HeadsetMount, device: str, headset: str) -> str:
    """Return the text of headset.yaml."""
    sigma = mount.sigmas
    return "\n".join(
        [
            f"# share calibrate headset: {device} with {headset}",
            "# p_body = T_body_viewer p_viewer: from the headset's viewer to the device's IMU",
            "T_body_viewer:",
            *matrix_lines(mount.T_body_viewer),
            f"timeshift_device_headset: {mount.offset_ns * 1e-9:.9f}  # s, device's clock minus headset's",
            "sigma:",
            f"  rotation_deg: {yaml_list(np.degrees(sigma[:3]))}",
            f"  position_m: {yaml_list(sigma[3:6])}",
            f"  timeshift_s: {sigma[6]:.3e}",
            "",
        ]
    )


def report_values(mount: HeadsetMount, device: str, headset: str, warnings: list[str]) -> dict[str, Any]:
    """Return the contents of headset-report.json."""
    sigma = mount.sigmas
    return {
        "device": device,
        "headset": headset,
        "T_body_viewer": mount.T_body_viewer.tolist(),
        "timeshift_device_headset_s": mount.offset_ns * 1e-9,
        "sigma": {
            "rotation_deg": np.degrees(sigma[:3]).tolist(),
            "position_m": sigma[3:6].tolist(),
            "timeshift_s": float(sigma[6]),
        },
        "residuals": {
            "rotation_deg": float(np.degrees(mount.rotation_rms)),
            "position_mm": mount.translation_rms * 1e3,
        },
        "motions": mount.motions,
        "duration_s": mount.duration_s,
        "rotation_rms_deg": np.degrees(mount.rotation_rms_by_axis).tolist(),
        "warnings": warnings,
    }
