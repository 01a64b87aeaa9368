"""Accuracy of the trackers on real data: pictures, depth, IMU, motion capture. Prints Markdown tables.

    python tools/experiments/measure_real.py [--part pairs|kitchen|rooms] [--apart S] [--start S] \\
        [--seconds S]

Causal poses, as of `share track`. Needs the recordings in --data.

`pairs`: 50 stereo pictures of EuRoC V1_01, 0.05 to 7 s apart, with the whole IMU. All are tracked in order;
the relative motion of each pair of neighbours is compared with the true one. Allowed are 2 % of the path and
1 cm. The ground truth is that of the Vicon body, not quite of the IMU: `error` is against the truth moved to
the IMU, as fitted over the whole recording (docs/understand/mocap-fit.md), `as given` against the truth as
it is.

`kitchen`: 500 RGB-D pictures, no IMU.

`rooms`: TUM-VI's hand-held motion and real IMU; pictures are emulated along the IMU's path, as fitted to the
motion capture. `fitted`: against that path. `raw`: against the motion capture as recorded, with its clock,
where it saw the body. `arm`: the same, with the place of its body on the IMU solved for as well.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from tool_main import exit_code  # noqa: E402

from share.config import Config  # noqa: E402
from share.errors import DataError, UsageError  # noqa: E402
from share.geometry import se3  # noqa: E402
from share.geometry.interpolation import associate, interpolate  # noqa: E402
from share.geometry.se3 import umeyama  # noqa: E402
from share.lab.emulate.motion.recorded import EUROC_OPTIONS, open_recorded_motion  # noqa: E402
from share.lab.emulate.recipe import SessionRecipe  # noqa: E402
from share.lab.emulate.session import make_cached_session  # noqa: E402
from share.metrics.ate import ate, ate_if_known  # noqa: E402
from share.recordings import tables  # noqa: E402
from share.recordings.trajectory import Trajectory, make_poses  # noqa: E402
from share.runtime.offline_tracking import TrackingOutput, track  # noqa: E402
from share.runtime.pipeline import make_tracker, read_frames  # noqa: E402
from share.runtime.source import Source, open_source  # noqa: E402
from share.sensors.sequencer import SequencerCounters  # noqa: E402
from share.types import F64, TrackState  # noqa: E402

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
ALLOWED_M, ALLOWED_PART = 0.01, 0.02
SPANS_S = (0.5, 1.0, 2.0, np.inf)
KITCHEN = {"0:500": 3.5, "0:250": 3.7, "250:500": 2.9}  # cm, without the inertial tracker
ROOMS, SCENE, SEED = ("room1", "room2", "room3"), "warehouse", 201
_ROUNDS = 200  # of alternating between arm and alignment


class Seen(NamedTuple):
    """The tracker's result for a picture, and its true pose by two ground truths."""

    number: int
    stamp_ns: int
    state: TrackState
    segment: int
    T: F64 | None
    truth: F64
    given: F64


@dataclass(frozen=True)
class ViewPair:
    """Two neighbours: error of the relative motion, m, NaN without a pose."""

    first: Seen
    second: Seen
    moved: float
    error: float
    error_given: float

    @property
    def apart_s(self) -> float:
        return (self.second.stamp_ns - self.first.stamp_ns) * 1e-9

    @property
    def allowed(self) -> float:
        return ALLOWED_PART * self.moved + ALLOWED_M


def main() -> int:
    options = arguments()
    return exit_code("measure_real", lambda: measure(options))


