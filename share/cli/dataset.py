"""`share dataset`: inspect, convert, recover and align recordings; inspect, export and prune maps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from share.cli import options
from share.cli.commands import CommandGroup
from share.cli.terminal import progress
from share.errors import ConfigError, UsageError


@click.group(cls=CommandGroup, prefix="dataset ")
def dataset() -> None:
    """Inspect, convert, recover and align recordings; inspect maps, export them, delete agents from them.

    \b
    Example:  share dataset info rec/kitchen
    """


@dataset.command(short_help="Describe a recording or a map.")
@click.argument("source")
@options.calib
@options.frames
@options.as_json
def info(source: str, calib: str | None, frames: slice | None, as_json: bool) -> None:
    """Describe a recording (streams, rates, gaps, calibration, ground truth) or an edge's map; the topics of
    ROS messages without a calibration.

    \b
    Example:  share dataset info rec/kitchen
              share dataset info session/ann --json
              share dataset info room.sqlite
    """
    from share.recordings.bags.opening import is_message_file, open_messages
    from share.recordings.describe import describe_messages, describe_recording
    from share.runtime.source import open_source
    from share.store.export import describe_map
    from share.store.map_store import MapStore, is_map

    if is_map(Path(source)):
        if calib or frames:
            raise UsageError(f"{source} is a map; --calib and --frames work only with recordings")
        found = describe_map(MapStore.read(Path(source)))
        click.echo(json.dumps(found) if as_json else _map_text(found))
        return
    try:
        description = describe_recording(open_source(source, calib, frames))
    except ConfigError as error:  # no calibration: its topics at least
        if calib is not None or not is_message_file(Path(source)):
            raise
        description = describe_messages(open_messages(Path(source)), str(error))
        click.echo(json.dumps(description) if as_json else _messages_text(description))
        return
    click.echo(json.dumps(description) if as_json else _description_text(description))


@dataset.command(short_help="Write a recording as MCAP or as an EuRoC/ASL folder.")
@click.argument("source")
@click.option(
    "--out",
    required=True,
    metavar="PATH",
    type=options.PATH,
    help="X.mcap to write, or a new folder with --format euroc.",
)
@options.calib
@options.frames
@click.option(
    "--jpeg",
    type=click.IntRange(1, 100),
    metavar="QUALITY",
    help="Compress gray images as JPEG of this quality.  [default: keep images as they are, byte for byte]",
)
@click.option(
    "--format",
    "kind",
    type=click.Choice(["mcap", "euroc"]),
    default="mcap",
    help="mcap (one file of ROS 2 messages) or euroc (an EuRoC/ASL folder).",
)
@options.as_json
def convert(
    source: str,
    out: Path,
    calib: str | None,
    frames: slice | None,
    jpeg: int | None,
    kind: str,
    as_json: bool,
) -> None:
    """Write a recording as MCAP (ROS 2 messages) or as an EuRoC/ASL folder.

    The calibration is written too. A ground-truth trajectory goes beside X.mcap as X.truth.tum, where all
    commands find it. On failure nothing is left behind.

    \b
    Example:  share dataset convert rec/kitchen --out kitchen.mcap --frames 0:250
    """
    from share.files.writing import check_replaceable
    from share.recordings.convert import to_euroc, to_mcap
    from share.runtime.source import open_source

    if kind == "euroc" and jpeg is not None:
        raise UsageError("--jpeg works only with --format mcap; leave it out")
    if kind == "mcap":
        _check_mcap(check_replaceable(out), source)
    opened = open_source(source, calib, frames)
    options.print_notes(opened)
    with progress(opened.images_count, "converting") as bar:
        if kind == "mcap":
            to_mcap(opened, out, jpeg, bar)
        else:
            to_euroc(opened, out, bar)
    options.print_losses(opened)
    count = opened.images_count
    done = {"out": str(out), "format": kind, "frames": count, "skipped": opened.losses.counts}
    click.echo(json.dumps(done) if as_json else f"{out}: {count} frames")


@dataset.command(short_help="Recover a recording that was cut off.")
@click.argument("broken", type=options.PATH)
@click.option("--out", required=True, metavar="GOOD.mcap", type=options.PATH, help="Recording to write.")
@options.as_json
def recover(broken: Path, out: Path, as_json: bool) -> None:
    """Recover all intact messages of an MCAP recording that was cut off (a crash, a power cut, a full disk).

    A recording in progress is named X.mcap.part; after a crash, that is the file to recover.

    \b
    Example:  share dataset recover walk.mcap.part --out walk.mcap
    """
    from share.recordings.mcap.recorder import recover_recording as run

    if not broken.is_file():
        raise UsageError(f"{broken}: no such file")
    _check_mcap(out, broken)
    with progress(broken.stat().st_size, "recovering") as bar:
        result = run(broken, out, bar)
    click.echo(json.dumps(result._asdict()) if as_json else _recovery_text(broken, out, result))


@dataset.command(short_help="Write a map, recording or run for other programs.")
@click.argument("source")
@click.option(
    "--out", required=True, metavar="PATH", type=options.PATH, help="A new folder; X.mcap or X.rrd for those."
)
@click.option(
    "--format",
    "kind",
    type=click.Choice(["tum", "mcap", "rrd", "colmap", "kitti"]),
    default="tum",
    help="tum (of a map: NAME.tum, points.ply, loops.csv), mcap (ROS 2 messages for Foxglove and RViz), rrd "
    "(Rerun), colmap (text model with pictures) or kitti (poses of cam0).",
)
@options.calib
@options.frames
@options.as_json
def export(source: str, out: Path, kind: str, calib: str | None, frames: slice | None, as_json: bool) -> None:
    """Export an edge's map, a recording or the folder of a run for other programs.

    A map gives its keyframes, an edge may be running with it; a recording is tracked and gives its poses in
    odom, with its keyframes; a run gives the trajectories in it. With --format tum, for maps only, DIR gets
    NAME.tum for each agent, points.ply and loops.csv. If a map file holds several maps, each gets its own
    folder, or a frame of its own in one file.

    \b
    Example:  share dataset export room.sqlite --out room
              share dataset export room.sqlite --format colmap --out room-colmap
              share dataset export rec/kitchen --format mcap --out kitchen-3d.mcap
    """
    from share.cli.dataset_export import export_map_tables, export_scenes, open_scenes

    if kind == "tum":
        if calib or frames:
            raise UsageError("--calib and --frames work only with recordings; name another --format")
        export_map_tables(source, out, as_json)
    else:
        export_scenes(open_scenes(source, calib, frames), out, kind, as_json)


def _check_mcap(out: Path, source: str | Path) -> None:
    if out.suffix != ".mcap":
        raise UsageError(f"--out {out}: give a name that ends in .mcap")
    if out.exists() and Path(source).exists() and out.samefile(source):
        raise UsageError(f"--out {out} is the source itself; give another name")


def _recovery_text(broken: Path, out: Path, result: Any) -> str:
    lines = [f"{out}: {sum(result.messages.values())} messages recovered"]
    lines += [f"  {topic:<34} {count:>8}" for topic, count in sorted(result.messages.items())]
    if result.reason:
        lines.append(f"lost: {result.lost_bytes} bytes ({result.reason})")
    if not result.lost_bytes:
        lines.append(f"nothing was lost: {broken} can be deleted")
    return "\n".join(lines)


def _description_text(d: dict[str, Any]) -> str:
    device = f", device {d['serial']}" if d["serial"] else ""
    lines = [f"{d['name']}: {d['kind']}, {d['duration_s']:.1f} s{device}"]
    for name, s in d["streams"].items():
        line = f"  {name:<6} {s['count']:>7} at {s['rate_hz']:.5g} Hz"
        if s["gaps"]:
            line += f", {s['gaps']} gaps (longest {s['longest_gap_s']:.3g} s)"
        lines.append(line + "".join(f", {s[k]} {k}" for k in ("duplicates", "backward") if s[k]))
    for name in ("cam0", "cam1", "depth"):
        if name in d["calibration"]:
            lines.append(f"  {name:<6} {_camera_text(d['calibration'][name])}")
    if "baseline_m" in d["calibration"]:
        lines.append(f"  baseline {100 * d['calibration']['baseline_m']:.2f} cm")
    if shift := d["calibration"].get("timeshift_s", 0.0):
        lines.append(f"  IMU time minus camera time {1e3 * shift:.3f} ms")
    truth = d["truth"]
    lines.append(
        f"  truth  {truth['poses']} poses, {truth['length_m']:.2f} m in {truth['duration_s']:.1f} s"
        if truth
        else "  truth  none"
    )
    return "\n".join(lines + [f"  note: {note}" for note in d["notes"]])


def _messages_text(d: dict[str, Any]) -> str:
    lines = [f"{d['name']}: ROS messages, {d['duration_s']:.1f} s"]
    for name, topic in d["topics"].items():
        gaps = f", {topic['gaps']} gaps (longest {topic['longest_gap_s']:.3g} s)" if topic["gaps"] else ""
        rate = f" at {topic['rate_hz']:.5g} Hz" if topic["count"] > 1 else ""
        lines.append(f"  {name}  {topic['type']}  {topic['count']}{rate}{gaps}")
    return "\n".join(lines + [f"  note: {note}" for note in d["notes"]])


def _camera_text(camera: dict[str, Any]) -> str:
    (width, height), (fx, fy, *_) = camera["resolution"], camera["intrinsics"]
    lens_name = "fisheye" if camera["lens"] == "equidistant" else "radial-tangential"
    distortion = lens_name if camera["distortion"] else "no distortion"
    return f"{width}x{height}, f {fx:.1f} {fy:.1f} px, {camera['fov_deg']:.0f} deg wide, {distortion}"


def _map_text(d: dict[str, Any]) -> str:
    lines = [f"{d['name']}: map, schema {d['schema'] or '?'}, {d['bytes'] / 1e6:.1f} MB"]
    for name, agent in d["agents"].items():
        removed = agent["next_keyframe"] - agent["keyframes"]
        segments_text = f", {agent['segments']} segments" if agent["segments"] > 1 else ""
        lines.append(
            f"  {name:<10} {agent['kind']:<6} {agent['keyframes']:>6} keyframes, {removed} removed"
            f"{segments_text}"
        )
    lines += [f"  map {name}: {count} keyframes" for name, count in d["maps"].items()]
    lines.append(f"  {d['loops']} loops, {d['solved']} keyframes in the latest solution")
    return "\n".join(lines + [f"  damage: {line}" for line in d["damage"]])
