"""`share track`: track one agent without an edge."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import click

from share.cli import camera_options, options
from share.cli.terminal import LiveLine, progress
from share.errors import DataError, UsageError

if TYPE_CHECKING:
    from share.config import Config
    from share.recordings.trajectory import Trajectory
    from share.runtime.offline_tracking import OfflineFrame, TrackingOutput
    from share.runtime.source import Source
    from share.view.viewer import LiveRoom

_LONG_INIT_S = 1.0  # a first pose later than this is reported
_UNCERTAIN = {  # states of poses that are less certain
    "WEAK": "few features",
    "INERTIAL_ONLY": "IMU alone (fewer than 6 features accepted)",
    "VISION_ONLY": "images alone (no IMU)",
}


@click.command()
@click.argument("source")
@options.calib
@options.frames
@click.option(
    "--out",
    metavar="T.tum",
    type=options.PATH,
    help="File for the causal poses of the body in odom (TUM format).",
)
@click.option(
    "--report", "report_file", metavar="R.json", type=options.PATH, help="File for the report (JSON)."
)
@click.option("--view", is_flag=True, help="Show it in 3D in a browser, until Ctrl-C (needs viser).")
@camera_options.camera_options
@options.config
@options.verbose
@options.as_json
def track(
    source: str,
    calib: str | None,
    frames: slice | None,
    out: Path | None,
    report_file: Path | None,
    view: bool,
    camera: camera_options.CameraOptions,
    config_file: Path | None,
    verbose: bool,
    as_json: bool,
) -> None:
    """Track one agent without an edge: a recording as fast as possible, or a camera until Ctrl-C.

    SOURCE is an EuRoC/ASL folder, a TUM RGB-D folder with camera.yaml, an .mcap or .db3 recording, a ROS bag,
    SESSION/NAME, or realsense[:SERIAL]. A recording gives the same poses every time, to the last digit. A
    frame without a pose has no line in T.tum.

    \b
    Example:  share track rec/kitchen --out kitchen.tum --report kitchen.json
              share track realsense --out walk.tum --view
    """
    settings = options.load_config(config_file)
    paths_given = {"--out": out, "--report": report_file}
    line = LiveLine()
    opened = camera_options.open_source(
        source, calib, frames, camera, lambda text: line.print_line(f"share: {text}")
    )
    options.print_notes(opened)
    output_files = _output_files(paths_given, source)
    truth = opened.truth()  # read now: if it is damaged, fail before tracking
    room = _open_room(opened, line) if view else None
    try:
        run = _run_tracker(opened, settings, line, room)
        line.end()
        _report(opened, run, truth, output_files, verbose, as_json)
        if room is not None:
            _wait_for_interrupt(line, room)
    finally:
        if room is not None:
            room.close()


def _report(
    opened: Source,
    run: TrackingOutput,
    truth: Trajectory | None,
    output_files: dict[str, Path],
    verbose: bool,
    as_json: bool,
) -> None:
    """Write the files and print the summary. Raises DataError if no frame could be tracked."""
    from share.files.writing import atomic_write
    from share.metrics.ate import ate_if_known
    from share.recordings.trajectory import format_tum

    options.print_losses(opened)
    if not len(run.trajectory.stamps_ns):
        raise DataError(
            f"{opened.name}: none of its {run.report['frames']} frames could be tracked; check that images "
            "are bright, sharp and textured, and that the calibration is of this camera."
            + "".join(
                f" {line}." for line in [*_wait_text(run.report), *camera_options.camera_summary(run.report)]
            )
        )
    ate = ate_if_known(run.trajectory, truth) if run.report["segments"] == 1 else None
    report = {**run.report, "ate_m": ate.rmse if ate else None}
    texts = {"--out": format_tum(run.trajectory), "--report": json.dumps(report, indent=2) + "\n"}
    for option, path in output_files.items():
        atomic_write(path, texts[option])
    click.echo(json.dumps(report) if as_json else _summary(report, ate))
    if verbose:
        options.print_counters(report["sequencer"])


def _output_files(paths_given: dict[str, Path | None], source: str) -> dict[str, Path]:
    """Return the files to write, by option.

    Raises UsageError if one cannot be written, or would overwrite the source or the other.
    """
    from share.files.writing import check_writable, is_special

    files = {option: check_writable(path) for option, path in paths_given.items() if path is not None}
    for option, path in files.items():
        if path.exists() and Path(source).exists() and path.samefile(source):
            raise UsageError(f"{option} {path} is the source itself; give another name")
    paths = [path.resolve() for path in files.values() if not is_special(path)]
    if len(paths) != len(set(paths)):
        raise UsageError(f"--report {files['--report']} is the same file as --out; give another name")
    return files


def _open_room(opened: Source, line: LiveLine) -> LiveRoom:
    """Start the live room. Raises UsageError where viser is missing."""
    from share.view.viewer import LiveRoom

    room = LiveRoom("0", None, opened.name, line.print_line)
    line.print_line(f"live view at http://{room.endpoint}/")
    return room


def _wait_for_interrupt(line: LiveLine, room: LiveRoom) -> None:
    """Keep the page until Ctrl-C."""
    from share.runtime.signals import stop_on_signal

    ended = Event()
    with stop_on_signal(ended.set):
        line.print_line(f"the page at http://{room.endpoint}/ stays until Ctrl-C")
        ended.wait()


def _watcher(opened: Source, room: LiveRoom | None) -> Callable[[OfflineFrame], None]:
    """Return what shows each frame in the live room."""
    if room is None:
        return lambda step: None
    from share.view.tracking import TrackedAgent

    agent = TrackedAgent(room.feed, opened.name, opened.rig)
    return lambda step: agent.add(step.result, step.candidate, 1e3 * step.track_s, time.monotonic())


def _run_tracker(opened: Source, settings: Config, line: LiveLine, room: LiveRoom | None) -> TrackingOutput:
    """Track a whole recording, or a camera until a signal ends it."""
    from share.cameras.live import LiveSource
    from share.runtime.offline_tracking import track
    from share.runtime.signals import stop_on_signal

    def print_line(text: str) -> None:
        line.print_line(f"share: {opened.name}: {text}")

    if not isinstance(opened, LiveSource):
        with progress(opened.images_count, "tracking") as bar:
            return track(opened, settings, lambda result: bar(1), print_line, _watcher(opened, room))
    show = camera_options.TrackLine(opened.feed, line)
    with stop_on_signal(opened.stop):
        return track(opened, settings, show, print_line, _watcher(opened, room))


def _wait_text(report: dict[str, Any]) -> list[str]:
    """Return what the tracker waited for most of the time without a pose; nothing if it did not wait."""
    from share.types import WaitReason

    frames = report["waiting_frames"]
    return [f"The tracker waited for {WaitReason(max(frames, key=frames.get)).text}"] if frames else []


def _summary(report: dict[str, Any], ate: Any) -> str:
    lines = [
        f"{report['tracked']} of {report['frames']} frames tracked, {report['keyframes']} keyframes, "
        f"lost for {report['lost_s']:.1f} s",
        f"{report['cpu_ms_per_frame']:.1f} ms CPU per frame, "
        f"plus {report['decode_ms_per_frame']:.1f} ms to decode it",
    ]
    if uncertain := [
        f"{text} in {n}" for state, text in _UNCERTAIN.items() if (n := report["states"][state])
    ]:
        lines.append(f"of the frames with a pose: {', '.join(uncertain)}")
    if report["init_s"] > _LONG_INIT_S:
        lines.append(". ".join([f"the first pose came after {report['init_s']:.1f} s", *_wait_text(report)]))
    if report["inconsistent_frames"]:
        lines.append(
            f"images and IMU contradict each other in "
            f"{report['inconsistent_frames']} frames: check that camera and "
            "IMU are mounted as the calibration says, and that their clocks agree"
        )
    if report["segments"] > 1:
        lines.append(f"tracking was lost: {report['segments']} odometry segments, each in a frame of its own")
    if ate:
        lines.append(
            f"ATE {100 * ate.rmse:.2f} cm rms, {100 * ate.max:.2f} cm at most "
            f"({ate.n} causal poses, SE3 alignment)"
        )
    return "\n".join([*lines, *camera_options.camera_summary(report)])
