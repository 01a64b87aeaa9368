"""What `share calibrate camera` leaves behind: Kalibr's chain, a report, a picture."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from share.errors import ConfigError, DataError
from share.files.json_file import read_json
from share.files.yaml_file import read_yaml
from share.geometry import se3
from share.geometry.camera import Camera, ImuNoise, Rig
from share.geometry.lens import RADTAN
from share.lab.calibrate.camera_bundle import Solution, View, shared
from share.lab.calibrate.camera_start import intrinsics, names
from share.lab.calibrate.camera_verdict import Coverage, Verdict, residuals
from share.lab.calibrate.corners import kept, reach
from share.lab.calibrate.target import Target, read_target
from share.recordings.calibration import CAMCHAIN, Calibration, imu_noise, to_kalibr
from share.types import F64

REPORT, PICTURE = "camera-report.json", "camera-report.png"
_ARROWS = 1500  # more hide each other


@dataclass(frozen=True, eq=False)
class Outcome:
    """All that is told of one calibration. before: the cameras that the source came with; seen: views with
    the target among all pictures looked at; pair_before_px: as the verdict's, by `before`; said: the
    calibration that was given; serial: of the device."""

    views: Sequence[View]
    solution: Solution
    covers: tuple[Coverage, ...]
    verdict: Verdict
    before: Rig | None
    seen: int
    pair_before_px: float | None = None
    said: Calibration | None = None
    serial: str | None = None

    def seen_by(self, eye: int) -> tuple[F64, F64, np.ndarray]:
        """Corners (N, 2) px of a camera, their residuals (N, 2) and which (N,) were kept."""
        r = residuals(self.solution, eye)
        px = np.concatenate([view.seen[eye].px for view in self.views])
        return px, r, kept(r, self.solution.sigma_px)

    def reach(self, eye: int) -> float | None:
        """`corners.reach` of a camera, from its principal point."""
        px, _, inside = self.seen_by(eye)
        camera = self.solution.state.cameras[eye]
        return reach(px, np.array([camera.cx, camera.cy]), inside)

    @property
    def rig(self) -> Rig:
        """The new cameras; where the body's IMU sits on cam0 is kept from before."""
        state = self.solution.state
        two = len(state.cameras) == 2
        rig = self.before or Rig(cam0=state.cameras[0], T_body_cam0=np.eye(4))
        return replace(
            rig,
            cam0=state.cameras[0],
            cam1=state.cameras[1] if two else None,
            T_cam1_cam0=state.T_cam1_cam0 if two else None,
        )


def kalibr_text(outcome: Outcome, source: str, report: str) -> str:
    """The camchain, with what was given of how the cameras sit on an IMU. The IMU's own noise is of another
    file, `share calibrate imu` writes it. report: the name of the file that says why it failed."""
    told = to_kalibr(outcome.rig, outcome.said, outcome.serial)
    chain = {key: value for key, value in told.items() if key != "imu0"}
    if "T_cam_imu" in chain["cam0"] and "cam1" in chain:  # by the new pair
        T_cam1_cam0 = np.array(chain["cam1"]["T_cn_cnm1"])
        chain["cam1"]["T_cam_imu"] = (T_cam1_cam0 @ chain["cam0"]["T_cam_imu"]).tolist()
    verdict = "passed" if outcome.verdict.passed else f"FAILED, see {report}"
    return f"# share calibrate camera {source}: {verdict}\n" + yaml.safe_dump(
        chain, sort_keys=False, default_flow_style=None
    )


