"""Output of `share calibrate camera-imu`: Kalibr's chains, a report and a chart of residuals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from share.geometry import se3
from share.geometry.camera import ImuNoise, Rig
from share.lab.calibrate.board_views import StampedViews
from share.lab.calibrate.camera_imu.fit import CameraImuFit
from share.lab.calibrate.camera_imu.verdict import CameraImuVerdict, MountingComparison
from share.lab.calibrate.camera_report import RigUncertainty
from share.lab.calibrate.corners import inlier_mask
from share.lab.calibrate.report import AXIS_COLOURS, chain_heading
from share.lab.evaluate.charts import agg_pyplot, save_png
from share.recordings.calibration import Calibration, kalibr_text, to_kalibr
from share.types import F64, I64


def draw_residuals(path: Path, fit: CameraImuFit, title: str) -> None:
    """Write a PNG: RMS of each image's inlier corners, and the residuals of gyroscope and accelerometer with
    three sigmas of the stated noise."""
    figure, panels = agg_pyplot().subplots(3, 1, figsize=(12, 8), layout="constrained", sharex=True)
    _draw_corners(panels[0], fit)
    t = _seconds(fit, fit.imu.stamps_ns)
    _draw_inertial(panels[1], t, fit.gyro, fit.stated_sigmas.gyro, "gyroscope, rad/s")
    _draw_inertial(panels[2], t, fit.accel, fit.stated_sigmas.accel, "accelerometer, m/s²")
    panels[2].set_xlabel("s")
    figure.suptitle(title)
    save_png(figure, path, 75)


def _seconds(fit: CameraImuFit, stamps_ns: I64) -> F64:
    return np.asarray((stamps_ns - fit.state.curve.start_ns) * 1e-9, np.float64)


def _draw_corners(panel: Any, fit: CameraImuFit) -> None:
    t = _seconds(fit, fit.stamps_ns) + fit.shift_s
    for cam, (r, observations) in enumerate(zip(fit.corners, fit.observations.corners, strict=True)):
        inliers = inlier_mask(r, fit.sigmas.px)
        frames, size = observations.frame[inliers], len(t)
        count = np.bincount(frames, minlength=size)
        rms = np.sqrt(np.bincount(frames, (r[inliers] ** 2).sum(axis=1), size) / np.maximum(count, 1))
        panel.plot(
            t[count > 0], rms[count > 0], ".", markersize=3, color=AXIS_COLOURS[cam], label=f"cam{cam}"
        )
    panel.set(ylabel="px", ylim=(0, None), title="corners, RMS of each image")
    panel.legend(loc="upper right", fontsize=8)
    panel.grid(alpha=0.3)


def _draw_inertial(panel: Any, t: F64, residuals: F64, stated: float, title: str) -> None:
    for k, axis in enumerate("xyz"):
        panel.plot(t, residuals[:, k], ".", markersize=1, color=AXIS_COLOURS[k], label=axis)
    for side in (-3, 3):
        panel.axhline(side * stated, color="black", linewidth=1, linestyle="--")
    rms = float(np.sqrt((residuals**2).mean())) / stated
    panel.set(title=f"{title}: {rms:.2f} times the stated noise (dashed: three sigmas of that)")
    panel.legend(loc="upper right", fontsize=8, markerscale=6)
    panel.grid(alpha=0.3)


REPORT, PICTURE = "camera-imu-report.json", "camera-imu-report.png"


@dataclass(frozen=True, eq=False)
class CameraImuCalibration:
    """All results of one calibration. rig: the calibrated cameras, with their uncertainty. comparison:
    with a given T_imu_cam0. views: the images searched. given_calibration: of the cameras, as given.
    serial: of the device."""

    fit: CameraImuFit
    verdict: CameraImuVerdict
    rig: Rig
    uncertainty: RigUncertainty
    noise: ImuNoise
    comparison: MountingComparison | None
    views: StampedViews
    given_calibration: Calibration | None = None
    serial: str | None = None

    @property
    def calibrated_rig(self) -> Rig:
        return replace(
            self.rig, T_body_cam0=self.fit.T_imu_cam0, timeshift_s=self.fit.shift_s, imu=self.noise
        )

    @property
    def T_cam_imu(self) -> tuple[F64, ...]:
        """(4, 4) of each camera."""
        T = se3.inverse(self.fit.T_imu_cam0)
        return tuple(mount @ T for mount in self.fit.observations.mounts)


def camchain_yaml(outcome: CameraImuCalibration, source: str, report: str) -> str:
    """Return Kalibr's camchain-imucam: intrinsics unchanged, T_cam_imu and timeshift_cam_imu of each camera.
    report: as for `chain_heading`."""
    chain = to_kalibr(outcome.calibrated_rig, outcome.given_calibration, outcome.serial)
    del chain["imu0"]
    for cam, T in enumerate(outcome.T_cam_imu):
        chain[f"cam{cam}"] |= {"T_cam_imu": T.tolist(), "timeshift_cam_imu": outcome.fit.shift_s}
    heading = chain_heading("camera-imu", source, outcome.verdict.passed, report)
    return kalibr_text(chain, heading, "t_imu = t_cam + timeshift_cam_imu")


def imu_chain_yaml(outcome: CameraImuCalibration, source: str) -> str:
    """Return the IMU's noise as the recording states it, so that the folder is complete."""
    chain = {"imu0": to_kalibr(outcome.calibrated_rig, serial=outcome.serial)["imu0"]}
    return kalibr_text(chain, f"unchanged by share calibrate camera-imu {source}")


