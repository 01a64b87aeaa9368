"""A field recording that is none: devices of an emulated room, their clocks set anew, watched by a motion
capture whose world is tilted and whose bodies sit askew. It exports as Vicon does."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from share.geometry import se3
from share.lab.emulate.recipe import SessionRecipe, no_progress
from share.lab.emulate.stage import prepare_session
from share.lab.emulate.types import MotionPath as Motion
from share.recordings.mcap.recorder import Recorder
from share.runtime.source import open_source
from share.types import F64

RATE_HZ = 120
FIRST = 1200  # the first frame: the motion capture began to count 10 s before the devices
TILT = se3.exp(np.radians([0.3, -0.5, 0.0, 0, 0, 0]))  # T_mocap_world
_HEAD = ("RX", "RY", "RZ", "TX", "TY", "TZ")


@dataclass(frozen=True, eq=False)
class Watched:
    """One device: how its body sits (T_body_mocap), by how much its clock is ahead of the emulation's, and
    when (s) it is hidden."""

    T_body_mocap: F64
    clock_ns: int = 0
    hidden: tuple[tuple[float, float], ...] = ()


def paths(recipe: SessionRecipe, room: Path) -> dict[str, Motion]:
    return {actor.name: actor.path for actor in prepare_session(recipe, room, no_progress).stage.actors}


def offset_of(path: Motion, watched: Watched) -> int:
    """The device's clock minus the motion capture's, ns, as `export` has it."""
    return path.start_ns + watched.clock_ns - round(FIRST * 1e9 / RATE_HZ)


def reclocked(source: Path, out: Path, clock_ns: int) -> Path:
    """The recording by a clock that is ahead by so much."""
    opened = open_source(str(source))
    with Recorder(out, opened.rig) as recorder:
        for measurement in opened.measurements():
            recorder.write(replace(measurement, stamp_ns=measurement.stamp_ns + clock_ns))
    return out


def seen(path: Motion, watched: Watched, sigma: tuple[float, float], seed: int) -> F64:
    """T_mocap_body (N, 4, 4), a pose a frame, NaN where it is hidden. sigma: m, rad."""
    frames = np.arange((path.end_ns - path.start_ns) * RATE_HZ // 10**9)
    true_ns = path.start_ns + np.round(frames * 1e9 / RATE_HZ).astype(np.int64)
    rng, n = np.random.default_rng((seed, 3)), len(true_ns)
    T = TILT @ path.poses(true_ns) @ watched.T_body_mocap
    T = T @ se3.exp(
        np.concatenate([rng.normal(0, sigma[1], (n, 3)), rng.normal(0, sigma[0], (n, 3))], axis=1)
    )
    t = (true_ns - path.start_ns) * 1e-9
    for start, end in watched.hidden:
        T[(t > start) & (t < end)] = np.nan
    return T


def export(path: Path, bodies: dict[str, F64], quaternions: bool = False) -> Path:
    """Vicon's CSV: degrees (helical) and millimetres, or quaternions and metres."""
    names, units = _HEAD, ("deg",) * 3 + ("mm",) * 3
    if quaternions:
        names, units = ("RX", "RY", "RZ", "RW", "TX", "TY", "TZ"), ("",) * 4 + ("m",) * 3
    blank = "," * (len(names) - 1)
    lines = [
        "Objects",
        str(RATE_HZ),
        ",," + ",".join(f"{name}:{name}{blank}" for name in bodies),
        "Frame,Sub Frame," + ",".join([*names] * len(bodies)),
        ",," + ",".join([*units] * len(bodies)),
    ]
    columns = [_cells(T, quaternions) for T in bodies.values()]
    for frame in range(max(map(len, columns))):
        cells = [column[frame] if frame < len(column) else blank for column in columns]
        lines.append(f"{FIRST + frame},0," + ",".join(cells))
    path.write_text("\n".join(lines) + "\n")
    return path


def export_motive(path: Path, bodies: dict[str, F64]) -> Path:
    """Motive's CSV: quaternions and metres, y up."""
    n, lying = len(bodies), se3.exp(np.array([-np.pi / 2, 0, 0, 0, 0, 0]))
    lines = [
        "Format Version,1.23,Take Name,x,Capture Frame Rate,120.000000,Rotation Type,Quaternion,Length Units,"
        "Meters,Coordinate Space,Global",
        "",
        ",Type," + ",".join(["Rigid Body"] * 7 * n),
        ",Name," + ",".join(name for name in bodies for _ in range(7)),
        ",ID," + ",".join(str(k) for k in range(n) for _ in range(7)),
        ",," + ",".join((["Rotation"] * 4 + ["Position"] * 3) * n),
        "Frame,Time (Seconds)," + ",".join(["X,Y,Z,W,X,Y,Z"] * n),
    ]
    columns = [_cells(lying @ T, True) for T in bodies.values()]
    for frame in range(max(map(len, columns))):
        cells = [column[frame] if frame < len(column) else "," * 6 for column in columns]
        lines.append(f"{frame},{frame / RATE_HZ:.6f}," + ",".join(cells))
    path.write_text("\n".join(lines) + "\n")
    return path


def _cells(T: F64, quaternions: bool) -> list[str]:
    """A body's part of each line."""
    gone = np.isnan(T[:, 0, 3])
    R = np.where(gone[:, None, None], np.eye(3), T[:, :3, :3])
    turn = se3.quat_from_matrix(R) if quaternions else np.degrees(se3.so3_log(R))
    rows = np.concatenate([turn, T[:, :3, 3] * (1 if quaternions else 1000)], axis=1)
    hidden = "," * (rows.shape[1] - 1)
    return [
        hidden if lost else ",".join(f"{x:.6g}" for x in row) for lost, row in zip(gone, rows, strict=True)
    ]
