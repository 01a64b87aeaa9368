"""Basalt and our inertial tracker on the same emulated sequences. Prints a Markdown table.

    python -m venv DIR && DIR/bin/pip install depthai==3.12.0
    python tools/measure_peers.py --python DIR/bin/python [--only NAME] [--seeds 101,102,103]

Causal poses of all frames, scored the same way. The peer runs in its own interpreter, at its own pace. CPU is
process time of all threads between a frame's images and its pose, decoding apart; ours with its keyframe.
Runs are kept in --out; docs/peers.md has a table and says what is not fair in it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from share import process

process.prepare()

import numpy as np  # noqa: E402
import vio_options  # noqa: E402
from peer_wire import Moment, read_line, write_line, write_moment  # noqa: E402
from tool_main import exit_code  # noqa: E402
from vio_kept import code_version, keep, kept  # noqa: E402
from vio_run import follow  # noqa: E402
from vio_sequences import Sequence  # noqa: E402
from vio_table import line  # noqa: E402

from share.config import Config  # noqa: E402
from share.core.measurement import IMU  # noqa: E402
from share.core.sequencer import SequencerCounters  # noqa: E402
from share.emulate.session import cached_session  # noqa: E402
from share.errors import DataError, UsageError  # noqa: E402
from share.geometry import se3  # noqa: E402
from share.geometry.camera import Camera  # noqa: E402
from share.io.files import atomic_write  # noqa: E402
from share.io.source import Source, open_source  # noqa: E402
from share.io.trajectory import Trajectory  # noqa: E402
from share.metrics.ate import ate  # noqa: E402
from share.metrics.rpe import rpe_time  # noqa: E402
from share.run.pipeline import frames_of  # noqa: E402
from share.types import F64  # noqa: E402

ADAPTOR = Path(__file__).parent / "peer_basalt.py"
INSTALL = "python -m venv DIR && DIR/bin/pip install depthai==3.12.0, then --python DIR/bin/python"
COLUMNS = ("sequence", "seed", "tracker", "ATE cm", "most cm", "RPE 1 s cm", "with a pose %")
CPU_COLUMNS = ("CPU ms a frame", "mean", "p99")

Row = dict[str, Any]


@dataclass
class Run:
    """Of the frames with a pose: stamps and T_world_body. CPU ms of each but the first frame."""

    stamps: list[int] = field(default_factory=list)
    poses: list[F64] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)


def main() -> int:
    options = arguments()
    return exit_code("measure_peers", lambda: measure(options))


def arguments() -> argparse.Namespace:
    parser = vio_options.parser(__doc__, "peers", (101,))
    parser.add_argument("--python", type=Path, metavar="PATH", help="interpreter that has the peer")
    return parser.parse_args()


def measure(options: argparse.Namespace) -> None:
    """All runs, seed by seed; then the table."""
    trackers, chosen = dict(trackers_of(options)), vio_options.chosen(options)
    rows = [
        row
        for seed in options.seeds
        for sequence in chosen
        for row in both(sequence, seed, trackers, options)
    ]
    text = table(rows)
    print(text)
    atomic_write(options.out / "table.md", text + "\n")


def trackers_of(options: argparse.Namespace) -> Iterator[tuple[str, Callable[[Source], Run]]]:
    """Name with version, and how to run it over a source. A peer that is not there is named."""
    python = options.python
    name = None if python is None else version_of(python)
    if name is None:
        why = "no --python is given" if python is None else f"{python} does not have it"
        print(f"left out: Basalt, {why}; {INSTALL}", file=sys.stderr)
    else:
        code = hashlib.sha256(b"".join(p.read_bytes() for p in sorted(ADAPTOR.parent.glob("peer_*.py"))))
        yield f"{name} {code.hexdigest()[:8]}", lambda source: peer_run(source, [str(python), str(ADAPTOR)])
    yield f"SHARE {code_version()}", our_run


def version_of(python: Path) -> str | None:
    """What the adaptor calls the peer, None where that interpreter cannot run it."""
    try:
        told = subprocess.run([python, ADAPTOR, "--version"], capture_output=True, check=False)
    except OSError:
        return None
    return str(json.loads(told.stdout)["version"]) if told.returncode == 0 else None


def both(
    sequence: Sequence, seed: int, trackers: dict[str, Callable[[Source], Run]], options: argparse.Namespace
) -> Iterator[Row]:
    """A row of each tracker; from its JSON, if that is of this code and session."""
    recipe = sequence.recipe(seed, options.data)
    source: Source | None = None
    for name, tracker in trackers.items():
        made_by = {"sequence": sequence.name, "seed": seed, "tracker": name, "session": recipe.digest}
        file = options.out / f"{sequence.name}-{seed}-{name.split()[0]}.json"
        row = None if options.again else kept(file, made_by)
        if row is None:
            if source is None:
                source = open_source(str(cached_session(recipe, options.cache, options.workers) / "agent"))
            row = made_by | figures(source, tracker(source))
            options.out.mkdir(parents=True, exist_ok=True)
            keep(file, row)
            print(cells(row), file=sys.stderr, flush=True)
        yield row


def our_run(source: Source) -> Run:
    """As shipped. A frame's CPU is that of its pose and of its keyframe, if it became one."""
    told = follow(source, Config())
    keyframes = iter(told.keyframe_ms)
    cpu_ms = [row.track_ms + (next(keyframes) if row.keyframe else 0.0) for row in told.log.rows]
    return Run(told.stamps, told.poses, cpu_ms[1:])