def report_values(outcome: CameraImuCalibration) -> dict[str, Any]:
    """Return the report as plain data."""
    fit, verdict, comparison = outcome.fit, outcome.verdict, outcome.comparison
    return {
        "passed": verdict.passed,
        "reasons": list(verdict.reasons),
        "pictures": outcome.views.images_searched,
        "pictures_with_target": outcome.views.with_target,
        "pictures_dropped": outcome.views.dropped,
        "seconds": fit.state.curve.end_s,
        "T_cam_imu": [T.tolist() for T in outcome.T_cam_imu],
        "T_imu_cam0": fit.T_imu_cam0.tolist(),
        "timeshift_cam_imu": fit.shift_s,
        "sigmas": _sigma_values(fit.axis_sigmas(fit.covariance)),
        "sigmas_by_noise": _sigma_values(fit.axis_sigmas(fit.by_noise)),
        "sigmas_by_cameras": None if fit.by_rig is None else _sigma_values(fit.axis_sigmas(fit.by_rig)),
        "camera_sigmas_from": outcome.uncertainty.source,
        "covariance": fit.covariance.tolist(),
        "gravity": fit.state.gravity.tolist(),
        "gravity_norm": float(np.linalg.norm(fit.state.gravity)),
        "gyro_bias": fit.state.biases[:, :3].mean(axis=0).tolist(),
        "accel_bias": fit.state.biases[:, 3:].mean(axis=0).tolist(),
        "rotation_rate_rms": verdict.rotation_rate_rms.tolist(),
        "acceleration_rms": verdict.acceleration_rms.tolist(),
        "residuals": _residual_values(outcome),
        "initial": {
            "timeshift_cam_imu": fit.initial_alignment.shift_s,
            "correlation": fit.initial_alignment.correlation,
        },
        "given": None if comparison is None else vars(comparison) | {"is_far": comparison.is_far},
    }


def _sigma_values(sigmas: F64) -> dict[str, Any]:
    return {
        "rotation_rad": sigmas[:3].tolist(),
        "position_m": sigmas[3:6].tolist(),
        "timeshift_s": float(sigmas[6]),
    }


def _residual_values(outcome: CameraImuCalibration) -> dict[str, Any]:
    fit, verdict = outcome.fit, outcome.verdict
    cameras = [
        {"rms_px": rms, "corners": len(r), "outlier_corners": outliers}
        for rms, r, outliers in zip(verdict.rms_px, fit.corners, verdict.outlier_corners, strict=True)
    ]
    rows = (("gyro", fit.gyro, fit.stated_sigmas.gyro), ("accel", fit.accel, fit.stated_sigmas.accel))
    inertial = {
        name: {"rms": np.sqrt((r**2).mean(axis=0)).tolist(), "stated": stated, "samples": len(r)}
        for name, r, stated in rows
    }
    return {"cameras": cameras, "corner_sigma_px": fit.sigmas.px} | inertial
