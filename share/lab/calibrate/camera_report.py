"""Output of `share calibrate camera`: Kalibr's camchain, a report and a picture; and reading the report's
covariance back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from share.errors import ConfigError, DataError
from share.files.json_file import read_json
from share.files.yaml_file import read_yaml
from share.geometry import se3
from share.geometry.camera import Camera, ImuNoise, Rig
from share.geometry.lens import RADTAN
from share.lab.calibrate.camera_bundle import CameraBundleSolution
from share.lab.calibrate.camera_initialisation import intrinsics, parameter_names
from share.lab.calibrate.camera_verdict import CameraVerdict, Coverage, camera_residuals
from share.lab.calibrate.corner_observations import BoardView, rig_size
from share.lab.calibrate.corners import inlier_mask, model_radius
from share.lab.calibrate.report import AXIS_COLOURS, chain_heading, failed_path
from share.lab.calibrate.target import Target, read_target
from share.lab.evaluate.charts import agg_pyplot, save_png
from share.recordings.calibration import Calibration, imu_noise, kalibr_text, to_kalibr
from share.types import F64

REPORT, PICTURE = "camera-report.json", "camera-report.png"
_MAX_ARROWS = 1500  # more overlap
_INLIER_COLOUR, _OUTLIER_COLOUR = AXIS_COLOURS[:2]


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """All results of one calibration.

    `previous_rig`: the cameras before; `previous_epipolar_px`: their median epipolar distance.
    `views_with_target`: of all images searched. `given_calibration`: as given by the user. `serial`: of the
    device.
    """

    views: Sequence[BoardView]
    solution: CameraBundleSolution
    coverages: tuple[Coverage, ...]
    verdict: CameraVerdict
    previous_rig: Rig | None
    views_with_target: int
    previous_epipolar_px: float | None = None
    given_calibration: Calibration | None = None
    serial: str | None = None

    def corners_of(self, cam: int) -> tuple[F64, F64, np.ndarray]:
        """Return a camera's corners (N, 2) px, their residuals (N, 2) and the inlier mask (N,)."""
        r = camera_residuals(self.solution, cam)
        px = np.concatenate([view.detections[cam].px for view in self.views])
        return px, r, inlier_mask(r, self.solution.sigma_px)

    def model_radius(self, cam: int) -> float | None:
        """Return `corners.model_radius` of a camera about its principal point."""
        px, _, inliers = self.corners_of(cam)
        camera = self.solution.state.cameras[cam]
        return model_radius(px, np.array([camera.cx, camera.cy]), inliers)

    @property
    def rig(self) -> Rig:
        """The new cameras; the pose of cam0 on the IMU is kept."""
        state = self.solution.state
        has_two = len(state.cameras) == 2
        rig = self.previous_rig or Rig(cam0=state.cameras[0], T_body_cam0=np.eye(4))
        return replace(
            rig,
            cam0=state.cameras[0],
            cam1=state.cameras[1] if has_two else None,
            T_cam1_cam0=state.T_cam1_cam0 if has_two else None,
        )


def camchain_yaml(outcome: CameraCalibration, source: str, report: str) -> str:
    """Return the camchain, with the given extrinsics to the IMU. report: as for `chain_heading`."""
    kalibr = to_kalibr(outcome.rig, outcome.given_calibration, outcome.serial)
    chain = {key: value for key, value in kalibr.items() if key != "imu0"}
    heading = chain_heading("camera", source, outcome.verdict.passed, report)
    return kalibr_text(chain, heading)


def report_values(outcome: CameraCalibration) -> dict[str, Any]:
    """Return plain data: verdict, each camera, extrinsics, each view.

    covariance: of each camera's parameters and, with two, xi of T_cam1_cam0 Exp(xi).
    """
    verdict = outcome.verdict
    out: dict[str, Any] = {
        "passed": verdict.passed,
        "reasons": list(verdict.reasons),
        "views": len(outcome.views),
        "views_with_target": outcome.views_with_target,
        "corner_sigma_px": outcome.solution.sigma_px,
        "cameras": [_camera_values(outcome, cam) for cam in range(len(outcome.coverages))],
        "covariance": outcome.solution.covariance.tolist(),
        "outlier_views": [outcome.views[k].name for k in verdict.outlier_views],
        "per_view": [
            {
                "name": view.name,
                "rms_px": rms.tolist(),
                "corners": [len(detection) for detection in view.detections],
            }
            for view, rms in zip(outcome.views, verdict.view_rms, strict=True)
        ],
    }
    if len(outcome.coverages) == 2:
        state, sigmas = outcome.solution.state, outcome.solution.sigmas[-6:]
        out["T_cam1_cam0"] = state.T_cam1_cam0.tolist()
        out["epipolar_median_px"] = {"after": verdict.epipolar_px, "before": outcome.previous_epipolar_px}
        out["baseline_m"] = float(np.linalg.norm(state.T_cam1_cam0[:3, 3]))
        out["T_cam1_cam0_sigmas"] = {"rad": sigmas[:3].tolist(), "m": sigmas[3:].tolist()}
    return out


