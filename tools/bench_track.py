"""What tracking costs a headset: time to a pose, CPU a frame, and which stage takes it. Prints JSON, ms.

    python tools/bench_track.py [--frames N] [--recording SOURCE]

On a headset (stereo) and a robot (RGB-D) in the plain room, recorded for the purpose, and on a real
recording; without --recording that is the kitchen beside the checkout, if it is there. Making and
decoding images are not counted.
`track_ms` is by the clock, all else CPU time. A stage's `median` is of one call; `per_frame` spreads all
its calls over all frames.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from functools import wraps
from itertools import islice
from pathlib import Path
from typing import Any

from share import process

process.prepare()

import numpy as np  # noqa: E402
import poselib  # noqa: E402, F401 -- else the first frame would pay for it

from share.config import Config, TrackerConfig  # noqa: E402
from share.core.sequencer import SequencerCounters  # noqa: E402
from share.emulate.recipe import Recipe  # noqa: E402
from share.emulate.session import make_session  # noqa: E402
from share.estimator.visual import VisualTracker  # noqa: E402
from share.geometry.camera import Rig  # noqa: E402
from share.io.source import open_source  # noqa: E402
from share.run.pipeline import frames_of  # noqa: E402
from share.types import Frame  # noqa: E402

MOTIONS = ("ar1=walk:speed=0.65", "robot=robot:speed=0.3")
PROFILE, RATE_HZ = "d435i:640x480@15", 15
SHORTEST_S = 3  # of a session
KITCHEN = Path(__file__).resolve().parents[2] / "shared" / "data" / "real" / "redkitchen_0000_0499"
STAGES = {
    "_find": "klt",
    "_pose": "pose",
    "_reobserve": "reobservation",
    "_add_corners": "corners",
    "_recover": "relocalisation",
    "keyframe": "view",
}
Spent = dict[str, list[float]]  # CPU ms of every call, by stage


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--frames", type=int, default=200, help=f"of the room ({RATE_HZ} Hz)")
    parser.add_argument("--recording", type=Path, help="any SOURCE that `share track` takes")
    options = parser.parse_args()
    spent = watch_stages()
    report = bench_room(options.frames, spent)
    print(json.dumps(report | bench_recording(options.recording, spent), indent=2))


def bench_room(frames: int, spent: Spent) -> dict[str, Any]:
    recipe = Recipe("plain", MOTIONS, max(SHORTEST_S, frames / RATE_HZ), profiles={"": PROFILE})
    with tempfile.TemporaryDirectory() as folder:
        session = make_session(recipe, Path(folder) / "room")
        return {
            f"room_{name}": bench_source(session / name, spent, frames)
            for name in (motion.partition("=")[0] for motion in MOTIONS)
        }


def bench_recording(given: Path | None, spent: Spent) -> dict[str, Any]:
    path = given or KITCHEN
    if not given and not path.exists():
        return {"recording": "the kitchen is not beside this checkout; name another with --recording"}
    return {path.name: bench_source(path, spent)}


def bench_source(path: Path, spent: Spent, frames: int | None = None) -> dict[str, Any]:
    source = open_source(str(path))
    return bench(source.rig, islice(frames_of(source, Config(), SequencerCounters()), frames), spent)


def bench(rig: Rig, frames: Iterable[Frame], spent: Spent) -> dict[str, Any]:
    """One tracker over `frames`, one thread."""
    spent.clear()
    tracker = VisualTracker(rig, TrackerConfig())
    tracked, keyframe = 0, []
    track_ms: list[float] = []
    cpu_ms: list[float] = []
    for frame in frames:
        began, cpu_began = time.perf_counter(), time.process_time()
        result = tracker.track(frame)
        track_ms.append(1e3 * (time.perf_counter() - began))
        if result.keyframe:
            tracker.keyframe(frame)
        cpu_ms.append(1e3 * (time.process_time() - cpu_began))
        keyframe.append(result.keyframe)
        tracked += result.T_odom_body is not None
    cpu, chosen = np.array(cpu_ms), np.array(keyframe)
    return {
        "frames": len(cpu),
        "tracked": tracked,
        "keyframes": int(chosen.sum()),
        "track_ms": {"median": _round(np.median(track_ms)), "p95": _round(np.percentile(track_ms, 95))},
        "cpu_ms_per_frame": {
            "all": _round(cpu.mean()),
            "no_keyframe": _round(cpu[~chosen].mean()),
            "keyframe": _round(cpu[chosen].mean()),
        },
        "stages": {
            stage: {
                "calls": len(ms),
                "median": _round(np.median(ms)),
                "per_frame": _round(sum(ms) / len(cpu)),
            }
            for stage, ms in spent.items()
        },
    }


def watch_stages() -> Spent:
    """Has the tracker's stages timed from now on. A stage within a stage counts as the outer one."""
    spent: Spent = defaultdict(list)
    open_stages: list[str] = []

    def timed(method: Callable[..., Any], stage: str) -> Callable[..., Any]:
        @wraps(method)
        def call(*arguments: Any, **named: Any) -> Any:
            open_stages.append(stage)
            began = time.process_time()
            try:
                return method(*arguments, **named)
            finally:
                open_stages.pop()
                if not open_stages:
                    spent[stage].append(1e3 * (time.process_time() - began))

        return call

    for name, stage in STAGES.items():
        setattr(VisualTracker, name, timed(getattr(VisualTracker, name), stage))
    return spent


def _round(ms: float) -> float:
    return round(float(ms), 2)


if __name__ == "__main__":
    main()