def measure(options: argparse.Namespace) -> None:
    """Measure the parts asked for."""
    parts = {"pairs": real_pairs, "kitchen": kitchen, "rooms": rooms}
    for name in options.part or parts:
        print(f"\n## {name}\n")
        for line in parts[name](options):
            print(line, flush=True)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--part", action="append", choices=("pairs", "kitchen", "rooms"), help="may be repeated"
    )
    parser.add_argument("--data", type=Path, default=DATA, help="holds real/ and motion/")
    parser.add_argument("--cache", type=Path, help="of emulated rooms (default: the user's)")
    parser.add_argument("--apart", type=float, default=1.0, help="list pairs up to so many s apart (1)")
    parser.add_argument("--start", type=float, default=20.0, help="of a room's motion, s (20)")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each room (20)")
    return parser.parse_args()


# ---------------------------------------------------------------------- pairs


def real_pairs(options: argparse.Namespace) -> Iterator[str]:
    """Yield the pairs up to --apart, how many are right by time apart, and the states of all pictures."""
    seen = followed(there(options.data / "real" / "euroc_v1_01_keyframes"))
    pairs = [pair_of(a, b) for a, b in pairwise(seen)]
    yield "| pictures | s apart | states | moved, cm | error, cm | as given | allowed |"
    yield "|---|---|---|---|---|---|---|"
    for p in pairs:
        if p.apart_s <= options.apart:
            yield (
                f"| {p.first.number}, {p.second.number} | {p.apart_s:.2f} "
                f"| {p.first.state} {p.second.state} | {_cm(p.moved)} "
                f"| {_cm(p.error)} | {_cm(p.error_given)} | {_cm(p.allowed)} |"
            )
    yield "\n| up to, s | pairs | tracked | within 2 % + 1 cm | as given |\n|---|---|---|---|---|"
    for longest in SPANS_S:
        yield summed(longest, [p for p in pairs if p.apart_s <= longest])
    yield "\nStates: " + ", ".join(f"{n} {state}" for state, n in Counter(s.state for s in seen).items())


def summed(longest: float, pairs: list[ViewPair]) -> str:
    tracked = sum(not np.isnan(p.error) for p in pairs)
    right, given = (
        sum(error <= p.allowed for p, error in zip(pairs, errors, strict=True))
        for errors in ([p.error for p in pairs], [p.error_given for p in pairs])
    )
    return f"| {longest:g} | {len(pairs)} | {tracked} | {right} | {given} |"


def followed(folder: Path) -> list[Seen]:
    """Track every picture of the recording in turn. Raises DataError where its ground truth does not cover
    one."""
    source, settings = open_source(str(folder)), Config()
    given = source.truth()
    if given is None:
        raise DataError(f"{folder}: has no ground truth")
    T_mocap_imu = se3.inverse(open_recorded_motion(folder, EUROC_OPTIONS).path.fit.T_body_mocap)
    tracker, segment, out = make_tracker(source.rig, settings), 0, []
    for frame in read_frames(source, settings, SequencerCounters()):
        result = tracker.track(frame)
        if result.keyframe_ready:
            tracker.make_keyframe(frame)
        segment += result.new_segment
        known, T = interpolate(*given, np.array([frame.stamp_ns]))
        if not known[0]:
            raise DataError(f"{folder}: no ground truth at {frame.stamp_ns}")
        pose = result.T_odom_body
        out.append(Seen(frame.index, frame.stamp_ns, result.state, segment, pose, T[0] @ T_mocap_imu, T[0]))
    return out


def pair_of(a: Seen, b: Seen) -> ViewPair:
    moved = float(np.linalg.norm((se3.inverse(a.truth) @ b.truth)[:3, 3]))
    if a.T is None or b.T is None or a.segment != b.segment:
        return ViewPair(a, b, moved, np.nan, np.nan)
    estimate = se3.inverse(a.T) @ b.T
    error, given = (
        float(np.linalg.norm((se3.inverse(se3.inverse(first) @ second) @ estimate)[:3, 3]))
        for first, second in ((a.truth, b.truth), (a.given, b.given))
    )
    return ViewPair(a, b, moved, error, given)


# ---------------------------------------------------------------------- kitchen


