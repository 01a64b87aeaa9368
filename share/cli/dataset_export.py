"""`share dataset export` for each kind of source and format."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.cli.terminal import print_note, progress
from share.errors import UsageError

if TYPE_CHECKING:
    from share.mapping.map_changes import StoredMap
    from share.recordings.exports.scene import Scene


def export_map_tables(source: str, out: Path, as_json: bool) -> None:
    """Write the trajectories, points and loops of a map. Raises UsageError, ShareError."""
    from share.recordings.session import SESSION_FILE
    from share.store.export import export_map
    from share.store.map_store import is_map

    path = Path(source)
    is_recording = not path.is_file() or path.suffix in (".mcap", ".bag", ".db3")
    if not (path.exists() or (path.parent / SESSION_FILE).exists()):
        raise UsageError(f"{source}: no such file")
    if is_recording and not is_map(path):
        kinds = "mcap, rrd, colmap or kitti"
        raise UsageError(f"{source}: is not a map, and --format tum is for maps; give {kinds}")
    map_state = _read_map(path)
    with progress(len(map_state.keyframes), "exporting") as bar:
        exported = export_map(map_state, out, bar)
    if as_json:
        click.echo(json.dumps({name: {**vars(e), "folder": str(e.folder)} for name, e in exported.items()}))
        return
    for name, e in exported.items():
        click.echo(
            f"{e.folder}: map {name}, {e.keyframes} keyframes of {', '.join(e.agents)}; "
            f"{e.points} points, {e.loops} loops"
        )


def open_scenes(source: str, calib: str | None, frames: slice | None) -> list[Scene]:
    """Return what a map, a run or a recording holds; the latter is tracked. Raises UsageError, ShareError."""
    from share.runtime.scenes import is_run, map_scenes, recording_scene, run_scene
    from share.runtime.source import open_source
    from share.store.map_store import is_map

    path = Path(source)
    if is_map(path) or is_run(path):
        if calib or frames:
            raise UsageError(f"{source} is no recording; --calib and --frames work only with one")
        return map_scenes(_read_map(path), path) if is_map(path) else [run_scene(path)]
    opened = open_source(source, calib, frames)
    options.print_notes(opened)
    settings = options.load_config(None)
    with progress(opened.images_count, "tracking") as bar:
        scene = recording_scene(opened, settings, bar, lambda text: print_note(opened.name, text))
    options.print_losses(opened)
    return [scene]


def export_scenes(scenes: list[Scene], out: Path, kind: str, as_json: bool) -> None:
    """Write scenes in a format. Raises UsageError, ShareError."""
    from share.recordings.exports.mcap_scene import write_mcap
    from share.recordings.exports.rerun_file import write_rerun

    total = sum(len(scene.views) for scene in scenes)
    with progress(total, "exporting") as bar:
        if kind in ("mcap", "rrd"):
            _check_suffix(out, kind)
            (write_mcap if kind == "mcap" else write_rerun)(scenes, out, bar)
        else:
            _write_folders(scenes, out, kind, bar)
    counts: list[dict[str, Any]] = [
        {
            "name": scene.name,
            "frame": scene.frame,
            "agents": list(scene.agents),
            "poses": sum(len(agent.trajectory.stamps_ns) for agent in scene.agents.values()),
            "keyframes": len(scene.views),
            "points": sum(len(view.points) for view in scene.views),
        }
        for scene in scenes
    ]
    if as_json:
        click.echo(json.dumps({"out": str(out), "scenes": counts}))
        return
    for one in counts:
        click.echo(
            f"{out}: {one['name']}, {one['poses']} poses of {', '.join(one['agents'])}; "
            f"{one['keyframes']} keyframes, {one['points']} points"
        )


def _write_folders(scenes: list[Scene], out: Path, kind: str, bar: Callable[[int], None]) -> None:
    """Write each scene to a folder of its own, a single one to `out`. On error nothing is left."""
    from share.files.writing import new_folder
    from share.recordings.exports.colmap import write_colmap
    from share.recordings.exports.kitti import write_kitti
    from share.recordings.exports.names import map_folders

    write = write_colmap if kind == "colmap" else write_kitti
    with new_folder(out) as work:
        folders = map_folders(work, [scene.name for scene in scenes])
        for scene in scenes:
            write(scene, folders[scene.name], bar)


def _check_suffix(out: Path, kind: str) -> None:
    if out.suffix != f".{kind}":
        raise UsageError(f"--out {out}: give a name that ends in .{kind}")


def _read_map(path: Path) -> StoredMap:
    from share.store.map_store import MapStore

    map_state = MapStore.read(path).load()
    for complaint in map_state.problems:
        print_note(str(path), complaint)
    return map_state