def to_json(outcome: Outcome) -> dict[str, Any]:
    """Plain data: verdict, each camera, the mounting, each view. covariance: of the parameters of each camera
    and, of two, xi of T_cam1_cam0 Exp(xi)."""
    verdict = outcome.verdict
    out: dict[str, Any] = {
        "passed": verdict.passed,
        "reasons": list(verdict.reasons),
        "views": len(outcome.views),
        "views_with_target": outcome.seen,
        "corner_sigma_px": outcome.solution.sigma_px,
        "cameras": [_camera(outcome, eye) for eye in range(len(outcome.covers))],
        "covariance": outcome.solution.covariance.tolist(),
        "outlier_views": [outcome.views[k].name for k in verdict.outliers],
        "per_view": [
            {"name": view.name, "rms_px": rms.tolist(), "corners": [len(seen) for seen in view.seen]}
            for view, rms in zip(outcome.views, verdict.view_rms, strict=True)
        ],
    }
    if len(outcome.covers) == 2:
        state, sigmas = outcome.solution.state, outcome.solution.sigmas[-6:]
        out["T_cam1_cam0"] = state.T_cam1_cam0.tolist()
        out["epipolar_median_px"] = {"found": verdict.pair_px, "before": outcome.pair_before_px}
        out["baseline_m"] = float(np.linalg.norm(state.T_cam1_cam0[:3, 3]))
        out["T_cam1_cam0_sigmas"] = {"rad": sigmas[:3].tolist(), "m": sigmas[3:].tolist()}
    return out


def _camera(outcome: Outcome, eye: int) -> dict[str, Any]:
    state = outcome.solution.state
    camera, cover, sigmas = state.cameras[eye], outcome.covers[eye], outcome.solution.sigmas[state.parts[eye]]
    return {
        "lens": camera.model,
        "parameters": dict(zip(names(camera), intrinsics(camera).tolist(), strict=True)),
        "sigmas": dict(zip(names(camera), sigmas.tolist(), strict=True)),
        "rms_px": outcome.verdict.rms_px[eye],
        "rms_all_px": outcome.verdict.rms_all_px[eye],
        "corners_left_out": outcome.verdict.wrong[eye],
        "lens_fits_to_px": outcome.reach(eye),
        "covered": cover.share,
        "missing": list(cover.missing),
    }


def table(outcome: Outcome) -> list[list[str]]:
    """Rows for a terminal: each parameter with its sigma, beside what was before."""
    state, before = outcome.solution.state, outcome.before
    rows = [["", "", "found", "sigma", *(["before", "change"] if before else [])]]
    olds = (before.cam0, before.cam1) if before else (None, None)
    for eye, camera in enumerate(state.cameras):
        old, sigmas = olds[eye], outcome.solution.sigmas[state.parts[eye]]
        had = {} if old is None else dict(zip(names(old), intrinsics(old).tolist(), strict=True))
        same = old is not None and old.model == camera.model
        for k, (name, value) in enumerate(zip(names(camera), intrinsics(camera).tolist(), strict=True)):
            sigma = sigmas[k]
            digits = 3 if k < 4 else 5
            row = [f"cam{eye}", name, f"{value:.{digits}f}", f"{sigma:.{digits}f}"]
            if before:
                was = had.get(name, 0.0) if same or (old is not None and k < 4) else float("nan")
                row += [f"{was:.{digits}f}", f"{value - was:+.{digits}f}"]
            rows.append(row)
    if len(state.cameras) == 2:
        rows.append(_baseline(outcome))
    return rows


def _baseline(outcome: Outcome) -> list[str]:
    T, before = outcome.solution.state.T_cam1_cam0, outcome.before
    sigma = float(np.linalg.norm(outcome.solution.sigmas[-3:]))
    row = ["both", "base mm", f"{1e3 * np.linalg.norm(T[:3, 3]):.3f}", f"{1e3 * sigma:.3f}"]
    if before and before.T_cam1_cam0 is not None:
        turn = np.degrees(se3.angle(se3.inverse(before.T_cam1_cam0) @ T))
        way = 1e3 * float(np.linalg.norm(T[:3, 3] - before.T_cam1_cam0[:3, 3]))
        row += [f"{1e3 * before.baseline:.3f}", f"{way:.3f} and {turn:.3f} deg"]
    elif before:
        row += ["", ""]
    return row


