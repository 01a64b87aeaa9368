"""A map for other programs: trajectories as TUM files, its points as PLY, its loops as CSV."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from share.errors import UsageError
from share.files.sqlite_file import log_of
from share.files.writing import atomic_write, fresh, new_folder, writing
from share.geometry import se3
from share.mapping.changes import Kept, KeptKeyframe, placed
from share.mapping.loops import Key, Loop
from share.recordings.trajectory import Trajectory, format_tum
from share.store.map_store import MapStore
from share.types import F64

COLOURS: tuple[Colour, ...] = (  # matplotlib's tab10: one an agent run, in the order in which they came
    (31, 119, 180), (255, 127, 14), (44, 160, 44), (214, 39, 40), (148, 103, 189),
    (140, 86, 75), (227, 119, 194), (127, 127, 127), (188, 189, 34), (23, 190, 207),
)  # fmt: skip


@dataclass(frozen=True)
class Exported:
    """Of one map: the folder it went to, its agents by file name, how many of each."""

    folder: Path
    agents: tuple[str, ...]
    keyframes: int
    points: int
    loops: int


def export(kept: Kept, out: Path, progress: Callable[[int], None]) -> dict[str, Exported]:
    """Write every map into `out`, a new folder; of several maps each into a folder there. On error: nothing.

    In each: NAME.tum, poses of the body at the keyframes in the map; points.ply; loops.csv. progress: told of
    each keyframe. Raises UsageError if there is nothing to write or something in `out`, ShareError.
    """
    if not kept.keyframes:
        raise UsageError("the map is empty: there is nothing to export")
    with new_folder(out) as work:
        done = _write_all(kept, work, progress)
    return {name: _moved(e, work, out) for name, e in done.items()}


def file_names(kept: Kept) -> dict[str, str]:
    """By run: the agent's name, or the run's key where several runs have one name, or one is called as it."""
    names = Counter(run.hello.name for run in kept.runs)
    keys = {run.key for run in kept.runs}
    return {
        run.key: run.key if names[run.hello.name] > 1 or run.hello.name in keys else run.hello.name
        for run in kept.runs
    }


def _write_all(kept: Kept, work: Path, progress: Callable[[int], None]) -> dict[str, Exported]:
    poses = placed(kept)
    by_map: dict[str, list[KeptKeyframe]] = {}
    for keyframe in kept.keyframes:
        by_map.setdefault(poses[keyframe.at][0], []).append(keyframe)
    done = {}
    for name, keyframes in by_map.items():
        folder = work if len(by_map) == 1 else work / name.replace("/", ".")
        folder.mkdir(exist_ok=True)
        T = {k.at: poses[k.at][1] for k in keyframes}
        loops = [x for x in kept.loops if x.a in T and x.b in T]
        _write_loops(folder / "loops.csv", loops)
        agents = _write_trajectories(kept, keyframes, T, folder)
        points = write_ply(folder / "points.ply", _clouds(kept, keyframes, T, progress))
        done[name] = Exported(folder, agents, len(keyframes), points, len(loops))
    return done


def _write_trajectories(
    kept: Kept, keyframes: list[KeptKeyframe], T: dict[Key, F64], folder: Path
) -> tuple[str, ...]:
    names = file_names(kept)
    by_run: dict[str, list[KeptKeyframe]] = {}
    for keyframe in keyframes:
        by_run.setdefault(keyframe.key, []).append(keyframe)
    for run, own in by_run.items():
        own.sort(key=lambda k: k.keyframe.stamp_ns)
        stamps = np.array([k.keyframe.stamp_ns for k in own], np.int64)
        text = format_tum(Trajectory(stamps, np.array([T[k.at] for k in own])))
        atomic_write(folder / f"{names[run]}.tum", text)
    return tuple(names[run] for run in by_run)


def _clouds(
    kept: Kept, keyframes: list[KeptKeyframe], T: dict[Key, F64], progress: Callable[[int], None]
) -> Iterator[tuple[F64, Colour]]:
    """The points that each keyframe saw, in the map, in its agent's colour."""
    runs = {
        run.key: (run.hello.rig.T_body_cam0, COLOURS[i % len(COLOURS)]) for i, run in enumerate(kept.runs)
    }
    for keyframe in keyframes:
        T_body_cam0, colour = runs[keyframe.key]
        points = keyframe.keyframe.view.points.astype(np.float64)
        known = points[~np.isnan(points).any(1)]
        yield se3.transform(T[keyframe.at] @ T_body_cam0, known), colour
        progress(1)


