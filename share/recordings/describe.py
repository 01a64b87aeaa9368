"""Describe a recording as plain data, for `share dataset info`."""

from __future__ import annotations

from typing import Any

import numpy as np

from share.geometry.camera import Camera, Rig
from share.recordings.message_file import MessageFile
from share.recordings.recording import Source
from share.sensors.stamps import GAP_FACTOR
from share.types import I64


def describe_recording(source: Source) -> dict[str, Any]:
    """Return streams with counts, rates and gaps, the calibration and ground truth. Reads no images."""
    stamps = source.stamps()
    first = min((int(s[0]) for s in stamps.values() if len(s)), default=0)
    last = max((int(s.max()) for s in stamps.values() if len(s)), default=0)
    return {
        "name": source.name,
        "kind": source.rig.kind,
        "serial": source.serial,
        "duration_s": (last - first) / 1e9,
        "start_ns": first,
        "streams": {name: describe_stream(s) for name, s in stamps.items()},
        "calibration": describe_rig(source.rig),
        "truth": _truth(source),
        "notes": [*source.notes, *source.losses.lines()],
    }


def describe_messages(file: MessageFile, why: str) -> dict[str, Any]:
    """Return the topics of a file of ROS messages, with counts, rates and gaps by their log times, where it
    cannot be opened as a recording. why: the reason, such as a missing calibration."""
    times = {name: stamps for name, stamps in file.log_times.items() if len(stamps)}
    first = min((int(stamps[0]) for stamps in times.values()), default=0)
    last = max((int(stamps[-1]) for stamps in times.values()), default=0)
    return {
        "name": file.path.resolve().stem,
        "kind": "messages",
        "serial": None,
        "duration_s": (last - first) / 1e9,
        "start_ns": first,
        "topics": {
            name: {"type": file.topics[name].kind, **describe_stream(stamps)}
            for name, stamps in sorted(times.items())
        },
        "calibration": None,
        "truth": None,
        "notes": [why],
    }


def describe_stream(stamps: I64) -> dict[str, Any]:
    """Return count, median rate, gaps longer than 2.5 median steps, repeated and decreasing stamps."""
    steps = np.diff(stamps)
    forward = steps[steps > 0]
    median = float(np.median(forward)) if len(forward) else 0.0
    gaps = forward[forward > GAP_FACTOR * median]
    return {
        "count": len(stamps),
        "rate_hz": round(1e9 / median, 3) if median else 0.0,
        "gaps": len(gaps),
        "longest_gap_s": round(float(gaps.max()) / 1e9, 6) if len(gaps) else 0.0,
        "duplicates": int((steps == 0).sum()),
        "backward": int((steps < 0).sum()),
    }


def describe_rig(rig: Rig) -> dict[str, Any]:
    """Return the cameras (resolution, intrinsics, field of view, baseline) and the IMU of a rig."""
    out: dict[str, Any] = {name: _camera(camera) for name, camera in rig.cameras.items()}
    if rig.cam1:
        out["baseline_m"] = round(rig.baseline, 6)
    if rig.imu:
        out["imu"] = {name: getattr(rig.imu, name) for name in rig.imu.__dataclass_fields__}
        out["timeshift_s"] = rig.timeshift_s
    return out


def _camera(camera: Camera) -> dict[str, Any]:
    return {
        "resolution": [camera.width, camera.height],
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "distortion": list(camera.distortion),
        "lens": camera.model,
        "fov_deg": round(float(np.degrees(camera.field_of_view_rad[0])), 1),
    }


def _truth(source: Source) -> dict[str, Any] | None:
    truth = source.truth()
    if truth is None:
        return None
    return {
        "poses": len(truth.stamps_ns),
        "length_m": round(truth.length_m, 3),
        "duration_s": float(truth.stamps_ns[-1] - truth.stamps_ns[0]) / 1e9,
    }
