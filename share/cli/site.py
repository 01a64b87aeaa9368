"""`share site`: run the server of several rooms."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import edge_options, options
from share.config import STREAMED
from share.errors import UsageError

if TYPE_CHECKING:
    from contextlib import ExitStack

    from share.cli.edge_pages import EdgePages
    from share.cli.stderr import Stderr
    from share.config import Config
    from share.runtime.remote_room import RemoteRooms
    from share.runtime.site_rooms import RoomSetup
    from share.site.rooms_file import SitePlan


@click.command()
@click.option(
    "--rooms", "rooms_file", metavar="FILE", type=options.PATH, required=True, help="The rooms, see above."
)
@edge_options.bind
@options.policy
@options.keys
@edge_options.http
@click.option(
    "--view",
    "views",
    metavar="ROOM=[H:]P",
    multiple=True,
    help="Show this room live in 3D here (needs viser). May be repeated.",
)
@edge_options.http_token
@edge_options.allow
@edge_options.out
@click.option(
    "--ray",
    "ray",
    metavar="ADDRESS",
    help="Spread the rooms over the machines of a Ray cluster: HOST:PORT, auto (that which runs here), or "
    "local (one is started here, for a try).",
)
@options.config
@options.verbose
@options.as_json
def site(
    rooms_file: Path,
    bind: str,
    policy: str | None,
    keys: Path | None,
    http: str | None,
    views: tuple[str, ...],
    http_token: Path | None,
    allow: tuple[str, ...],
    out: Path | None,
    ray: str | None,
    config_file: Path | None,
    verbose: bool,
    as_json: bool,
) -> None:
    """Serve several rooms at one address, each with a map of its own, until Ctrl-C.

    An agent that reconnects goes on in its room; a new one begins in the first that it may enter. Whoever
    walks into another room is found there by what its camera sees, and goes on in that room's map; the agent
    does not reconnect, and loses no keyframe.

    \b
    A rooms file, in YAML:
      rooms:
        kitchen: {map: kitchen.sqlite}
        lab: {map: lab.sqlite, agents: [ann, bob], max_agents: 8, max_keyframes: 2000}
        hall:

    map: file of the room's map, relative to the rooms file; without it the map is not kept. agents: names
    that may enter the room. max_agents and max_keyframes: its limits, as edge.max_agents and
    edge.max_keyframes of --config.

    \b
    Example:  share site --rooms rooms.yaml --http 8080
    """
    from contextlib import ExitStack, closing
    from dataclasses import replace

    from share.cli.edge_output import print_access, print_event, run_summary
    from share.cli.edge_pages import EdgePages, PageOptions
    from share.cli.stderr import Stderr
    from share.net.keys import allowed_without_keys, edge_keys_for
    from share.net.transport import bind as bind_link
    from share.net.transport import parse_address
    from share.runtime.edge import EdgeRun
    from share.runtime.signals import stop_on_signal
    from share.site.rooms_file import read_rooms
    from share.wire.layouts import MAX_FRAME_BYTES

    settings = options.load_config(config_file, [policy])
    if settings.edge.policy == STREAMED:
        raise UsageError("policy streamed builds no map, so nobody can be found in a room; choose another")
    plan = read_rooms(rooms_file)
    key_pair = edge_keys_for(keys, parse_address(bind, bind=True).local)
    allowed = allowed_without_keys(allow, key_pair is not None)
    served = PageOptions(http, _view_addresses(views, plan), None, None, None, (), http_token, out)
    token = served.check(bind, False)
    with ExitStack() as stack:
        stderr = stack.enter_context(closing(Stderr()))
        remote = None if ray is None else _join(stack, ray, stderr)
        if remote is not None:
            plan = replace(plan, folder=plan.folder.absolute())
        link = stack.enter_context(closing(bind_link(bind, key_pair, MAX_FRAME_BYTES)))
        pages = EdgePages(stack, stderr, served, token, None, tuple(plan.rooms))
        rooms = [_room_setup(stack, stderr, plan, name, settings, pages) for name in plan.rooms]
        on_event = partial(print_event, stderr, verbose)
        run = EdgeRun(settings, link, out, on_event, allowed=allowed, rooms=rooms, remote=remote)
        pages.run = stack.enter_context(closing(run))
        with stop_on_signal(run.stop):
            names = ", ".join(f"'{name}'" for name in plan.rooms)
            stderr.print_line(f"listening on {link.endpoint}, policy {settings.edge.policy}, rooms {names}")
            print_access(stderr, key_pair, allowed)
            pages.print_addresses()
            report = run.run()
    click.echo(json.dumps(report) if as_json else run_summary(report))


def _view_addresses(views: tuple[str, ...], plan: SitePlan) -> dict[str, str]:
    """Return the addresses of live rooms by room. Raises UsageError."""
    addresses: dict[str, str] = {}
    for view in views:
        room, equals, address = view.rpartition("=")
        if not equals:
            raise UsageError(f"--view {view}: give ROOM=PORT or ROOM=HOST:PORT")
        if room not in plan.rooms:
            raise UsageError(f"--view {view}: there is no room '{room}'; there are {', '.join(plan.rooms)}")
        if room in addresses:
            raise UsageError(f"--view {view}: room '{room}' is shown already; give it once")
        addresses[room] = address
    return addresses


def _join(stack: ExitStack, address: str, stderr: Stderr) -> RemoteRooms:
    """Join a Ray cluster. Raises UsageError, ShareError."""
    from contextlib import closing

    from share.runtime.cluster_process import ClusterProcess
    from share.runtime.remote_room import RemoteRooms

    return RemoteRooms(stack.enter_context(closing(ClusterProcess(address, stderr.print_line))).start_worker)


def _room_setup(
    stack: ExitStack, stderr: Stderr, plan: SitePlan, room: str, settings: Config, pages: EdgePages
) -> RoomSetup:
    """Return one room, with its map opened. Raises ConfigError, UsageError, ShareError."""
    from share.cli.edge_output import open_map
    from share.runtime.edge_observer import EdgeObservers
    from share.runtime.site_rooms import RoomSetup

    one, map_file = plan.rooms[room], plan.map_file(room)
    store = None if map_file is None else stack.enter_context(open_map(stderr, map_file))
    names = None if one.agents is None else frozenset(one.agents)
    observer = EdgeObservers(*pages.room_observers(room))
    return RoomSetup(room, one.settings(settings), store, observer, names)
