"""`share edge`: the server of a room."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.config import POLICY_NAMES, STREAMED
from share.errors import UsageError

if TYPE_CHECKING:
    from share.cli.saying import Stderr
    from share.net.keys import EdgeKeys
    from share.store.map_store import MapStore


@click.command()
@click.option("--bind", default="tcp://127.0.0.1:5555", show_default=True, metavar="tcp://H:P")
@click.option(
    "--policy",
    type=click.Choice(POLICY_NAMES),
    help="Whom the edge serves how much. By default share; covins-g: every keyframe is sent and merged.",
)
@options.keys
@click.option("--map", "map_file", metavar="FILE", help="Keep the map here, and go on with what is in it.")
@click.option("--http", metavar="[H:]P", help="Serve /, /health, /metrics and /snapshot.json here.")
@click.option("--out", metavar="DIR", help="Write events.jsonl and edge.json here.")
@options.config
@options.verbose
@options.as_json
def edge(
    bind: str,
    policy: str | None,
    keys: str | None,
    map_file: str | None,
    http: str | None,
    out: str | None,
    config_file: str | None,
    verbose: bool,
    as_json: bool,
) -> None:
    """Join the maps of all agents and send corrections back. Ctrl-C ends it.

    Says when agents come and go and when maps are joined; with -v, every decision and its reason.
    To be reached from other machines it needs keys: see `share keys --help`.

    With --map, what it has acknowledged survives whatever ends it; started again, it goes on there.

    \b
    Example:  share edge --bind tcp://127.0.0.1:5555 --map room.sqlite --http 8080 --out out/edge
    """
    settings = options.load_config(config_file)
    from contextlib import ExitStack, closing
    from dataclasses import replace

    from share.cli.saying import Stderr
    from share.net.transport import bind as bind_link
    from share.net.transport import parse_address
    from share.runtime.edge import EdgeRun
    from share.runtime.signals import stop_on_signal
    from share.runtime.status_server import StatusServer
    from share.wire.codec import MAX_FRAME_BYTES, MAX_IMAGE_BYTES

    edge_key_pair = _edge_keys(keys, parse_address(bind, bind=True).local)
    if policy is not None:
        settings = replace(settings, edge=replace(settings.edge, policy=policy))
    is_streamed = settings.edge.policy == STREAMED
    if is_streamed and map_file is not None:
        raise UsageError("--map: there is none by policy streamed; leave it out, or take another policy")
    max_message_bytes = MAX_IMAGE_BYTES if is_streamed else MAX_FRAME_BYTES
    folder = None if out is None else Path(out)
    runs: list[EdgeRun] = []
    with ExitStack() as stack:
        stderr = stack.enter_context(closing(Stderr()))
        link = stack.enter_context(closing(bind_link(bind, edge_key_pair, max_message_bytes)))
        status = None
        if http is not None:  # before any process is started: the port may be in use
            status = stack.enter_context(
                closing(StatusServer(http, lambda: runs[0].report() if runs else {}, stderr.tell))
            )
        store = None if map_file is None else stack.enter_context(_open_map(stderr, Path(map_file)))
        run = stack.enter_context(
            closing(EdgeRun(settings, link, folder, lambda e: _print_event(stderr, e, verbose), store))
        )
        runs.append(run)
        with stop_on_signal(run.stop):
            stderr.tell(f"listening on {link.endpoint}, policy {settings.edge.policy}")
            _say_keys(stderr, edge_key_pair)
            if status is not None:
                stderr.tell(f"status at http://{status.endpoint}/")
            report = run.run()
    click.echo(json.dumps(report) if as_json else _summary(report))


def _edge_keys(folder: str | None, local: bool) -> EdgeKeys | None:
    """Those of --keys; for a network, else of the default folder, if there are any. Raises UsageError."""
    from share.net.keys import default_folder, edge_keys, has_pair

    if folder is None and (local or not has_pair(default_folder())):
        return None
    return edge_keys(None if folder is None else Path(folder))


def _open_map(stderr: Stderr, path: Path) -> MapStore:
    """Says what is in it, and what is wrong with it. Raises UsageError, ShareError."""
    from share.store.map_store import MapStore

    store = MapStore.open(path)
    map_state = store.opened_map()
    for complaint in map_state.problems:
        stderr.tell(f"map {path}: {complaint}")
    if not store.writable:
        stderr.tell(f"map {path}: {store.read_only_reason}; what is in it is used, nothing new is kept")
    counts = (
        f"{len(map_state.keyframes)} keyframes of {len(map_state.runs)} runs, {len(map_state.loops)} loops"
    )
    stderr.tell(f"map {path}: {counts}")
    return store


def _say_keys(stderr: Stderr, keys: EdgeKeys | None) -> None:
    if keys is not None:
        names = ", ".join(sorted(keys.allowed.names_by_key().values()))
        stderr.tell(f"public key '{keys.own.public}'; authorized: {names or 'nobody yet'}")


_SHOWN_EVENTS = {"agent joined", "left", "reconnected", "silent", "refused"}
_SHOWN_EVENTS |= {
    "not let in",
    "maps merged",
    "merge undone",
    "step failed",
    "not written",
    "mapper lost",
    "solver lost",
}
_SHOWN_EVENTS |= {"odometry suspect", "map", "tracking lost"}


def _print_event(stderr: Stderr, event: dict[str, Any], verbose: bool) -> None:
    if verbose or event["event"] in _SHOWN_EVENTS:
        agent = f" {event['agent']}:" if event["agent"] else ""
        stderr.tell(f"{event['t_s']:9.3f} s {event['event']}:{agent} {event['reason']}")


def _summary(report: dict[str, Any]) -> str:
    lines = [_agent_summary(name, agent) for name, agent in report["agents"].items()]
    if loops := report.get("loops"):  # the mapper has reported
        done = report["merges"]["done"]
        lines.append(f"loops: {loops['tried']} tried, {loops['accepted']} accepted; {done} merges")
    return "\n".join(lines)


def _agent_summary(name: str, a: dict[str, Any]) -> str:
    up = f"{a['bytes_up'] / 1e6:.2f} MB up"
    if "frames_streamed" in a:
        done = f"{a['frames_tracked']} of {a['frames_streamed']} frames tracked"
        return f"{name}: {done}, {a['frames_dropped']} left out, {up}"
    where = a.get("map_id") or "none yet"
    return f"{name}: {a['keyframes']} keyframes, {a['corrections']} corrections, {up}, in map {where}"