def kitchen(options: argparse.Namespace) -> Iterator[str]:
    """Yield ATE of the whole and of its halves, as in docs/understand/odometry-without-imu.md."""
    folder = there(options.data / "real" / "redkitchen_0000_0499")
    yield "| frames | ATE, cm | without inertial tracker | tracked | lost, s |\n|---|---|---|---|---|"
    for frames, before in KITCHEN.items():
        first, last = map(int, frames.split(":"))
        source = open_source(str(folder), frames=slice(first, last))
        run = track(source, Config(), lambda _: None)
        found = ate_if_known(run.trajectory, source.truth()) if run.report["segments"] == 1 else None
        error = f"{100 * found.rmse:.2f}" if found else "broke"
        tracked = f"{run.report['tracked']} of {run.report['frames']}"
        yield f"| {frames} | {error} | {before} | {tracked} | {run.report['lost_s']:.1f} |"


# ---------------------------------------------------------------------- rooms


def rooms(options: argparse.Namespace) -> Iterator[str]:
    """Yield ATE over each room, by three ground truths."""
    yield "| room | fitted, cm | raw | arm | worst | tracked | stretches | lost, s | blind mocap, s |"
    yield "|---|---|---|---|---|---|---|---|---|"
    for room in ROOMS:
        folder = there(options.data.resolve() / "motion" / "tumvi" / room)
        source = room_session(folder, options)
        run = track(source, Config(), lambda _: None)
        yield f"| {room} | {room_row(run, source, mocap(folder))} |"


def room_session(folder: Path, options: argparse.Namespace) -> Source:
    motion = f"ann=tumvi:{folder},start={options.start:g},seconds={options.seconds:g}"
    session = make_cached_session(SessionRecipe(SCENE, (motion,), options.seconds, SEED), options.cache)
    return open_source(f"{session}/ann")


def room_row(run: TrackingOutput, source: Source, raw: Trajectory) -> str:
    report, truth = run.report, source.truth()
    assert truth is not None  # emulated sessions have one
    if report["segments"] == 1:
        found, given = ate(run.trajectory, truth), ate(run.trajectory, raw)
        bare = ate(on_mocap(run.trajectory, raw), raw)
        errors = " | ".join(f"{100 * m:.2f}" for m in (found.rmse, given.rmse, bare.rmse, bare.max))
    else:
        errors = "broke | | |"
    known, _ = interpolate(*raw, source.stamps()["cam0"])
    blind_s = (~known).sum() / source.rate_hz
    tracked = f"{report['tracked']} of {report['frames']}"
    return f"{errors} | {tracked} | {report['segments']} | {report['lost_s']:.1f} | {blind_s:.1f}"


def on_mocap(estimate: Trajectory, raw: Trajectory) -> Trajectory:
    """Return the estimate at the point of the body that fits the raw positions best: arm in the body and
    alignment by turns, each in closed form."""
    _, T, truth = associate(estimate, raw)
    R, p, arm = T[:, :3, :3], T[:, :3, 3], np.zeros(3)
    for _ in range(_ROUNDS):
        back = se3.inverse(umeyama(p + R @ arm, truth[:, :3, 3]))
        left = se3.transform(back, truth[:, :3, 3]) - p
        arm = (R.swapaxes(1, 2) @ left[..., None])[..., 0].mean(axis=0)
    return Trajectory(estimate.stamps_ns, estimate.T @ se3.from_rt(np.eye(3), arm))


def mocap(folder: Path) -> Trajectory:
    path = folder / "groundtruth.csv"
    stamps, values = tables.read_table(path, 8)
    return Trajectory(stamps, make_poses(values[:, :3], values[:, [4, 5, 6, 3]], path))


def there(folder: Path) -> Path:
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such recording; give its folder by --data")
    return folder


def _cm(metres: float) -> str:
    return "–" if np.isnan(metres) else f"{100 * metres:.2f}"


if __name__ == "__main__":
    sys.exit(main())