def _camera_values(outcome: CameraCalibration, cam: int) -> dict[str, Any]:
    state = outcome.solution.state
    camera, cover = state.cameras[cam], outcome.coverages[cam]
    sigmas = outcome.solution.sigmas[state.intrinsic_slices[cam]]
    return {
        "lens": camera.model,
        "parameters": dict(zip(parameter_names(camera), intrinsics(camera).tolist(), strict=True)),
        "sigmas": dict(zip(parameter_names(camera), sigmas.tolist(), strict=True)),
        "rms_px": outcome.verdict.rms_px[cam],
        "rms_all_px": outcome.verdict.rms_all_px[cam],
        "outlier_corners": outcome.verdict.outlier_corners[cam],
        "model_radius_px": outcome.model_radius(cam),
        "coverage": cover.share,
        "coverage_gaps": list(cover.gaps),
    }


def parameter_table(outcome: CameraCalibration) -> list[list[str]]:
    """Return rows for a terminal: each parameter with its sigma, beside the previous value."""
    state, rig = outcome.solution.state, outcome.previous_rig
    rows = [["", "", "value", "sigma", *(["before", "change"] if rig else [])]]
    for cam, camera in enumerate(state.cameras):
        before = _values_before(rig, cam, camera)
        sigmas = outcome.solution.sigmas[state.intrinsic_slices[cam]]
        for k, (name, value) in enumerate(zip(parameter_names(camera), intrinsics(camera), strict=True)):
            digits = 3 if k < 4 else 5
            row = [f"cam{cam}", name, f"{value:.{digits}f}", f"{sigmas[k]:.{digits}f}"]
            if rig:
                row += [f"{before[k]:.{digits}f}", f"{value - before[k]:+.{digits}f}"]
            rows.append(row)
    if len(state.cameras) == 2:
        rows.append(_baseline(outcome))
    return rows


def _values_before(rig: Rig | None, cam: int, camera: Camera) -> F64:
    """Return the previous values of a camera's parameters: NaN where unknown, also coefficients of another
    lens model; 0 for coefficients that it did not have."""
    out = np.full(len(parameter_names(camera)), np.nan)
    if rig is None or (previous := (rig.cam0, rig.cam1)[cam]) is None:
        return out
    if previous.model == camera.model:
        out[:] = 0.0
    known = min(len(out), len(intrinsics(previous))) if previous.model == camera.model else 4
    out[:known] = intrinsics(previous)[:known]
    return out


def _baseline(outcome: CameraCalibration) -> list[str]:
    T, previous_rig = outcome.solution.state.T_cam1_cam0, outcome.previous_rig
    sigma = float(np.linalg.norm(outcome.solution.sigmas[-3:]))
    row = ["both", "base mm", f"{1e3 * np.linalg.norm(T[:3, 3]):.3f}", f"{1e3 * sigma:.3f}"]
    if previous_rig and previous_rig.T_cam1_cam0 is not None:
        rotation_deg = np.degrees(se3.rotation_angle(se3.inverse(previous_rig.T_cam1_cam0) @ T))
        shift_mm = 1e3 * float(np.linalg.norm(T[:3, 3] - previous_rig.T_cam1_cam0[:3, 3]))
        row += [f"{1e3 * previous_rig.baseline:.3f}", f"{shift_mm:.3f} and {rotation_deg:.3f} deg"]
    elif previous_rig:
        row += ["", ""]
    return row


def draw_residuals(path: Path, outcome: CameraCalibration, title: str) -> None:
    """Write a PNG: of each camera the corners with their residuals (times 100), the residuals' scatter, and
    the RMS of each view."""
    cams = len(outcome.coverages)
    figure, panels = agg_pyplot().subplots(
        cams, 3, figsize=(14, 4 * cams), layout="constrained", squeeze=False, width_ratios=(1.6, 1, 1.6)
    )
    for cam, (corner_panel, scatter_panel, view_panel) in enumerate(panels):
        _draw_corners(corner_panel, outcome, cam)
        _draw_scatter(scatter_panel, outcome, cam)
        _draw_views(view_panel, outcome, cam)
    figure.suptitle(f"{title}: {'passed' if outcome.verdict.passed else 'FAILED'}")
    save_png(figure, path, 75)


