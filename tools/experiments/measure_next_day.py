"""The saved map next day: other light, loose things moved, a third of the cartons gone.

    share emulate --scene warehouse --motion a=walk: --motion b=walk: --profile d435i:640x480@15 \\
        --seconds 24 --seed 5101 --out 5101-0
    share emulate … --seconds 16 --seed 5101 --day 1 --out 5101-1
    python tools/experiments/measure_next_day.py 5101-0 5101-1 [FIRST SECOND …] [--json FILE]

Plays FIRST in virtual time against an edge with an empty map file, ends the edge, and plays SECOND, new runs
of the same agents, against a new edge with that file. Prints a Markdown table.

Truth of a saved map: one alignment (SE3) of its keyframes to the world. An agent is *located* from its first
pose in a saved map on, *in view* from its first frame nearer than 1 m and 30 degrees to a saved keyframe; its
error is that of each pose in a saved map under that map's alignment, *wrong* beyond 0.5 m or 10 degrees.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from tool_main import exit_code  # noqa: E402
from two_days import play_days, run_pairs  # noqa: E402

from share.geometry import se3  # noqa: E402
from share.geometry.interpolation import associate, interpolate  # noqa: E402
from share.mapping.map_changes import StoredMap, map_poses  # noqa: E402
from share.protocol.agent_events import LocalisedPose  # noqa: E402
from share.recordings.session import Session, read_session  # noqa: E402
from share.recordings.trajectory import read_tum  # noqa: E402
from share.types import F64  # noqa: E402

WRONG_M, WRONG_RAD = 0.5, float(np.radians(10))
SEEN_M, SEEN_RAD = 1.0, float(np.radians(30))


@dataclass(frozen=True)
class NextDay:
    """One agent on the second day. Times in s since its first pose; None: never. Errors of its poses in
    saved maps."""

    sessions: str
    agent: str
    seen_s: float | None
    located_s: float | None
    first_cm: float | None
    median_cm: float | None
    max_cm: float | None
    max_deg: float | None
    wrong_s: float
    in_map_s: float
    saved_maps: int
    saved_cm: float
    saved_keyframes: int
    saved_left: int


@dataclass(frozen=True, eq=False)
class SavedMap:
    """Keyframes of a saved map, and its alignment T_world_map (4, 4). T_world (N, 4, 4): their true poses."""

    T_world_map: F64
    T_world: F64
    errors_m: F64


def saved_maps(session: Session, kept: StoredMap) -> dict[str, SavedMap]:
    """Maps of the file by name, those of at least three keyframes with a truth."""
    poses, names = map_poses(kept), {run.run_key: run.hello.name for run in kept.runs}
    truths = {name: read_tum(session.folder / "truth" / f"{name}.tum") for name in session.agents}
    out = {}
    for map_id in dict.fromkeys(name for name, _ in poses.values()):
        pairs = []
        for run, name in names.items():
            own = [k for k in kept.keyframes if k.run_key == run and poses[k.keyframe_key][0] == map_id]
            stamps = np.array([k.keyframe.stamp_ns for k in own], np.int64)
            T = np.array([poses[k.keyframe_key][1] for k in own]).reshape(-1, 4, 4)
            pairs.append(associate((stamps, T), truths[name])[1:])
        T_map, T_world = (np.concatenate(side) for side in zip(*pairs, strict=True))
        if len(T_map) >= 3:
            T_world_map = se3.umeyama(T_map[:, :3, 3], T_world[:, :3, 3])
            errors_m = np.linalg.norm((T_world_map @ T_map)[:, :3, 3] - T_world[:, :3, 3], axis=1)
            out[map_id] = SavedMap(T_world_map, T_world, errors_m)
    return out


def measure(first: Path, second: Path) -> list[NextDay]:
    """Play both days and return a result for each agent of the second."""
    kept, on_second, world = play_days(read_session(first), read_session(second))
    maps = saved_maps(read_session(first), kept)
    later = {k.keyframe_key for k in on_second.keyframes}
    saved_cm = 100 * float(np.sqrt(np.mean(np.concatenate([one.errors_m for one in maps.values()]) ** 2)))
    left = sum(k.keyframe_key in later for k in kept.keyframes)
    common = len(maps), saved_cm, len(kept.keyframes), left
    pair = f"{first.name} {second.name}"
    return [
        NextDay(pair, name, *_placement(poses, second, name, maps), *common)
        for name, poses in world.localised.items()
    ]


def _placement(
    poses: Sequence[LocalisedPose], session: Path, name: str, maps: Mapping[str, SavedMap]
) -> tuple[float | None, float | None, float | None, float | None, float | None, float | None, float, float]:
    """Fields of `NextDay` from `seen_s` to `in_map_s`."""
    truth = read_tum(session / "truth" / f"{name}.tum")
    stamps = np.array([p.stamp_ns for p in poses], np.int64)
    known, T_true = interpolate(*truth, stamps)
    kept = [p for p, is_known in zip(poses, known, strict=True) if is_known]
    since_s = (stamps[known] - stamps[known][0]) * 1e-9
    shift, angle = se3.pairwise_distances(T_true, np.concatenate([one.T_world for one in maps.values()]))
    seen = np.flatnonzero(((shift < SEEN_M) & (angle < SEEN_RAD)).any(axis=1))
    seen_s = float(since_s[seen[0]]) if len(seen) else None
    located = np.array([p.map_id in maps for p in kept])
    if not located.any():
        return seen_s, None, None, None, None, None, 0.0, 0.0
    T_est = np.array(
        [maps[p.map_id].T_world_map @ p.T_map_odom @ p.T_odom_body for p in kept if p.map_id in maps]
    )
    error = se3.inverse(T_true[located]) @ T_est
    metres, turn = np.linalg.norm(error[:, :3, 3], axis=1), se3.rotation_angle(error[:, :3, :3])
    period_s = float(np.median(np.diff(since_s)))
    return (
        seen_s,
        float(since_s[located][0]),
        100 * float(metres[0]),
        100 * float(np.median(metres)),
        100 * float(metres.max()),
        float(np.degrees(turn.max())),
        period_s * int(((metres > WRONG_M) | (turn > WRONG_RAD)).sum()),
        period_s * int(located.sum()),
    )


_TITLES = (
    *("sessions", "agent", "in view s", "located s", "at first cm", "median cm", "max cm", "max deg"),
    *("wrong s", "in map s", "saved maps", "their cm", "their keyframes", "left"),
)


if __name__ == "__main__":
    sys.exit(exit_code("measure_next_day", lambda: run_pairs(__doc__ or "", _TITLES, measure)))
