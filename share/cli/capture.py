"""`share capture`: record a headset or robot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.cli.progress import LiveLine
from share.errors import UsageError

if TYPE_CHECKING:
    from share.run.capture import Status


@click.command()
@click.argument("source", default="realsense")
@click.option("--profile", "profile_name", required=True, help="Kind of camera: d435i, or a profile's file.")
@click.option("--out", required=True, metavar="REC.mcap", type=click.Path(path_type=Path), help="Recording.")
@click.option("--seconds", type=click.FloatRange(min=0, min_open=True), help="End after so long.")
@click.option("--mode", metavar="WxH[@HZ]", help="Image size and rate; default: the profile's.")
@click.option("--depth", is_flag=True, help="Record depth too.")
@click.option("--imu-only", is_flag=True, help="No images: for `share calibrate imu`.")
@click.option(
    "--min-free-gb",
    type=click.FloatRange(min=0),
    default=2.0,
    show_default=True,
    help="Of the disk, this much stays free.",
)
@options.as_json
def capture(
    source: str,
    profile_name: str,
    out: Path,
    seconds: float | None,
    mode: str | None,
    depth: bool,
    imu_only: bool,
    min_free_gb: float,
    as_json: bool,
) -> None:
    """Record a camera with its IMU and factory calibration until Ctrl-C, as MCAP.

    SOURCE is realsense or realsense:SERIAL. After a power cut, `share dataset recover` mends the .part.

    \b
    Example:  share capture --profile d435i --out walk.mcap --seconds 60
    """
    from share.config import SequencerConfig
    from share.io.profile import profile
    from share.io.realsense.camera import RealSense
    from share.io.realsense.streams import Wanted
    from share.run.capture import Capture
    from share.run.stop import on_stop

    if depth and imu_only:
        raise UsageError("--depth, --imu-only: give one of them")
    wanted = Wanted(profile(profile_name, mode), images=not imu_only, depth=depth)
    line = LiveLine()
    run = Capture(
        lambda serial, epoch: RealSense(wanted, serial, epoch=epoch),
        serial_of(source),
        wanted.rates_hz(),
        out,
        SequencerConfig().max_jump_s,
        min_free_gb,
        lambda text: line.say(f"share: {text}"),
        lambda status: line.write(_live(status)),
    )
    with on_stop(run.stop):
        report = run.go(seconds)
    line.end()
    click.echo(json.dumps(report) if as_json else _summary(report))


def serial_of(source: str) -> str | None:
    """The serial number in realsense[:SERIAL], None if there is none. Raises UsageError."""
    kind, _, serial = source.partition(":")
    if kind != "realsense":
        raise UsageError(f"{source}: cannot be recorded; give realsense or realsense:SERIAL")
    return serial or None


def _live(status: Status) -> str:
    rates = " ".join(f"{name} {hz:.0f}" for name, hz in status.rates_hz.items())
    lasts = "" if status.minutes == float("inf") else f" ({status.minutes:.0f} min)"
    return (
        f"{status.health.value}  {rates} Hz  missing {status.missing}  dropped {status.dropped}  "
        f"queue {status.queue}  {status.mb_s:.1f} MB/s  {status.free_gb:.1f} GB free{lasts}"
    )


def _summary(report: dict[str, Any]) -> str:
    from share.cli.table import aligned

    head = ["stream", "samples", "seconds", "gaps", "missing", "backward", "dropped"]
    rows = [[name, *(f"{told[key]:g}" for key in head[1:])] for name, told in report["streams"].items()]
    met = ("imu_alone", "foreign", "wraps", "jumps", "strays", "past", "reconnections", "resets")
    notes = ", ".join(f"{name.replace('_', ' ')} {report[name]}" for name in met if report[name])
    lines = [aligned([head, *rows]), f"{report['imu']} IMU samples joined" + (f"; {notes}" if notes else "")]
    if report["foreign"]:
        lines.append(
            f"{report['foreign']} stamps are of the host's clock, not of the camera's: see docs/capture.md"
        )
    return "\n".join([*lines, f"{report['out']} ({report['ended']})"])