def _draw_corners(panel: Any, outcome: CameraCalibration, cam: int) -> None:
    camera, coverage = outcome.solution.state.cameras[cam], outcome.coverages[cam]
    extent = (-0.5, camera.width - 0.5, camera.height - 0.5, -0.5)
    panel.imshow(np.minimum(coverage.cells, 40), cmap="YlGn", extent=extent, vmin=0, vmax=80, aspect="equal")
    px, r, inside = outcome.corners_of(cam)
    drawn = np.flatnonzero(inside)[:: 1 + int(inside.sum()) // _MAX_ARROWS]
    panel.quiver(*px[drawn].T, *r[drawn].T, angles="xy", scale_units="xy", scale=0.01, width=0.0015)
    panel.plot(*px[~inside].T, "x", color=_OUTLIER_COLOUR, markersize=4)
    panel.set(xlim=extent[:2], ylim=extent[2:])
    if (radius := outcome.model_radius(cam)) is not None:
        angles = np.linspace(0, 2 * np.pi, 200)
        panel.plot(
            camera.cx + radius * np.cos(angles),
            camera.cy + radius * np.sin(angles),
            "--",
            color=_OUTLIER_COLOUR,
            lw=1,
        )
    panel.set(title=f"cam{cam}: {coverage.share:.0%} of the image; residuals × 100, crosses: outliers")


def _draw_scatter(panel: Any, outcome: CameraCalibration, cam: int) -> None:
    r, verdict = camera_residuals(outcome.solution, cam), outcome.verdict
    limit = 6 * outcome.solution.sigma_px
    panel.plot(*r.T, ".", markersize=2, color=_INLIER_COLOUR, alpha=0.4)
    title = (
        f"{verdict.rms_px[cam]:.3f} px RMS, {verdict.rms_all_px[cam]:.3f} "
        f"with {verdict.outlier_corners[cam]} outliers"
    )
    panel.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal", xlabel="px", title=title)
    panel.grid(alpha=0.3)


def _draw_views(panel: Any, outcome: CameraCalibration, cam: int) -> None:
    rms = outcome.verdict.view_rms[:, cam]
    colours = np.where(outcome.verdict.is_outlier_view[:, cam], _OUTLIER_COLOUR, _INLIER_COLOUR)
    panel.bar(np.arange(len(rms)), np.nan_to_num(rms), color=colours)
    panel.set(title="RMS of each view, outliers red", xlabel="view", ylabel="px")
    panel.set_ylim(0, 1.2 * float(np.nanpercentile(rms, 95)) + 0.05)


def has_noise(chain: Path, noise: ImuNoise) -> bool:
    """Return whether an existing IMU chain has this noise."""
    try:
        return imu_noise(read_yaml(chain).section("imu0"), "update_rate") == noise
    except ConfigError:  # damaged, but perhaps the only copy
        return False


def has_target(file: Path, target: Target) -> bool:
    """Return whether an existing target file is of this target."""
    try:
        return read_target(file) == target
    except ConfigError:
        return False


# Uncertainty of a camchain's cameras, from the report of `share calibrate camera` beside it.

_TOLERANCE = 1e-9  # of numbers written to a file and read back


@dataclass(frozen=True, eq=False)
class RigUncertainty:
    """How well cameras are known. `covariance` (P, P) in the order of `CameraBundleSolution`, None where
    unknown. `source`: the report, or why there is none. `passed`: whether that calibration passed."""

    covariance: F64 | None
    source: str
    passed: bool = True


UNKNOWN_UNCERTAINTY = RigUncertainty(None, "the recording's calibration has no covariance")


def read_rig_uncertainty(chain: Path, rig: Rig) -> RigUncertainty:
    """Read the uncertainty of the cameras `rig`, which come from `chain`, from the report beside it. A report
    of other cameras is ignored.

    Raises DataError for a damaged report.
    """
    report = chain.with_name(REPORT)
    for path in (report, failed_path(report)):
        if path.is_file() and (uncertainty := _read_uncertainty(path, rig)):
            return uncertainty
    return RigUncertainty(None, f"no {REPORT} of these cameras beside {chain}")


def _read_uncertainty(path: Path, rig: Rig) -> RigUncertainty | None:
    report = read_json(path)
    try:
        if not _is_same_rig(report, rig):
            return None
        covariance = np.array(report["covariance"], np.float64)
        passed = bool(report["passed"])
    except (KeyError, TypeError, ValueError):
        return None if "covariance" not in report else _raise_damaged(path)
    size = rig_size(_cameras(rig))
    if covariance.shape != (size, size) or not np.isfinite(covariance).all():
        return _raise_damaged(path)
    return RigUncertainty(covariance, str(path), passed)


def _raise_damaged(path: Path) -> RigUncertainty:
    raise DataError(f"{path}: is damaged; calibrate the cameras again, or move it away")


def _cameras(rig: Rig) -> list[Camera]:
    return [camera for camera in (rig.cam0, rig.cam1) if camera is not None]


def _is_same_rig(report: dict[str, Any], rig: Rig) -> bool:
    """Return whether a report is of exactly these cameras."""
    cameras = _cameras(rig)
    if len(report["cameras"]) != len(cameras):
        return False
    if any(
        one.get("lens", RADTAN) != camera.model
        for one, camera in zip(report["cameras"], cameras, strict=True)
    ):
        return False
    pairs = [
        ([one["parameters"][name] for name in parameter_names(camera)], intrinsics(camera))
        for one, camera in zip(report["cameras"], cameras, strict=True)
    ]
    if rig.T_cam1_cam0 is not None:
        pairs.append((report["T_cam1_cam0"], rig.T_cam1_cam0))
    return all(np.allclose(a, b, rtol=_TOLERANCE, atol=_TOLERANCE) for a, b in pairs)
