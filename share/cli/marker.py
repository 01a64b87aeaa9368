"""`share marker`: objects of the shared room, which all its clients see."""

from __future__ import annotations

import json
import math
from contextlib import closing
from pathlib import Path
from typing import Any

import click

from share.cli import options, room_options
from share.cli.commands import CommandGroup

_edge = room_options.edge("Address of the edge.", required=True)


@click.group(cls=CommandGroup, prefix="marker ")
def marker() -> None:
    """Place, list and remove objects of the shared room: markers and cubes.

    Who may place them: `share keys authorize … --objects`, or without keys `share edge --allow objects`.

    \b
    Example:  share marker put 1.5 -0.5 --edge tcp://127.0.0.1:5555 --name ann
    """


@marker.command(short_help="Place an object, or move it.", context_settings={"ignore_unknown_options": True})
@click.argument("x", type=float)
@click.argument("y", type=float)
@click.argument("z", type=float, default=0.0)
@click.option(
    "--yaw", type=float, default=0.0, help="Where it faces, degrees counterclockwise from the map's x."
)
@click.option(
    "--kind",
    type=click.Choice(["marker", "cube"]),
    default="marker",
    help="What it is shown as: marker or cube.",
)
@click.option("--id", "object_id", type=click.IntRange(0, 2**31 - 1), help="Its id.  [default: a new one]")
@click.option(
    "--map-id", metavar="ID", help="Map in which it is meant.  [default: that of your agent, or the only one]"
)
@_edge
@room_options.name
@options.keys
@room_options.server_key
@options.as_json
def put(
    x: float,
    y: float,
    z: float,
    yaw: float,
    kind: str,
    object_id: int | None,
    map_id: str | None,
    address: str,
    name: str | None,
    keys: Path | None,
    server_key: str | None,
    as_json: bool,
) -> None:
    """Place an object at X Y Z, m in the map, and print its id. With the --id of one that is there, move it.

    \b
    Example:  share marker put 1.5 -0.5 --edge tcp://127.0.0.1:5555 --name ann
    """
    import secrets

    from share.library.room import placed
    from share.protocol.room_events import MessageWanted

    chosen = secrets.randbelow(2**31) if object_id is None else object_id
    message = placed(secrets.randbits(40), chosen, kind, (x, y, z), math.radians(yaw), map_id)
    with closing(room_options.open_room(address, name, keys, server_key)) as room:
        room.handle(MessageWanted(message))
        room_options.answer(room, message.request)
    click.echo(json.dumps({"id": chosen}) if as_json else str(chosen))


@marker.command(short_help="Remove an object.")
@click.argument("object_id", metavar="ID", type=click.IntRange(0, 2**31 - 1))
@_edge
@room_options.name
@options.keys
@room_options.server_key
def remove(object_id: int, address: str, name: str | None, keys: Path | None, server_key: str | None) -> None:
    """Remove an object, whoever placed it.

    \b
    Example:  share marker remove 7 --edge tcp://127.0.0.1:5555 --name ann
    """
    from share.protocol.room_events import MessageWanted
    from share.wire.room_messages import RemoveObject

    with closing(room_options.open_room(address, name, keys, server_key)) as room:
        message = RemoveObject(next(room.numbers), object_id)
        room.handle(MessageWanted(message))
        room_options.answer(room, message.request)


@marker.command("list", short_help="List the objects of the room.")
@_edge
@room_options.name
@options.keys
@room_options.server_key
@options.as_json
def list_objects(
    address: str, name: str | None, keys: Path | None, server_key: str | None, as_json: bool
) -> None:
    """List the objects of the room: id, kind, owner, place and map.

    \b
    Example:  share marker list --edge tcp://127.0.0.1:5555 --name ann
    """
    with closing(room_options.open_room(address, name, keys, server_key, wants_objects=True)) as room:
        room_options.wait_for_objects(room)
        objects = sorted(room.client.objects.items())
    rows: list[dict[str, Any]] = [
        {
            "id": n,
            "kind": str(one.kind),
            "owner": one.owner,
            "position": [round(v, 4) for v in one.T_map_object[:3, 3].tolist()],
            "yaw_deg": round(math.degrees(math.atan2(one.T_map_object[1, 0], one.T_map_object[0, 0])), 2),
            "map_id": one.map_id,
        }
        for n, one in objects
    ]
    if as_json:
        click.echo(json.dumps(rows))
        return
    for row in rows:
        px, py, pz = row["position"]
        place = f"x {px:.2f} y {py:.2f} z {pz:.2f} m, {row['yaw_deg']:.0f}°"
        click.echo(f"{row['id']:>10}  {row['kind']:<6}  {row['owner']:<12}  {place} in {row['map_id']}")
    if not rows:
        click.echo("no objects", err=True)
