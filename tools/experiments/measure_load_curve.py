"""Cost of a keyframe on the edge as its map grows, and an hour in one room, faster than real time.

    python tools/experiments/measure_load_curve.py grow [--keyframes 20000] [--every 12] [--out out/load]
    python tools/experiments/measure_load_curve.py hour [--every 1] [--most 2000] [--limit_s 480] \\
        [--out out/load]

One process, without sockets; CPU ms. `grow`: 24 agents, no culling. `hour`: three agents at 3 keyframes/s, at
most `--most` of them kept, and a map file; it ends after a simulated hour, or after `--limit_s` of real time.
One of `--every` keyframes is looked up. Writes grow.json or hour.json.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from load_map import TimedMap  # noqa: E402
from load_tracks import (  # noqa: E402
    RATE_HZ,
    Walker,
    room,
)
from measure_load import rss_mb  # noqa: E402
from tool_main import exit_code  # noqa: E402

from share.config import Config  # noqa: E402
from share.files.writing import atomic_write, writable_dir  # noqa: E402
from share.mapping.map_changes import SaveKeyframe, SaveRun  # noqa: E402
from share.store.map_store import MapStore  # noqa: E402
from share.types import Keyframe  # noqa: E402

ROOM_FOR = 10**7  # keyframes; no limit
MARKS = (100, 200, 500, 1000, 2000, 3000, 5000, 7000, 10_000, 14_000, 20_000)
_HOUR_S, _SAMPLE = 3600, 300  # keyframes between two samples

Row = dict[str, Any]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", choices=("grow", "hour"))
    parser.add_argument("--keyframes", type=int, default=MARKS[-1])
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--most", type=int, default=Config().edge.max_keyframes)
    parser.add_argument("--limit_s", type=float, default=480.0)
    parser.add_argument("--out", type=Path, default=Path("out/load"))
    options = parser.parse_args()
    return exit_code("measure_load_curve", lambda: measure(options))


def measure(options: argparse.Namespace) -> None:
    """Print rows as they are made; the file has all rows so far."""
    writable_dir(options.out)
    rows = []
    made = (
        grow(options.keyframes, options.every)
        if options.what == "grow"
        else hour(options.limit_s, options.every, options.most)
    )
    for row in made:
        rows.append(row)
        print(json.dumps(row), flush=True)
        atomic_write(options.out / f"{options.what}.json", json.dumps(rows, indent=2) + "\n")


def all_agents(agents: int) -> Iterator[tuple[str, Keyframe | None, Walker]]:
    """Yield all agents first, then their keyframes in turn, without end."""
    made = room()
    walkers = [Walker(made, index) for index in range(agents)]
    yield from ((walker.hello.name, None, walker) for walker in walkers)
    tracks = [walker.keyframes() for walker in walkers]
    while True:
        for walker, track in zip(walkers, tracks, strict=True):
            yield walker.hello.name, next(track), walker


def grow(most: int, every: int) -> Iterator[Row]:
    """Yield a row at each mark: medians since halfway from the mark before."""
    config = Config()
    timed = TimedMap(replace(config, edge=replace(config.edge, max_keyframes=ROOM_FOR, max_waiting=1)))
    marks = [mark for mark in MARKS if mark <= most]
    count = before = 0
    for name, keyframe, walker in all_agents(24):
        if keyframe is None:
            timed.join(name, walker.hello)
            continue
        timed.add(name, keyframe)
        count += 1
        if count % every == 0:
            timed.look()
            if count % (2 * every) == 0 or count < MARKS[3]:
                timed.solve()
        if count == (before + marks[0]) // 2:
            timed.ms.clear()
        if count == marks[0]:
            yield _costs(timed, count)
            before = marks.pop(0)
            if not marks:
                return


def _costs(timed: TimedMap, count: int) -> Row:
    costs = {kind: round(float(np.median(ms)), 3) for kind, ms in timed.ms.items()}
    p95 = {f"{kind}_p95": round(float(np.percentile(ms, 95)), 3) for kind, ms in timed.ms.items()}
    timed.map_events.clear()
    report = timed.mapper.report()
    return {"keyframes": count, "loops": report["loops"]["in_map"], "maps": _maps(report)} | costs | p95


def _maps(report: Row) -> int:
    return sum(size > 0 for size in report["maps"].values())


def hour(limit_s: float, every: int, most: int) -> Iterator[Row]:
    """Yield a row every _SAMPLE keyframes; one of `every` is looked up, `most` are kept."""
    config = Config()
    timed = TimedMap(replace(config, edge=replace(config.edge, max_keyframes=most, max_waiting=1)))
    began, count = time.monotonic(), 0
    with tempfile.TemporaryDirectory(prefix="load-") as folder:
        store = MapStore.open(Path(folder) / "map.sqlite")
        store.load()
        for name, keyframe, walker in all_agents(3):
            if keyframe is None:
                timed.join(name, walker.hello)
                store.write([SaveRun(name, walker.hello)])
                continue
            timed.add(name, keyframe)
            if count % every == 0:
                timed.look()
            if count % (3 * every) == 0:
                timed.solve()
            store.write([SaveKeyframe(name, keyframe), *timed.mapper.take_changes()])
            count += 1
            if count % 45 == 0:  # 5 s
                store.write([timed.mapper.current_poses()])
            if count % _SAMPLE == 0:
                yield _state(timed, count, Path(folder))
            if count >= _HOUR_S * RATE_HZ * 3 or time.monotonic() - began > limit_s:
                break
        store.close()


def _state(timed: TimedMap, count: int, folder: Path) -> Row:
    report = timed.mapper.report()
    spent = {f"{kind}_ms": round(sum(ms) / _SAMPLE, 3) for kind, ms in timed.ms.items()}  # per keyframe
    thin = timed.ms.get("thin", [0.0])
    timed.ms.clear()
    timed.map_events.clear()
    return {
        "minutes": count / RATE_HZ / 3 / 60,
        "added": count,
        "kept": sum(report["maps"].values()),
        "maps": _maps(report),
        "stretches": len(report["maps"]),
        "loops": report["loops"]["in_map"],
        "rss_mb": round(rss_mb(os.getpid()), 1),
        "file_mb": round(sum(file.stat().st_size for file in folder.glob("map.sqlite*")) / 1e6, 2),
        "thin_most_ms": round(max(thin), 1),
    } | spent


if __name__ == "__main__":
    sys.exit(main())
