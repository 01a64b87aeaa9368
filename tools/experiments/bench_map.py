"""Time of place recognition: query, match, verify. Prints JSON, medians in ms.

    python tools/experiments/bench_map.py [--recording FOLDER] [--keyframes 300 5000]

Without a recording the views are simulated. To fill the index, views are repeated with 6 % of their
descriptor bits flipped: every place is then stored many times, which is the expensive case.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

from helpers.place_real import load  # noqa: E402
from helpers.place_sim import sights  # noqa: E402

from share.config import PlaceConfig  # noqa: E402
from share.geometry import se3  # noqa: E402
from share.mapping.recognition.index import PlaceIndex  # noqa: E402
from share.mapping.recognition.verification import MAX_BITS, CameraView, Verification, verify  # noqa: E402
from share.vision.matching import match_descriptors  # noqa: E402

PLACE = PlaceConfig()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--recording", type=Path, help="EuRoC or TUM RGB-D folder with ground truth")
    parser.add_argument("--keyframes", type=int, nargs="*", default=[300, 5000])
    options = parser.parse_args()
    views = load(options.recording).sights if options.recording else simulated()
    report = {f"{n}_keyframes": bench_place(views, n) for n in options.keyframes}
    report |= {"pair": bench_pair(views)}
    print(json.dumps(report, indent=2))


def simulated() -> list[CameraView]:
    T = se3.exp(np.array([0.1, -0.1, 0.05, 0.3, 0.1, -0.2]))
    return [sight for seed in range(15) for sight in sights(seed, T)]


def median_ms(runs: Iterable[Callable[[], Any]]) -> float:
    times = []
    for run in runs:
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return round(1e3 * float(np.median(times)), 3)


def bench_place(views: list[CameraView], n: int) -> dict[str, float]:
    """Time `add` and `query` at n stored keyframes, and `chain`: query and verification of all candidates."""
    rng = np.random.default_rng(0)
    index = PlaceIndex()
    stored = [
        v.view.descriptors ^ np.packbits(rng.random((len(v.view), 256)) < 0.06, axis=1)
        for v in (views[i % len(views)] for i in range(n))
    ]
    add = median_ms([lambda i=i, d=d: index.add(i, d) for i, d in enumerate(stored)])
    asked = [views[i % len(views)] for i in range(40)]
    ask = median_ms([lambda v=v: index.query(v.view.descriptors, PLACE.candidates) for v in asked])

    def chain(query: CameraView) -> None:
        for candidate in index.query(query.view.descriptors, PLACE.candidates):
            verify(query, views[candidate.id % len(views)])

    return {"add": add, "query": ask, "chain": median_ms([lambda v=v: chain(v) for v in asked])}


def bench_pair(views: list[CameraView]) -> dict[str, float]:
    """Time matching and verification, the latter by outcome, of neighbouring and of distant views."""
    pairs = [*itertools.pairwise(views), *zip(views, views[7:], strict=False)]
    accepts = [isinstance(verify(a, b), Verification) for a, b in pairs]
    matching = [
        lambda a=a, b=b: match_descriptors(a.view.descriptors, b.view.descriptors, MAX_BITS, 1.0)
        for a, b in pairs
    ]

    def verifying(outcome: bool) -> list[Callable[[], Any]]:
        chosen = [p for p, ok in zip(pairs, accepts, strict=True) if ok == outcome]
        return [lambda a=a, b=b: verify(a, b) for a, b in chosen]

    return {
        "match": median_ms(matching),
        "verify_accepted": median_ms(verifying(True)),
        "verify_refused": median_ms(verifying(False)),
    }


if __name__ == "__main__":
    main()
