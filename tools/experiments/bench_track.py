"""Cost of tracking on a headset: time to a pose, CPU per frame, and per stage. Prints JSON, ms.

    python tools/experiments/bench_track.py [--frames N] [--recording SOURCE]

With cameras and IMU: a walker with each of two stereo rigs in the warehouse; without OpenGL in the plain
room, less the rig with a lens that this room does not support. By cameras alone: a robot (RGB-D) in the plain
room, and the kitchen recording if it is beside the checkout; SOURCE, as for `share track`, replaces it.
Making and decoding images does not count. Sessions with an IMU are kept.

`track_ms` is wall time, all else CPU time. `cpu_ms`: of a frame until its pose (`pose`), of a keyframe after
that (`keyframe`), of both (`all`, `mean`). A stage's `median` and `p99` are of one call; `per_frame` spreads
all its calls over all frames. ` cam1`: work on the second camera's image. `rest`: outside all stages.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from functools import wraps
from itertools import islice
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
import poselib  # noqa: E402, F401 -- else the first frame would pay for it

from share.config import Config, TrackerConfig  # noqa: E402
from share.lab.emulate.recipe import DEFAULT_SCENE, FALLBACK_SCENE, SessionRecipe  # noqa: E402
from share.lab.emulate.render.context import missing_reason  # noqa: E402
from share.lab.emulate.session import make_cached_session, make_session  # noqa: E402
from share.odometry import feature_appearance, feature_matching, filter, initial_depth, visual_update  # noqa: E402
from share.odometry.inertial_tracker import InertialTracker  # noqa: E402
from share.odometry.landmarks import LandmarkMap  # noqa: E402
from share.odometry.visual_tracker import VisualTracker  # noqa: E402
from share.runtime.pipeline import make_tracker, read_frames  # noqa: E402
from share.runtime.source import Source, open_source  # noqa: E402
from share.sensors.sequencer import SequencerCounters  # noqa: E402
from share.types import F64  # noqa: E402
from share.vision import corners, patches  # noqa: E402
from share.vision.keyframe_images import Surfaces  # noqa: E402

STEREO = {"euroc_752x480": ("euroc", 20), "d435i_848x480": ("d435i:848x480@30", 30)}  # profile, Hz
NEEDS_LENS = "euroc_752x480"  # the plain room has no lens distortion
ROBOT, ROBOT_PROFILE, ROBOT_HZ = "robot=robot:speed=0.3", "d435i:640x480@15", 15
SHORTEST_S = 3  # least length of a session
KITCHEN = Path(__file__).resolve().parents[3] / "shared" / "data" / "real" / "redkitchen_0000_0499"
STAGES: tuple[tuple[Any, str, str], ...] = (
    (filter, "propagate", "imu"),
    (feature_matching, "predict_patches", "expect"),
    (patches, "align", "align"),
    (feature_matching, "match_by_flow", "rescue"),
    (visual_update, "mark_dynamic", "movers"),
    (LandmarkMap, "frame_measurements", "rows"),
    (filter, "relinearised_rows", "relinearised rows"),
    (filter, "innovation_covariance", "gains"),
    (filter, "update", "update"),
    (LandmarkMap, "record_frame", "slant and runaways"),
    (LandmarkMap, "reactivate", "keyframe: reactivate"),
    (LandmarkMap, "drop_dormant", "keyframe: forget"),
    (initial_depth, "initial_depths", "keyframe: depth"),
    (feature_appearance, "extract_appearance", "keyframe: patches"),
    (LandmarkMap, "surfaces", "keyframe: surfaces"),
    (Surfaces, "with_image", "keyframe: JPEG"),
    (corners, "detect", "keyframe: corners"),
    (VisualTracker, "_follow_tracks", "klt"),
    (VisualTracker, "_estimate_pose", "pose"),
    (VisualTracker, "_reobserve", "reobservation"),
    (VisualTracker, "_add_corners", "corners"),
    (VisualTracker, "_relocalise", "relocalisation"),
    (VisualTracker, "make_keyframe", "keyframe"),
)
Tracker = VisualTracker | InertialTracker


class TimedStages:
    """Records CPU ms of every call of the trackers' stages. A stage within a stage counts as the outer
    one."""

    def __init__(self) -> None:
        self.spent: dict[str, list[float]] = defaultdict(list)
        # the second camera and its image; calls with one of them count as ` cam1`
        self.second: tuple[Any, ...] = ()
        self._open = 0
        for owner, name, stage in STAGES:
            setattr(owner, name, self._timed(getattr(owner, name), stage))

    def _timed(self, method: Callable[..., Any], stage: str) -> Callable[..., Any]:
        @wraps(method)
        def call(*arguments: Any, **named: Any) -> Any:
            self._open += 1
            began = time.process_time()
            try:
                return method(*arguments, **named)
            finally:
                self._open -= 1
                if not self._open:
                    there = any(a is b for a in arguments for b in self.second)
                    self.spent[stage + there * " cam1"].append(1e3 * (time.process_time() - began))

        return call


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--frames", type=int, default=200, help="frames of each emulated session")
    parser.add_argument("--recording", type=Path, help="any SOURCE that `share track` takes")
    options = parser.parse_args()
    stages = TimedStages()
    report = bench_stereo(options.frames, stages) | bench_robot(options.frames, stages)
    print(json.dumps(report | bench_recording(options.recording, stages), indent=2))


def bench_stereo(frames: int, stages: TimedStages) -> dict[str, Any]:
    """Stereo with IMU."""
    reason = missing_reason()
    report: dict[str, Any] = {
        "scene": DEFAULT_SCENE if reason is None else f"{FALLBACK_SCENE}, because {reason}"
    }
    for name, (profile, rate_hz) in STEREO.items():
        if reason is not None and name == NEEDS_LENS:
            report[name] = "the plain room has no lens distortion"
            continue
        seconds = max(SHORTEST_S, frames / rate_hz)
        recipe = SessionRecipe(
            FALLBACK_SCENE if reason else DEFAULT_SCENE, ("a=walk:",), seconds, profiles={"": profile}
        )
        source = open_source(str(make_cached_session(recipe) / "a"))
        report[name] = bench(source, make_tracker(source.rig, Config()), stages, frames)
    return report


def bench_robot(frames: int, stages: TimedStages) -> dict[str, Any]:
    """RGB-D without IMU."""
    recipe = SessionRecipe(
        FALLBACK_SCENE, (ROBOT,), max(SHORTEST_S, frames / ROBOT_HZ), profiles={"": ROBOT_PROFILE}
    )
    with tempfile.TemporaryDirectory() as folder:
        source = open_source(str(make_session(recipe, Path(folder) / "room") / "robot"))
        return {"room_robot": bench(source, VisualTracker(source.rig, TrackerConfig()), stages, frames)}


def bench_recording(given: Path | None, stages: TimedStages) -> dict[str, Any]:
    path = given or KITCHEN
    if not given and not path.exists():
        return {"recording": "the kitchen is not beside this checkout; name another with --recording"}
    source = open_source(str(path))
    return {path.name: bench(source, make_tracker(source.rig, Config()), stages)}


def bench(source: Source, estimator: Tracker, stages: TimedStages, most: int | None = None) -> dict[str, Any]:
    """Track the first `most` frames of `source` in one thread."""
    stages.spent.clear()
    tracked, track_ms, pose_ms, keyframe_ms = 0, [], [], []
    for frame in islice(read_frames(source, Config(), SequencerCounters()), most):
        stages.second = tuple(x for x in (source.rig.cam1, frame.image1) if x is not None)
        began, cpu_began = time.perf_counter(), time.process_time()
        result = estimator.track(frame)
        track_ms.append(1e3 * (time.perf_counter() - began))
        pose_out = time.process_time()
        if result.keyframe_ready:
            estimator.make_keyframe(frame)
        estimator.finish_keyframe()
        pose_ms.append(1e3 * (pose_out - cpu_began))
        keyframe_ms.append(1e3 * (time.process_time() - pose_out) if result.keyframe_ready else np.nan)
        tracked += result.T_odom_body is not None
    return {"tracker": type(estimator).__name__, "frames": len(pose_ms), "tracked": tracked} | report_of(
        np.array(track_ms), np.array(pose_ms), np.array(keyframe_ms), stages.spent
    )


def report_of(track: F64, pose: F64, keyframe: F64, spent: dict[str, list[float]]) -> dict[str, Any]:
    """Summarise times (N,) ms of frames; keyframe: NaN where there was none."""
    whole = pose + np.nan_to_num(keyframe)
    in_stages = sum(sum(ms) for ms in spent.values())
    return {
        "keyframes": int(np.isfinite(keyframe).sum()),
        "track_ms": spread(track),
        "cpu_ms": {
            "pose": spread(pose),
            "keyframe": spread(keyframe[np.isfinite(keyframe)]),
            "all": spread(whole),
            "mean": _round(whole.mean()),
        },
        "stages": {
            stage: {"calls": len(ms), **spread(np.array(ms)), "per_frame": _round(sum(ms) / len(whole))}
            for stage, ms in spent.items()
        }
        | {"rest": {"per_frame": _round((whole.sum() - in_stages) / len(whole))}},
    }


def spread(ms: F64) -> dict[str, float]:
    return {"median": _round(np.median(ms)), "p99": _round(np.percentile(ms, 99))}


def _round(ms: float) -> float:
    return round(float(ms), 2)


if __name__ == "__main__":
    main()
