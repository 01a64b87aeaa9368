"""`share track`: one agent, no edge."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from share.cli import options
from share.cli.progress import progress


@click.command()
@click.argument("source")
@options.calib
@options.frames
@click.option("--out", metavar="T.tum", help="Write the causal poses of the body in odom here.")
@click.option("--report", "report_file", metavar="R.json", help="Write the report here.")
@options.config
@options.as_json
def track(
    source: str,
    calib: str | None,
    frames: slice | None,
    out: str | None,
    report_file: str | None,
    config_file: str | None,
    as_json: bool,
) -> None:
    """Track one agent over a recording, without an edge, as fast as it goes.

    SOURCE is an EuRoC/ASL folder, a TUM RGB-D folder with camera.yaml, an .mcap recording or
    SESSION/NAME. The same recording always gives the same poses, to the last digit. A frame that
    could not be tracked has no line in T.tum.

    \b
    Example:  share track rec/kitchen --out kitchen.tum --report kitchen.json
    """
    settings = options.load_config(config_file)
    from share.io.files import atomic_write, check_writable
    from share.io.source import open_source
    from share.io.trajectory import format_tum
    from share.run.track import accuracy, track

    wanted = [check_writable(Path(name)) for name in (out, report_file) if name]
    opened = open_source(source, calib, frames)
    with progress(opened.images_count, "tracking") as bar:
        run = track(opened, settings, bar)
    ate = accuracy(run, opened.truth())
    report = {**run.report, "ate_m": ate.rmse if ate else None}
    texts = {out: format_tum(run.trajectory), report_file: json.dumps(report, indent=2) + "\n"}
    for path in wanted:
        atomic_write(path, texts[str(path)])
    click.echo(json.dumps(report) if as_json else _summary(report, ate))


def _summary(report: dict[str, Any], ate: Any) -> str:
    lines = [
        f"{report['tracked']} of {report['frames']} frames tracked, {report['keyframes']} keyframes, "
        f"lost for {report['lost_s']:.1f} s",
        f"{report['cpu_ms_per_frame']:.1f} ms CPU a frame, "
        f"and {report['decode_ms_per_frame']:.1f} ms to decode it",
    ]
    if ate:
        lines.append(
            f"ATE {100 * ate.rmse:.2f} cm rms, {100 * ate.max:.2f} cm at most "
            f"({ate.n} causal poses, SE3 alignment)"
        )
    return "\n".join(lines)
