"""`share dataset info` and `export` for the edge's map."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from share.cli import options
from share.cli.terminal import progress
from share.errors import UsageError


@click.command(short_help="Write an edge's map as TUM and PLY files.")
@click.argument("map_file", metavar="MAP")
@click.option("--out", required=True, metavar="DIR", help="A new folder.")
@options.as_json
def export(map_file: str, out: str, as_json: bool) -> None:
    """Export the trajectories, points and loops of an edge's map for other programs.

    DIR gets NAME.tum for each agent, points.ply and loops.csv; if MAP holds several maps, each gets its own
    folder. The edge may be running.

    \b
    Example:  share dataset export room.sqlite --out room
    """
    import json

    from share.store.export import export_map as run
    from share.store.map_store import MapStore

    if not Path(map_file).is_file():
        raise UsageError(f"{map_file}: no such file")
    map_state = MapStore.read(Path(map_file)).load()
    for complaint in map_state.problems:
        click.echo(f"share: {map_file}: {complaint}", err=True)
    with progress(len(map_state.keyframes), "exporting") as bar:
        exported = run(map_state, Path(out), bar)
    if as_json:
        click.echo(json.dumps({name: {**vars(e), "folder": str(e.folder)} for name, e in exported.items()}))
        return
    for name, e in exported.items():
        click.echo(
            f"{e.folder}: map {name}, {e.keyframes} keyframes of {', '.join(e.agents)}; "
            f"{e.points} points, {e.loops} loops"
        )


def map_info(path: Path) -> dict[str, Any]:
    """Describe a map file. Raises ShareError."""
    from share.store.export import describe_map
    from share.store.map_store import MapStore

    return describe_map(MapStore.read(path))


def map_info_text(d: dict[str, Any]) -> str:
    """Return `map_info` as text."""
    lines = [f"{d['name']}: map, schema {d['schema']}, {d['bytes'] / 1e6:.1f} MB"]
    for name, agent in d["agents"].items():
        removed = agent["next_keyframe"] - agent["keyframes"]
        segments_text = f", {agent['stretches']} segments" if agent["stretches"] > 1 else ""
        lines.append(
            f"  {name:<10} {agent['kind']:<6} {agent['keyframes']:>6} keyframes, {removed} removed"
            f"{segments_text}"
        )
    lines += [f"  map {name}: {count} keyframes" for name, count in d["maps"].items()]
    lines.append(f"  {d['loops']} loops, {d['solved']} keyframes in the latest solution")
    return "\n".join(lines + [f"  damage: {line}" for line in d["damage"]])
