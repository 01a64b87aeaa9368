"""`share edge`: run the server of a room."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import click

from share.cli import edge_options, options
from share.cli.blind_edge import condition_text, edge_settings
from share.cli.edge_output import open_map, print_access, print_event, run_summary
from share.cli.edge_pages import EdgePages, PageOptions, edge_access
from share.config import STREAMED
from share.errors import UsageError


@click.command()
@edge_options.bind
@options.policy
@click.option(
    "--blind",
    metavar="KEY:LETTER",
    help="The policy of this letter by the key of a study (`share study plan`), shown as the letter.",
)
@options.keys
@click.option(
    "--map",
    "map_file",
    metavar="FILE",
    type=options.PATH,
    help="Keep the map in this file; continue with what it holds.",
)
@edge_options.http
@click.option("--view", metavar="[H:]P", help="Show the room live in 3D here (needs viser).")
@click.option(
    "--headset",
    metavar="[http://]H:P",
    help="Serve the page that headsets wear here, encrypted; with http:// for adb reverse.",
)
@click.option(
    "--headset-cert",
    metavar="FILE",
    type=options.PATH,
    help="Certificate of --headset.  [default: one of its own, made on first use]",
)
@click.option("--headset-key", metavar="FILE", type=options.PATH, help="Key of --headset-cert.")
@click.option(
    "--mount",
    "mounts",
    metavar="NAME=FILE",
    multiple=True,
    help="Where the headset of agent NAME sits on its device: headset.yaml of share calibrate headset. May "
    "be repeated.",
)
@edge_options.http_token
@edge_options.allow
@edge_options.out
@options.config
@options.verbose
@options.as_json
def edge(
    bind: str,
    policy: str | None,
    blind: str | None,
    keys: Path | None,
    map_file: Path | None,
    http: str | None,
    view: str | None,
    headset: str | None,
    headset_cert: Path | None,
    headset_key: Path | None,
    mounts: tuple[str, ...],
    http_token: Path | None,
    allow: tuple[str, ...],
    out: Path | None,
    config_file: Path | None,
    verbose: bool,
    as_json: bool,
) -> None:
    """Merge the maps of all agents and send corrections, until Ctrl-C.

    Prints when agents connect and leave and when maps merge; with -v, every decision and its reason.
    Agents on other machines need keys: see `share keys --help`.

    With --map, every keyframe that the edge acknowledged survives a crash; the next start continues there.

    \b
    Example:  share edge --bind tcp://127.0.0.1:5555 --map room.sqlite --http 8080 --view 8081
    """
    settings, blinding = edge_settings(config_file, policy, blind)
    from contextlib import ExitStack, closing

    from share.cli.stderr import Stderr
    from share.net.keys import allowed_without_keys, edge_keys_for
    from share.net.transport import bind as bind_link
    from share.net.transport import parse_address
    from share.runtime.edge import EdgeRun
    from share.runtime.signals import stop_on_signal
    from share.wire.layouts import MAX_FRAME_BYTES, MAX_IMAGE_BYTES

    edge_key_pair = edge_keys_for(keys, parse_address(bind, bind=True).local)
    allowed = allowed_without_keys(allow, edge_key_pair is not None)
    is_streamed = settings.edge.policy == STREAMED
    if is_streamed and map_file is not None:
        raise UsageError("--map: policy streamed builds no map; leave it out, or choose another policy")
    views = {} if view is None else {"": view}
    served = PageOptions(http, views, headset, headset_cert, headset_key, mounts, http_token, out)
    token = served.check(bind, is_streamed)
    max_message_bytes = MAX_IMAGE_BYTES if is_streamed else MAX_FRAME_BYTES
    with ExitStack() as stack:
        stderr = stack.enter_context(closing(Stderr()))
        link = stack.enter_context(closing(bind_link(bind, edge_key_pair, max_message_bytes)))
        # before any process starts: the port may be in use
        access = None if headset is None else edge_access(link.endpoint, edge_key_pair, allowed)
        pages = EdgePages(stack, stderr, served, token, access)
        store = None if map_file is None else stack.enter_context(open_map(stderr, map_file))
        on_event = partial(print_event, stderr, verbose)
        run = EdgeRun(settings, link, out, on_event, store, pages.observers, allowed, blinding)
        pages.run = stack.enter_context(closing(run))
        with stop_on_signal(run.stop):
            stderr.print_line(f"listening on {link.endpoint}, {condition_text(settings, blinding)}")
            print_access(stderr, edge_key_pair, allowed)
            pages.print_addresses()
            report = run.run()
    click.echo(json.dumps(report) if as_json else run_summary(report))