def peer_run(source: Source, command: list[str]) -> Run:
    """Every frame in turn through a process that speaks as peer_wire says. Raises DataError if it fails."""
    run = Run()
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as peer:
        assert peer.stdin and peer.stdout
        try:
            write_line(peer.stdin, calibration(source))
            for moment in moments(source):
                write_moment(peer.stdin, moment)
                answer = read_line(peer.stdout)
                if answer is None:
                    raise BrokenPipeError
                run.stamps.append(moment.stamp_ns)
                run.poses.append(np.array(answer["T_world_body"]))
                run.cpu_ms.append(1e3 * answer["cpu_s"])
            peer.stdin.close()
        except BrokenPipeError:
            raise DataError(f"the peer ended at frame {len(run.stamps)}; see above") from None
    run.cpu_ms = run.cpu_ms[1:]
    return run


def calibration(source: Source) -> dict[str, Any]:
    """The rig in plain numbers. Raises UsageError where it is not stereo with an IMU."""
    rig = source.rig
    if rig.cam1 is None or rig.T_cam1_cam0 is None or rig.imu is None:
        raise UsageError(f"{source.name}: is {rig.kind}; the peer needs stereo+imu")
    T_body_cam1 = rig.T_body_cam0 @ se3.inverse(rig.T_cam1_cam0)
    cameras = [_camera(rig.cam0, rig.T_body_cam0), _camera(rig.cam1, T_body_cam1)]
    return {"cameras": cameras, "imu": vars(rig.imu)}


def _camera(camera: Camera, T_body_cam: F64) -> dict[str, Any]:
    """distortion: k1, k2, p1, p2, k3, or fewer."""
    size = {"width": camera.width, "height": camera.height}
    distortion = list(camera.distortion)
    return size | {"K": camera.K.tolist(), "distortion": distortion, "T_body_cam": T_body_cam.tolist()}


def moments(source: Source) -> Iterator[Moment]:
    """All frames with both images, up to the last that an IMU sample comes after. Time is the cameras'."""
    told = [
        (m.stamp_ns - source.rig.timeshift_ns, m.payload) for m in source.measurements() if m.stream == IMU
    ]
    told.sort(key=lambda sample: sample[0])
    stamps, values = np.array([t for t, _ in told], np.int64), np.array([v for _, v in told], np.float64)
    done = 0
    for frame in frames_of(source, Config(), SequencerCounters()):
        end = int(np.searchsorted(stamps, frame.stamp_ns, "right")) + 1
        if frame.image1 is None or end > len(stamps):
            continue
        yield Moment(frame.stamp_ns, stamps[done:end], values[done:end], frame.image0, frame.image1)
        done = end


def figures(source: Source, run: Run) -> Row:
    """One alignment over all frames. Raises DataError where there are too few poses."""
    truth, estimate = source.truth(), Trajectory(np.array(run.stamps, np.int64), np.array(run.poses))
    assert truth is not None  # the emulator writes it
    absolute, relative = ate(estimate, truth), rpe_time(estimate, truth)
    return {
        "ate_cm": 100 * absolute.rmse,
        "worst_cm": 100 * absolute.max,
        "rpe_1s_cm": 100 * relative.translation.rmse,
        "told": len(run.stamps) / source.images_count,
        "cpu_ms": float(np.median(run.cpu_ms)),
        "cpu_mean_ms": float(np.mean(run.cpu_ms)),
        "cpu_p99_ms": float(np.percentile(run.cpu_ms, 99)),
    }


def table(rows: list[Row]) -> str:
    head = [*COLUMNS, *CPU_COLUMNS]
    return "\n".join([line(head), line(["---"] * len(head)), *map(cells, rows)])


def cells(row: Row) -> str:
    """A line of the table."""
    numbers = [f"{row[key]:.2f}" for key in ("ate_cm", "worst_cm", "rpe_1s_cm")]
    cpu = [f"{row[key]:.1f}" for key in ("cpu_ms", "cpu_mean_ms", "cpu_p99_ms")]
    name = " ".join(row["tracker"].split()[:-1])
    return line([row["sequence"], str(row["seed"]), name, *numbers, f"{100 * row['told']:.1f}", *cpu])


if __name__ == "__main__":
    sys.exit(main())
