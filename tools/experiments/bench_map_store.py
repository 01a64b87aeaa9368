"""Cost of storing the edge's map: commits, opening, and a file with keyframes added and removed.

    python tools/experiments/bench_map_store.py [--load 2000 20000] [--turnover 20000 --held 2000] \\
        [--folder DIR]

Prints one JSON object. Keyframes have 500 points. Times in ms (medians and 95 %) or s; *_cpu is process time.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402

from share.geometry.camera import Camera, Rig  # noqa: E402
from share.mapping.loops import KeyframeKey  # noqa: E402
from share.mapping.map_changes import MapChange, RemoveKeyframes, SaveKeyframe, SavePoses, SaveRun  # noqa: E402
from share.store.map_store import MapStore  # noqa: E402
from share.types import AgentKind, Keyframe, KeyframeImage, View  # noqa: E402
from share.wire.messages import Hello  # noqa: E402

RUN = "ann-0001"
RIG = Rig(Camera(640, 480, 400.0, 400.0, 319.5, 239.5), np.eye(4))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--load", type=int, nargs="*", default=[2000, 20000])
    parser.add_argument("--turnover", type=int, default=20000)
    parser.add_argument("--held", type=int, default=2000)
    parser.add_argument("--folder", type=Path, help="folder on the disk to measure")
    options = parser.parse_args()
    report: dict[str, Any] = {}
    for batch, power_cut in ((1, False), (20, False), (1, True), (20, True)):
        name = f"commit_of_{batch}" + ("_power_cut" if power_cut else "")
        report[name] = fresh(options.folder, lambda p, b=batch, c=power_cut: bench_commits(p, b, c))  # type: ignore[misc]
    report["solution_of_2000"] = fresh(options.folder, bench_solutions)
    for count in options.load:
        report[f"open_{count}"] = fresh(options.folder, lambda p, n=count: bench_open(p, n))  # type: ignore[misc]
    report["turnover"] = fresh(options.folder, lambda p: bench_turnover(p, options.turnover, options.held))
    print(json.dumps(report, indent=2))


def fresh(folder: Path | None, bench: Callable[[Path], dict[str, Any]]) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(dir=folder) as name:
        return bench(Path(name) / "map.sqlite")


def keyframes() -> Callable[[int], SaveKeyframe]:
    rng = np.random.default_rng(0)
    surfaces = rng.normal(size=(70, 2)), rng.normal(size=(70, 3)), rng.uniform(0, 0.1, 70)
    image = KeyframeImage(rng.integers(0, 256, 17_000, np.uint8), *surfaces)
    step, up = np.eye(4), np.array([0.0, 0.0, 1.0])

    def make(i: int) -> SaveKeyframe:
        cov = np.eye(6) * 1e-6
        view = View.empty()
        return SaveKeyframe(RUN, Keyframe(i, i - 1, i * 10**8, step, cov, step, up, 0.01, view, image=image))

    return make


def opened(path: Path, power_cut: bool = False) -> MapStore:
    store = MapStore.open(path, power_cut)
    store.write([SaveRun(RUN, Hello("ann", AgentKind.AR, 1, RIG))])
    return store


def bench_commits(path: Path, batch: int, power_cut: bool) -> dict[str, Any]:
    make, count = keyframes(), 400 if batch == 1 else 2000
    with opened(path, power_cut) as store:
        batches = [[make(i) for i in range(start, start + batch)] for start in range(0, count, batch)]
        times = timed(store, batches)
    return {**times, "bytes_per_keyframe": round(path.stat().st_size / count)}


def bench_solutions(path: Path) -> dict[str, Any]:
    make = keyframes()
    with opened(path) as store:
        store.write([make(i) for i in range(2000)])
        poses = SavePoses(
            tuple(KeyframeKey(RUN, i) for i in range(2000)),
            np.tile(np.eye(4), (2000, 1, 1)),
            (f"{RUN}/0",) * 2000,
        )
        return timed(store, [[poses]] * 50)


def bench_open(path: Path, count: int) -> dict[str, Any]:
    make = keyframes()
    with opened(path) as store:
        for start in range(0, count, 100):
            store.write([make(i) for i in range(start, start + 100)])
    wall, cpu = time.perf_counter(), time.process_time()
    with MapStore.open(path) as store:
        found = len(store.load().keyframes)
        spent = {"s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
    return {"keyframes": found, **{k: round(v, 2) for k, v in spent.items()}, "mb": path.stat().st_size / 1e6}


def bench_turnover(path: Path, count: int, held: int) -> dict[str, Any]:
    """Time commits that each add twenty keyframes and remove twenty random ones. MB of file and log
    together."""
    make, draw, there = keyframes(), np.random.default_rng(1), list[int]()
    sizes, batches_ms = [], []
    with opened(path) as store:
        for start in range(0, count, 20):
            there += range(start, start + 20)
            gone = [there.pop(draw.integers(len(there) - 20)) for _ in range(max(0, len(there) - held))]
            news: list[MapChange] = [make(i) for i in range(start, start + 20)]
            batches_ms += times_ms(
                store, [[*news, RemoveKeyframes(tuple(KeyframeKey(RUN, i) for i in gone))]]
            )
            sizes.append(sum(f.stat().st_size for f in path.parent.iterdir()) / 1e6)
        left = len(store.load().keyframes)
    tenth = len(sizes) // 10
    return {
        "keyframes": left,
        "mb_when_full": round(sizes[held // 20], 1),
        "mb_most_by_tenths": [round(max(sizes[i : i + tenth]), 1) for i in range(0, len(sizes), tenth)],
        "mb_closed": round(path.stat().st_size / 1e6, 1),
        "commit_ms": round(float(np.median(batches_ms)), 2),
    }


def timed(store: MapStore, batches: Iterable[list[Any]]) -> dict[str, Any]:
    cpu = time.process_time()
    ms = times_ms(store, batches)
    cpu_ms = 1e3 * (time.process_time() - cpu) / len(ms)
    p50, p95 = np.percentile(ms, (50, 95))
    return {
        name: round(float(v), 2)
        for name, v in {"ms": p50, "ms_p95": p95, "ms_max": max(ms), "cpu_ms": cpu_ms}.items()
    }


def times_ms(store: MapStore, batches: Iterable[list[Any]]) -> list[float]:
    out = []
    for batch in batches:
        began = time.perf_counter()
        store.write(batch)
        out.append(1e3 * (time.perf_counter() - began))
    return out


if __name__ == "__main__":
    main()
