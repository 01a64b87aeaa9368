"""Export a map for other programs: trajectories as TUM, points as PLY, loops as CSV; and describe it as
data."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from share.colours import agent_colour
from share.errors import UsageError
from share.files.sqlite_file import wal_path
from share.files.writing import atomic_write, new_folder, open_new, write_errors
from share.geometry import se3
from share.mapping.loops import KeyframeKey, Loop
from share.mapping.map_changes import StoredKeyframe, StoredMap, map_poses
from share.recordings.exports.names import distinct_file_names, map_folders
from share.recordings.exports.scene import known_points
from share.recordings.trajectory import Trajectory, format_tum
from share.store.map_store import MapStore
from share.types import F64


@dataclass(frozen=True)
class ExportResult:
    """Result for one map: its folder, the file names of its agents, and counts."""

    folder: Path
    agents: tuple[str, ...]
    keyframes: int
    points: int
    loops: int


def export_map(stored_map: StoredMap, out: Path, progress: Callable[[int], None]) -> dict[str, ExportResult]:
    """Write the maps to `out`, a new folder; several maps each to a subfolder. On error nothing is left.

    Each gets NAME.tum (body poses of the keyframes in the map), points.ply and loops.csv. progress: called
    with 1 for each keyframe. Raises UsageError if the map is empty or `out` is not; ShareError.
    """
    if not stored_map.keyframes:
        raise UsageError("the map is empty: there is nothing to export")
    with new_folder(out) as work:
        done = _write_all(stored_map, work, progress)
    return {name: _with_final_folder(e, work, out) for name, e in done.items()}


def file_names(stored_map: StoredMap) -> dict[str, str]:
    """Return file names by run: the agent's name, or the run's key if the name is not unique or is a key."""
    names = Counter(run.hello.name for run in stored_map.runs)
    keys = {run.run_key for run in stored_map.runs}
    return {
        run.run_key: run.run_key if names[run.hello.name] > 1 or run.hello.name in keys else run.hello.name
        for run in stored_map.runs
    }


def _write_all(stored_map: StoredMap, work: Path, progress: Callable[[int], None]) -> dict[str, ExportResult]:
    poses = map_poses(stored_map)
    by_map: dict[str, list[StoredKeyframe]] = {}
    for keyframe in stored_map.keyframes:
        by_map.setdefault(poses[keyframe.keyframe_key][0], []).append(keyframe)
    done, folders = {}, map_folders(work, list(by_map))
    for name, keyframes in by_map.items():
        folder = folders[name]
        T = {k.keyframe_key: poses[k.keyframe_key][1] for k in keyframes}
        loops = [x for x in stored_map.loops if x.a in T and x.b in T]
        _write_loops(folder / "loops.csv", loops)
        agents = _write_trajectories(stored_map, keyframes, T, folder)
        points = write_ply(folder / "points.ply", _point_clouds(stored_map, keyframes, T, progress))
        done[name] = ExportResult(folder, agents, len(keyframes), points, len(loops))
    return done


def _write_trajectories(
    stored_map: StoredMap, keyframes: list[StoredKeyframe], T: dict[KeyframeKey, F64], folder: Path
) -> tuple[str, ...]:
    names = file_names(stored_map)
    by_run: dict[str, list[StoredKeyframe]] = {}
    for keyframe in keyframes:
        by_run.setdefault(keyframe.run_key, []).append(keyframe)
    files = distinct_file_names(names[run] for run in by_run)
    for run, own in by_run.items():
        own.sort(key=lambda k: k.keyframe.stamp_ns)
        stamps = np.array([k.keyframe.stamp_ns for k in own], np.int64)
        text = format_tum(Trajectory(stamps, np.array([T[k.keyframe_key] for k in own])))
        atomic_write(folder / f"{files[names[run]]}.tum", text)
    return tuple(names[run] for run in by_run)


def _point_clouds(
    stored_map: StoredMap,
    keyframes: list[StoredKeyframe],
    T: dict[KeyframeKey, F64],
    progress: Callable[[int], None],
) -> Iterator[tuple[F64, Colour]]:
    """Yield each keyframe's points in the map frame, (N, 3), and its agent's colour."""
    runs = {
        run.run_key: (run.hello.rig.T_body_cam0, agent_colour(i)) for i, run in enumerate(stored_map.runs)
    }
    for keyframe in keyframes:
        T_body_cam0, colour = runs[keyframe.run_key]
        points = known_points(keyframe.keyframe.points)
        yield se3.transform(T[keyframe.keyframe_key] @ T_body_cam0, points), colour
        progress(1)


def _write_loops(path: Path, loops: list[Loop]) -> None:
    """Write loops: keyframes a and b by run and id; pose of b's body in a's, m and quaternion; inliers."""
    lines = ["a_run,a,b_run,b,x,y,z,qx,qy,qz,qw,inliers"]
    for loop in loops:
        numbers = (*loop.T_a_b[:3, 3], *se3.quat_from_matrix(loop.T_a_b[:3, :3]))
        pose_text = ",".join(f"{value:.9f}" for value in numbers)
        a, b = f"{_quoted(loop.a.agent)},{loop.a.id}", f"{_quoted(loop.b.agent)},{loop.b.id}"
        lines.append(f"{a},{b},{pose_text},{loop.inliers}")
    atomic_write(path, "\n".join(lines) + "\n")


def _quoted(name: str) -> str:
    """Quote a field by RFC 4180: names may contain commas."""
    return '"' + name.replace('"', '""') + '"'


def _with_final_folder(exported: ExportResult, work: Path, out: Path) -> ExportResult:
    folder = out / exported.folder.relative_to(work)
    return ExportResult(folder, exported.agents, exported.keyframes, exported.points, exported.loops)


# ---- Description of a map file: `share dataset info`


def describe_map(store: MapStore) -> dict[str, Any]:
    """Return agents, maps, loops, size, schema and damage as plain data. Raises ShareError."""
    stored_map = store.load()
    log = wal_path(store.path)
    return {
        "name": store.path.name,
        "schema": store.schema,
        "bytes": store.path.stat().st_size + (log.stat().st_size if log.exists() else 0),
        "keyframes": len(stored_map.keyframes),
        "agents": _describe_agents(stored_map),
        "maps": dict(Counter(name for name, _ in map_poses(stored_map).values())),
        "solved": 0 if stored_map.poses is None else len(stored_map.poses.keys),
        "loops": len(stored_map.loops),
        "damage": list(stored_map.problems),
    }


def _describe_agents(stored_map: StoredMap) -> dict[str, Any]:
    """Return a description of each run by its file name, in order of arrival."""
    keyframe_counts = Counter(k.run_key for k in stored_map.keyframes)
    segment_counts = Counter(name.rpartition("/")[0] for name in stored_map.segments)
    names = file_names(stored_map)
    return {
        names[run.run_key]: {
            "run": run.run_key,
            "kind": str(run.hello.kind),
            "keyframes": keyframe_counts[run.run_key],
            "next_keyframe": stored_map.next_ids[run.run_key],
            "segments": segment_counts[run.run_key],
        }
        for run in stored_map.runs
    }


# ---- Point clouds as PLY files (Turk, *The PLY Polygon File Format*, 1994), binary little-endian

Colour = tuple[int, int, int]

_VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
_PLY_TYPES = {"<f4": "float", "|u1": "uchar"}


def write_ply(path: Path, clouds: Iterable[tuple[F64, Colour]]) -> int:
    """Write all clouds, points (N, 3) with a colour, and return the number of points. Raises ShareError.

    Clouds are written as they come; the header gets the number of points at the end.
    """
    with write_errors(path), open_new(path) as file:
        file.write(_ply_header(0))
        count = 0
        for points, colour in clouds:
            vertices = np.empty(len(points), _VERTEX)
            for axis, name in enumerate("xyz"):
                vertices[name] = points[:, axis]
            vertices["red"], vertices["green"], vertices["blue"] = colour
            file.write(vertices.tobytes())
            count += len(points)
        file.seek(0)
        file.write(_ply_header(count))
    return count


def _ply_header(count: int) -> bytes:
    """Return the header, of the same length for every count."""
    assert _VERTEX.fields is not None
    properties = [f"property {_PLY_TYPES[kind.str]} {name}" for name, (kind, *_) in _VERTEX.fields.items()]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {count:<12}",
        *properties,
        "end_header",
    ]
    return "".join(line + "\n" for line in lines).encode()
