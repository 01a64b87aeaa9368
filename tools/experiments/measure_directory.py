"""What a site's directory of places costs, and whether it ranks the right room first, by the number of rooms.

    python tools/experiments/measure_directory.py [--rooms 10 50 500] [--keyframes 750] [--seed 1]

Rooms of random descriptors: a keyframe shares two thirds of its 300 descriptors, with 4 % of their bits
flipped, with the one before in its room, and chance with other rooms; real rooms look more alike. Prints a
Markdown table: CPU to add a keyframe and to rank one that its room does not recognise, medians; memory; how
often the right room is first, and the median of its score by that of the second room.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from tool_main import exit_code, line  # noqa: E402

from share.mapping.loops import KeyframeKey  # noqa: E402
from share.mapping.places import PlaceAdded, PlaceUnrecognised, coarse_words  # noqa: E402
from share.mapping.recognition.index import U32, PlaceIndex  # noqa: E402
from share.site.directory import PlaceDirectory  # noqa: E402
from share.types import U8  # noqa: E402

_POINTS, _SHARED, _FLIPPED = 300, 200, 0.04
_RANKED = 200  # keyframes that are ranked
_HEAD = ("rooms", "keyframes", "add, ms", "rank, ms", "MB", "right room first", "times the second's score")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rooms", nargs="+", type=int, default=[10, 50, 500])
    parser.add_argument("--keyframes", type=int, default=750, help="of each room")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    return exit_code("measure_directory", lambda: measure(options))


def measure(options: argparse.Namespace) -> None:
    print("\n".join(line(cells) for cells in (_HEAD, ["---"] * len(_HEAD))), flush=True)
    for rooms in options.rooms:
        rng = np.random.default_rng((options.seed, rooms))
        directory, index = PlaceDirectory(), PlaceIndex()
        added_ms, asked = [], []
        chosen = set(rng.choice(rooms * options.keyframes, _RANKED, replace=False).tolist())
        for n, (room, key, descriptors) in enumerate(_keyframes(rooms, options.keyframes, rng)):
            added = PlaceAdded(key, coarse_words(index.words(descriptors)))
            began = time.process_time()
            directory.update(room, added)
            added_ms.append(1e3 * (time.process_time() - began))
            if n in chosen:
                asked.append((room, coarse_words(index.words(_again(descriptors, rng)))))
        ranked_ms, are_first, ratios = _rank_all(directory, asked)
        memory, first = directory.nbytes / 1e6, f"{sum(are_first)} of {len(are_first)}"
        cells = (f"{np.median(added_ms):.2f}", f"{np.median(ranked_ms):.2f}", f"{memory:.0f}", first)
        print(line((str(rooms), str(len(directory)), *cells, f"{np.median(ratios):.1f}")), flush=True)


def _keyframes(rooms: int, each: int, rng: np.random.Generator) -> Iterator[tuple[str, KeyframeKey, U8]]:
    for room in range(rooms):
        descriptors = rng.integers(0, 256, (_POINTS, 32), np.uint8)
        for id in range(each):
            yield f"room{room}", KeyframeKey(f"run{room}-0001", id), descriptors
            descriptors = _again(descriptors, rng)


def _again(descriptors: U8, rng: np.random.Generator) -> U8:
    """Return what another keyframe near by sees."""
    kept = descriptors[rng.permutation(_POINTS)[:_SHARED]]
    kept = kept ^ np.packbits(rng.random((_SHARED, 256)) < _FLIPPED, axis=1)
    return np.concatenate([kept, rng.integers(0, 256, (_POINTS - _SHARED, 32), np.uint8)])


def _rank_all(
    directory: PlaceDirectory, asked: list[tuple[str, U32]]
) -> tuple[list[float], list[bool], list[float]]:
    """Return of each: CPU, ms; whether the right room is first; its score by the second's."""
    ranked_ms, are_first, ratios = [], [], []
    for n, (room, words) in enumerate(asked):
        began = time.process_time()
        ranking = directory.update("hall", PlaceUnrecognised(KeyframeKey("new", 100 * n), words))
        ranked_ms.append(1e3 * (time.process_time() - began))
        assert ranking is not None
        scores = ranking.scores
        are_first.append(bool(scores) and scores[0].room == room)
        if are_first[-1]:
            ratios.append(scores[0].score / scores[1].score if len(scores) > 1 else np.inf)
    return ranked_ms, are_first, ratios


if __name__ == "__main__":
    sys.exit(main())
