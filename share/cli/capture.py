"""`share capture`: record the camera and IMU of a headset or robot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import camera_options, options
from share.cli.terminal import LiveLine
from share.errors import UsageError

if TYPE_CHECKING:
    from share.runtime.capture import CaptureStatus


@click.command()
@click.argument("source", default="realsense")
@camera_options.profile
@click.option("--out", required=True, metavar="REC.mcap", type=options.PATH, help="Recording to write.")
@click.option("--seconds", type=click.FloatRange(min=0, min_open=True), help="Stop after this time, s.")
@camera_options.mode
@click.option(
    "--calib", metavar="DIR", help="Record this calibration of the camera instead of the factory's."
)
@click.option("--depth", is_flag=True, help="Record depth as well.")
@click.option("--imu-only", is_flag=True, help="Record no images, as `share calibrate imu` needs.")
@click.option(
    "--min-free-gb",
    type=click.FloatRange(min=0),
    default=2.0,
    help="Stop when less than this is free on the disk, GB.",
)
@options.as_json
def capture(
    source: str,
    profile_name: str | None,
    out: Path,
    seconds: float | None,
    mode: str | None,
    calib: str | None,
    depth: bool,
    imu_only: bool,
    min_free_gb: float,
    as_json: bool,
) -> None:
    """Record a camera, its IMU, calibration and serial number as MCAP, until Ctrl-C.

    SOURCE is realsense or realsense:SERIAL. After a power cut, REC.mcap.part is left: `share dataset recover`
    makes a recording of it.

    \b
    Example:  share capture --out walk.mcap --seconds 60
    """
    from share.cameras.realsense.camera import make_feed
    from share.cameras.realsense.streams import StreamRequest
    from share.cameras.sample_queue import SampleQueue
    from share.runtime.capture import Capture
    from share.runtime.signals import stop_on_signal
    from share.runtime.source import read_given_calibration
    from share.sensors.profile import load_profile

    if depth and imu_only:
        raise UsageError("--depth and --imu-only exclude each other; give one of them")
    if calib is not None and imu_only:
        raise UsageError(
            "--calib and --imu-only exclude each other: no images are recorded; give one of them"
        )
    request = StreamRequest(
        load_profile(profile_name or camera_options.PROFILE, mode), images=not imu_only, depth=depth
    )
    given_calibration, line = read_given_calibration(calib), LiveLine()

    def print_line(text: str) -> None:
        line.print_line(f"share: {text}")

    feed = make_feed(source, request, print_line, SampleQueue())
    run = Capture(
        feed, out, min_free_gb, print_line, lambda status: line.write(_status_text(status)), given_calibration
    )
    with stop_on_signal(run.stop):
        report = run.run(seconds)
    line.end()
    click.echo(json.dumps(report) if as_json else _summary(report))


def _status_text(status: CaptureStatus) -> str:
    time_left = "" if status.minutes == float("inf") else f" ({status.minutes:.0f} min)"
    return f"{status.feed}  {status.mb_s:.1f} MB/s  {status.free_gb:.1f} GB free{time_left}"


def _summary(report: dict[str, Any]) -> str:
    from share.cli.terminal import aligned_table

    head = ["stream", "samples", "seconds", "gaps", "missing", "backward", "dropped"]
    rows = [[name, *(f"{stream[key]:g}" for key in head[1:])] for name, stream in report["streams"].items()]
    notes = camera_options.camera_events(report)
    lines = [aligned_table([head, *rows]), f"{report['imu']} IMU samples" + (f"; {notes}" if notes else "")]
    if report["foreign"]:
        lines.append(
            f"{report['foreign']} samples have stamps of the host's clock, not the camera's: "
            "see docs/do/record.md"
        )
    return "\n".join([*lines, f"{report['out']} ({report['end_reason']})"])
