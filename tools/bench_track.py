"""What tracking costs a headset: time to a pose, CPU a frame, and which stage takes it. Prints JSON, ms.

    python tools/bench_track.py [--frames N] [--recording SOURCE]

On the demo's room (stereo walker and RGB-D robot, rendered in memory) and on a real recording; without
--recording that is the kitchen beside the checkout, if it is there. Rendering and decoding are not counted.
`track_ms` is by the clock, all else CPU time. A stage's `median` is of one call; `per_frame` spreads all
its calls over all frames.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from functools import wraps
from pathlib import Path
from typing import Any

from share import process

process.prepare()

import numpy as np  # noqa: E402
import poselib  # noqa: E402, F401 -- else the first frame would pay for it

from share.config import Config, TrackerConfig  # noqa: E402
from share.core.sequencer import SequencerCounters  # noqa: E402
from share.emulate.plain.agents import AGENTS, BASELINE, RATE_HZ, Agent  # noqa: E402
from share.emulate.plain.motion import move  # noqa: E402
from share.emulate.plain.render import Renderer  # noqa: E402
from share.emulate.plain.room import make_room  # noqa: E402
from share.emulate.plain.sensor import Sensor  # noqa: E402
from share.estimator.visual import VisualTracker  # noqa: E402
from share.geometry import se3  # noqa: E402
from share.geometry.camera import Rig  # noqa: E402
from share.io.source import open_source  # noqa: E402
from share.run.pipeline import frames_of  # noqa: E402
from share.types import Frame  # noqa: E402

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
    parser.add_argument("--frames", type=int, default=200, help="of the demo's room (20 Hz)")
    parser.add_argument("--recording", type=Path, help="any SOURCE that `share track` takes")
    options = parser.parse_args()
    spent = watch_stages()
    report = {
        f"room_{a.name}": bench(a.rig, room_frames(a, options.frames), spent) for a in (AGENTS[0], AGENTS[2])
    }
    print(json.dumps(report | bench_recording(options.recording, spent), indent=2))


def bench_recording(given: Path | None, spent: Spent) -> dict[str, Any]:
    path = given or KITCHEN
    if not given and not path.exists():
        return {"recording": "the kitchen is not beside this checkout; name another with --recording"}
    source = open_source(str(path))
    return {path.name: bench(source.rig, frames_of(source, Config(), SequencerCounters()), spent)}


def room_frames(agent: Agent, count: int, seed: int = 0) -> Iterator[Frame]:
    """What the agent's cameras see of the demo's room, with their noise."""
    room = make_room(seed)
    renderer, sensor, rig = Renderer(room, agent.rig.cam0), Sensor((seed, 3)), agent.rig
    for k, T_world_cam in enumerate(move(agent.style, room.size, np.arange(count) / RATE_HZ, (seed, 2))):
        image, z = renderer.render(T_world_cam)
        image0, image1, depth = sensor.gray(image, k, 0), None, None
        if rig.T_cam1_cam0 is not None:
            right, _ = renderer.render(T_world_cam @ se3.inverse(rig.T_cam1_cam0))
            image1 = sensor.gray(right, k, 1)
        if rig.depth is not None:
            depth = sensor.depth_mm(z, rig.depth.fx * BASELINE, k).astype(np.float32) / np.float32(1000)
        yield Frame(k * 10**9 // RATE_HZ, k, image0, image1, depth)


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