def picture(outcome: Outcome, title: str) -> bytes:
    """PNG: of each camera where corners were seen and which way they miss (times 100), how the residuals
    scatter, and the RMS of each view."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    eyes = len(outcome.covers)
    figure, panels = pyplot.subplots(
        eyes, 3, figsize=(14, 4 * eyes), layout="constrained", squeeze=False, width_ratios=(1.6, 1, 1.6)
    )
    for eye, (where, scatter, bars) in enumerate(panels):
        _draw_where(where, outcome, eye)
        _draw_scatter(scatter, outcome, eye)
        _draw_views(bars, outcome, eye)
    figure.suptitle(f"{title}: {'passed' if outcome.verdict.passed else 'FAILED'}")
    out = io.BytesIO()
    figure.savefig(out, dpi=75, format="png")
    pyplot.close(figure)
    return out.getvalue()


def _draw_where(panel: Any, outcome: Outcome, eye: int) -> None:
    camera, cover = outcome.solution.state.cameras[eye], outcome.covers[eye]
    extent = (-0.5, camera.width - 0.5, camera.height - 0.5, -0.5)
    panel.imshow(np.minimum(cover.cells, 40), cmap="YlGn", extent=extent, vmin=0, vmax=80, aspect="equal")
    px, r, inside = outcome.seen_by(eye)
    some = np.flatnonzero(inside)[:: 1 + int(inside.sum()) // _ARROWS]
    panel.quiver(*px[some].T, *r[some].T, angles="xy", scale_units="xy", scale=0.01, width=0.0015)
    panel.plot(*px[~inside].T, "x", color="#d1495b", markersize=4)
    panel.set(xlim=extent[:2], ylim=extent[2:])
    if (radius := outcome.reach(eye)) is not None:
        turn = np.linspace(0, 2 * np.pi, 200)
        panel.plot(
            camera.cx + radius * np.cos(turn), camera.cy + radius * np.sin(turn), "--", color="#d1495b", lw=1
        )
    panel.set(title=f"cam{eye}: {cover.share:.0%} of the image; residuals × 100, × left out")


def _draw_scatter(panel: Any, outcome: Outcome, eye: int) -> None:
    r, told = residuals(outcome.solution, eye), outcome.verdict
    limit = 6 * outcome.solution.sigma_px
    panel.plot(*r.T, ".", markersize=2, color="#00798c", alpha=0.4)
    title = f"{told.rms_px[eye]:.3f} px RMS, {told.rms_all_px[eye]:.3f} with {told.wrong[eye]} left out"
    panel.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal", xlabel="px", title=title)
    panel.grid(alpha=0.3)


def _draw_views(panel: Any, outcome: Outcome, eye: int) -> None:
    rms = outcome.verdict.view_rms[:, eye]
    colours = ["#d1495b" if far else "#00798c" for far in outcome.verdict.outlying[:, eye]]
    panel.bar(np.arange(len(rms)), np.nan_to_num(rms), color=colours)
    panel.set(title="each view's RMS, outliers red", xlabel="view", ylabel="px")
    panel.set_ylim(0, 1.2 * float(np.nanpercentile(rms, 95)) + 0.05)


# ---- Files of an earlier calibration in the folder that a new one writes to: none that is better is lost.

_FAILED = ".failed"


def places(out: Path, passed: bool, *names: str) -> tuple[Path, ...]:
    """Where files of one calibration go: under their names in `out`; or, if it is not to be believed and any
    of them is there already, all beside them, as NAME.failed.EXT."""
    paths = tuple(out / name for name in names)
    kept = not passed and any(path.exists() for path in paths)
    return tuple(failed(path) for path in paths) if kept else paths


def failed(path: Path) -> Path:
    """NAME.failed.EXT."""
    return path.with_name(path.stem + _FAILED + path.suffix)


def written(chain: Path) -> str:
    """What `places` came to for a camchain, for a person."""
    return f"{chain} is written" + (
        "" if chain.name == CAMCHAIN else f"; {CAMCHAIN} is kept as it was, and its report"
    )


def says_noise(chain: Path, noise: ImuNoise) -> bool:
    """Whether an IMU chain, which is there, is of this noise."""
    try:
        return imu_noise(read_yaml(chain).section("imu0"), "update_rate") == noise
    except ConfigError:  # damaged, and perhaps the only one of its kind
        return False


def says_target(file: Path, target: Target) -> bool:
    """Whether a target's file, which is there, is of this target."""
    try:
        return read_target(file) == target
    except ConfigError:
        return False


# ---- How far the cameras of a camchain may be off, by what `share calibrate camera` left beside it.

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