def _write_loops(path: Path, loops: list[Loop]) -> None:
    """a and b by run and number; b's body in that of a: m, and a quaternion."""
    lines = ["a_run,a,b_run,b,x,y,z,qx,qy,qz,qw,inliers"]
    for loop in loops:
        numbers = (*loop.T_a_b[:3, 3], *se3.quat_from_matrix(loop.T_a_b[:3, :3]))
        told = ",".join(f"{value:.9f}" for value in numbers)
        lines.append(
            f"{_quoted(loop.a.agent)},{loop.a.id},{_quoted(loop.b.agent)},{loop.b.id},{told},{loop.inliers}"
        )
    atomic_write(path, "\n".join(lines) + "\n")


def _quoted(name: str) -> str:
    """As RFC 4180 has it: names may have commas."""
    return '"' + name.replace('"', '""') + '"'


def _moved(exported: Exported, work: Path, out: Path) -> Exported:
    folder = out / exported.folder.relative_to(work)
    return Exported(folder, exported.agents, exported.keyframes, exported.points, exported.loops)


# ---- What is in a map file, as plain data: `share dataset info`.


def describe_map(store: MapStore) -> dict[str, Any]:
    """Agents, maps, loops, size, schema, damage. Raises ShareError."""
    kept = store.load()
    log = log_of(store.path)
    return {
        "name": store.path.name,
        "schema": store.schema,
        "bytes": store.path.stat().st_size + (log.stat().st_size if log.exists() else 0),
        "keyframes": len(kept.keyframes),
        "agents": _agents(kept),
        "maps": dict(Counter(name for name, _ in placed(kept).values())),
        "solved": 0 if kept.poses is None else len(kept.poses.keys),
        "loops": len(kept.loops),
        "damage": list(kept.complaints),
    }


def _agents(kept: Kept) -> dict[str, Any]:
    """By file name of each run, in the order in which they came."""
    held = Counter(k.key for k in kept.keyframes)
    stretches = Counter(name.rpartition("/")[0] for name in kept.stretches)
    names = file_names(kept)
    return {
        names[run.key]: {
            "run": run.key,
            "kind": str(run.hello.kind),
            "keyframes": held[run.key],
            "next_keyframe": kept.next_keyframe[run.key],
            "stretches": stretches[run.key],
        }
        for run in kept.runs
    }


# ---- Point clouds as PLY files (Turk, *The PLY Polygon File Format*, 1994): binary, little-endian.

Colour = tuple[int, int, int]

_VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
_NAMES = {"<f4": "float", "|u1": "uchar"}


def write_ply(path: Path, clouds: Iterable[tuple[F64, Colour]]) -> int:
    """All points (N, 3) of all clouds, each cloud in its colour; how many. Raises ShareError.

    The clouds are written as they come, their number into the header in the end.
    """
    with writing(path), fresh(path) as file:
        file.write(_header(0))
        count = 0
        for points, colour in clouds:
            vertices = np.empty(len(points), _VERTEX)
            for axis, name in enumerate("xyz"):
                vertices[name] = points[:, axis]
            vertices["red"], vertices["green"], vertices["blue"] = colour
            file.write(vertices.tobytes())
            count += len(points)
        file.seek(0)
        file.write(_header(count))
    return count


def _header(count: int) -> bytes:
    """Of the same length for every count."""
    assert _VERTEX.fields is not None
    properties = [f"property {_NAMES[kind.str]} {name}" for name, (kind, *_) in _VERTEX.fields.items()]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {count:<12}",
        *properties,
        "end_header",
    ]
    return "".join(line + "\n" for line in lines).encode()
