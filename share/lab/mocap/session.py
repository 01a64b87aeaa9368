"""Write a session from field recordings: recordings, ground truths, results of the alignment, a picture.

Stamps in a device's recording and truth stay in its own clock; `clock_offset_ns` relates them to the motion
capture's clock, which is the session's.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from share import __version__
from share.colours import agent_colour, hex_colour
from share.files.json_file import nan_to_none
from share.files.writing import atomic_write
from share.geometry import se3
from share.lab.evaluate.charts import agg_pyplot, save_png
from share.lab.mocap.align import AlignedDevice, common_level
from share.lab.mocap.offset import WINDOW_NS, imu_rotations, mocap_rotations
from share.lab.mocap.verdict import shared_sigmas
from share.recordings.calibration import to_kalibr
from share.recordings.convert import StageProgress, stage_progress, write_recording
from share.recordings.recording import Source
from share.recordings.session import SCHEMA, SESSION_FILE
from share.recordings.trajectory import Trajectory, format_tum
from share.types import F64, I64, AgentKind

REPORT, PICTURE = "align.json", "align.png"
_PROVENANCE_KEYS = ("mocap", "offset_sigma_ms", "drift_ppm", "up", "truth_s")  # the rest is in REPORT


@dataclass(frozen=True, eq=False)
class AlignedRecording:
    """One device in the room. recording: a file that can be used unchanged, None to write it anew.
    mocap_source: the motion capture's file and body, for readers. inputs: recording, calibration and
    mounting as given, for readers."""

    kind: AgentKind
    source: Source
    recording: Path | None
    mocap_source: str
    inputs: Mapping[str, str]
    aligned: AlignedDevice


def write_session(
    folder: Path,
    devices: Mapping[str, AlignedRecording],
    settings: Mapping[str, Any],
    on_progress: StageProgress,
) -> dict[str, Any]:
    """Fill the empty `folder`; return the results by device. settings: of the fit, for the provenance.
    Raises ShareError."""
    R_mocap_world = common_level([device.aligned.fit for device in devices.values()])
    truths = {
        name: Trajectory(device.aligned.stamps_ns, device.aligned.truth(R_mocap_world))
        for name, device in devices.items()
    }
    (folder / "truth").mkdir()
    for name, device in devices.items():
        _write_device_recording(device, folder / f"{name}.mcap", on_progress)
        atomic_write(folder / "truth" / f"{name}.tum", format_tum(truths[name]))
    results: dict[str, Any] = nan_to_none({name: device_result(device) for name, device in devices.items()})
    draw_alignment(folder / PICTURE, {name: (d.aligned, truths[name]) for name, d in devices.items()})
    atomic_write(folder / REPORT, json.dumps(results, indent=1) + "\n")
    atomic_write(folder / SESSION_FILE, _session_yaml(devices, results, settings))
    return results


def device_result(device: AlignedRecording) -> dict[str, Any]:
    """Return the results of one device as plain data."""
    aligned, fit = device.aligned, device.aligned.fit
    sigma, gaps = shared_sigmas(fit), (fit.gaps - fit.stamps_ns[0]) * 1e-9
    mounting_rotation = se3.so3_log(fit.T_body_mocap[:3, :3])
    return {
        "kind": device.kind.value,
        "source": device.source.name,
        "mocap": device.mocap_source,
        "offset_ns": aligned.offset_ns,
        "offset_sigma_ms": float(sigma[8] * 1e3),
        "drift_ppm": fit.drift_ppm,
        "correlation": aligned.peak.correlation,
        "next_correlation": aligned.peak.next_correlation,
        "lead": aligned.peak.lead,
        "T_body_mocap": fit.T_body_mocap.tolist(),
        "mounting_rotation_deg": float(np.degrees(np.linalg.norm(mounting_rotation))),
        "mounting_rotation_sigma_deg": float(np.degrees(sigma[2:5].max())),
        "mounting_translation_mm": float(np.linalg.norm(fit.T_body_mocap[:3, 3]) * 1e3),
        "mounting_translation_sigma_mm": float(sigma[5:8].max() * 1e3),
        "up": fit.up,
        "tilt_deg": fit.tilt_deg,
        "scale_error_percent": (100 * fit.scale_error).tolist(),
        "scale_error_sigma_percent": (100 * fit.scale_error_sigma).tolist(),
        "residual_mm": fit.residuals.position_mm,
        "residual_deg": fit.residuals.rotation_deg,
        "residual_sigmas": fit.residuals.position_sigmas,
        "outlier_share": fit.residuals.outlier_share,
        "truth_s": aligned.seconds,
        "gaps_s": gaps.tolist(),
        "warnings": aligned.warnings,
    }


def _write_device_recording(device: AlignedRecording, out: Path, on_progress: StageProgress) -> None:
    """Link the recording under its new name, or copy it where the disk does not allow links."""
    stage = f"writing {out.stem}"
    if device.recording is None:
        write_recording(
            device.source, out, None, stage_progress(on_progress, stage, device.source.images_count)
        )
        return
    on_progress(stage, 0, 1)
    try:
        os.link(device.recording.resolve(), out)
    except OSError:  # another disk, or another owner's file
        shutil.copyfile(device.recording, out)
    on_progress(stage, 1, 1)


def _session_yaml(
    devices: Mapping[str, AlignedRecording], results: dict[str, Any], settings: Mapping[str, Any]
) -> str:
    """Return the text of session.yaml."""
    import yaml

    agents = {
        name: {
            "kind": device.kind.value,
            "sensors": device.source.rig.kind,
            "rate_hz": device.source.rate_hz,
            "clock_offset_ns": device.aligned.offset_ns,
            "calibration": to_kalibr(device.source.rig),
        }
        for name, device in devices.items()
    }
    provenance = {
        "generator": "share dataset align",
        "share_version": __version__,
        "settings": dict(settings),
        "devices": {
            name: {**devices[name].inputs} | {key: one[key] for key in _PROVENANCE_KEYS}
            for name, one in results.items()
        },
    }
    data = {"schema": SCHEMA, "provenance": provenance, "agents": agents}
    return str(yaml.safe_dump(data, sort_keys=False, default_flow_style=None))


# Picture: paths from above, and rotation rates of IMU and mocap in one clock.

_PLOTTED_NS = 10 * 10**9  # of the rotation rates; in a longer plot their agreement is not visible
_GAP_NS = 100_000_000  # no line across longer gaps


def draw_alignment(path: Path, devices: Mapping[str, tuple[AlignedDevice, Trajectory]]) -> None:
    """Write a PNG of {name: (device, its truth)}."""
    figure = agg_pyplot().figure(figsize=(13, max(5.0, 1.9 * len(devices))), layout="constrained")
    grid = figure.add_gridspec(len(devices), 2, width_ratios=(2, 3))
    top_view = figure.add_subplot(grid[:, 0])
    for k, (name, (aligned, truth)) in enumerate(devices.items()):
        colour = hex_colour(agent_colour(k))
        p = np.insert(truth.T[:, :3, 3], _after_gaps(truth.stamps_ns), np.nan, axis=0)
        top_view.plot(p[:, 0], p[:, 1], color=colour, linewidth=1.2, label=f"{name}, {aligned.seconds:.1f} s")
        top_view.plot(*p[0, :2], "o", color=colour)
        _draw_rotation_rates(figure.add_subplot(grid[k, 1]), name, aligned, colour)
    top_view.set(title="truth from above", xlabel="x [m]", ylabel="y [m]")
    top_view.set_aspect("equal", adjustable="datalim")
    top_view.grid(alpha=0.3)
    top_view.legend()
    save_png(figure, path, 110)


def _after_gaps(stamps_ns: I64) -> I64:
    return np.flatnonzero(np.diff(stamps_ns) > _GAP_NS) + 1


def _draw_rotation_rates(axes: Any, name: str, aligned: AlignedDevice, colour: str) -> None:
    """Draw both rotation rates in the motion capture's clock, where they vary most."""
    imu_times, imu_rates = _rotation_rates(*imu_rotations(aligned.imu))
    imu_times = imu_times - aligned.offset_ns
    times, mocap_rates = _rotation_rates(*mocap_rotations(aligned.mocap))
    start = _most_varied_start(times, mocap_rates)
    for stamps, rate, style in (
        (imu_times, imu_rates, {"color": colour, "linewidth": 2.5, "alpha": 0.5, "label": "gyro"}),
        (times, mocap_rates, {"color": "black", "linewidth": 0.8, "label": "motion capture"}),
    ):
        keep = (stamps >= start) & (stamps <= start + _PLOTTED_NS)
        holes = _after_gaps(stamps[keep])
        axes.plot(
            np.insert(stamps[keep] * 1e-9, holes, np.nan), np.insert(rate[keep], holes, np.nan), **style
        )
    axes.set(title=name, ylabel="rotation rate [rad/s]", xlabel="motion capture's clock [s]")
    axes.ticklabel_format(useOffset=False)
    axes.grid(alpha=0.3)
    axes.set_ylim(0, 1.35 * axes.get_ylim()[1])  # room for the legend
    axes.legend(loc="upper right", ncols=2, frameon=False)


def _rotation_rates(stamps: I64, rotations: F64) -> tuple[I64, F64]:
    return stamps, np.linalg.norm(rotations, axis=1) / (WINDOW_NS * 1e-9)


def _most_varied_start(stamps: I64, rate: F64) -> int:
    """Return the start of the window in which the rate varies most."""
    width = max(1, int(np.searchsorted(stamps, stamps[0] + _PLOTTED_NS)))
    first, second = (np.cumsum(np.append(0.0, values)) for values in (rate, rate**2))
    n = max(1, len(rate) - width)
    mean = (first[width : width + n] - first[:n]) / width
    return int(stamps[int(((second[width : width + n] - second[:n]) / width - mean**2).argmax())])
