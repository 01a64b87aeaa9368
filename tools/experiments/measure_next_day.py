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

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from tool_main import exit_code, line  # noqa: E402

from share.config import Config  # noqa: E402
from share.errors import UsageError  # noqa: E402
from share.geometry import se3  # noqa: E402
from share.geometry.interpolation import associate, interpolate  # noqa: E402
from share.lab.evaluate.emulated_network import LinkAssignment  # noqa: E402
from share.lab.evaluate.processing_delays import ProcessingDelays  # noqa: E402
from share.lab.evaluate.simulation import Simulation  # noqa: E402
from share.lab.evaluate.virtual_time import track_session  # noqa: E402
from share.mapping.map_changes import StoredMap, map_poses  # noqa: E402
from share.protocol.agent_events import LocalisedPose  # noqa: E402
from share.recordings.session import Session, read_session  # noqa: E402
from share.recordings.trajectory import read_tum  # noqa: E402
from share.store.map_store import MapStore  # noqa: E402
from share.types import F64  # noqa: E402
from share.wire.messages import Hello  # noqa: E402

WRONG_M, WRONG_RAD = 0.5, float(np.radians(10))
SEEN_M, SEEN_RAD = 1.0, float(np.radians(30))
_DRAIN_S = 2.0


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


def play(session: Session, store: MapStore, first_run: int) -> Simulation:
    """Play a session to its end against an edge that continues the map. first_run: number of a run."""
    settings = Config()
    tracked = track_session(
        session.folder.resolve(), settings.tracker, settings.inertial, settings.sequencer, ""
    )
    network = LinkAssignment.parse(None)
    start_ns = min(frames[0].arrival_ns for _, frames in tracked.values())
    end_ns = max(frames[-1].arrival_ns for _, frames in tracked.values())
    members = [
        (
            Hello(name, agent.kind, first_run + number, tracked[name][0]),
            (replace(frame, arrival_ns=frame.arrival_ns - start_ns) for frame in tracked[name][1]),
            network.network_for(name),
        )
        for number, (name, agent) in enumerate(session.agents.items())
    ]
    world = Simulation(settings, members, ProcessingDelays(), 1, store=store)
    world.run((end_ns - start_ns) * 1e-9 + _DRAIN_S)
    store.write([world.mapper.current_poses()])
    return world


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
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "room.sqlite"
        with MapStore.open(path) as store:
            play(read_session(first), store, 1)
        with MapStore.open(path) as store:
            kept = store.load()
            maps = saved_maps(read_session(first), kept)
            world = play(read_session(second), store, 101)
            later = {k.keyframe_key for k in store.load().keyframes}
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


def _text(value: object) -> str:
    return "-" if value is None else f"{value:.2f}" if isinstance(value, float) else str(value)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("sessions", nargs="+", type=Path, metavar="FIRST SECOND")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    if len(options.sessions) % 2:
        raise UsageError("give pairs of sessions: FIRST SECOND")
    print(line(_TITLES), line(["---"] * len(_TITLES)), sep="\n", flush=True)
    results = []
    for first, second in zip(options.sessions[::2], options.sessions[1::2], strict=True):
        for one in measure(first, second):
            results.append(one)
            print(line(map(_text, asdict(one).values())), flush=True)
    if options.json:
        options.json.write_text(json.dumps([asdict(one) for one in results], indent=2))


if __name__ == "__main__":
    sys.exit(exit_code("measure_next_day", main))
