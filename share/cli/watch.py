"""`share watch`: look at a running edge from a terminal, also over ssh."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import click

from share.cli import options
from share.cli.terminal import LiveLine
from share.errors import ShareError, UsageError, printable

_PERIOD_S, _TIMEOUT_S = 0.5, 2.0
_MAX_ROWS = 200  # printed where no terminal is
_PORT = 8080


@click.command()
@click.argument("address", default=f"127.0.0.1:{_PORT}", metavar="[H:P]")
@click.option(
    "--http-token",
    metavar="FILE",
    type=options.EXISTING_FILE,
    help="The file that `share edge --http-token` made; needed from other machines.",
)
@click.option("--once", is_flag=True, help="Print the room as it is now, and end.")
@options.as_json
def watch(address: str, http_token: Path | None, once: bool, as_json: bool) -> None:
    """Show the room of a running edge as text, twice a second, until Ctrl-C.

    Draws the paths of all agents seen from above, and of each agent its state, the age of its poses against
    what its kind tolerates, QoE and keyframe rate, and what is wrong. It reads the status page at H:P
    (127.0.0.1:8080; either may be left out) of an edge that runs with --http, and changes nothing there.
    Without a terminal, or with --once or --json, it prints once: text, or the edge's report.

    \b
    Example:  share watch 192.168.1.10:8080 --http-token room.token
    """
    from share.cli.terminal_room import EdgeStatus, draw_room, has_room, reading_report, room_lines
    from share.net.http_guard import read_token
    from share.view.terminal_picture import TerminalPicture

    url = _status_url(address)
    token = None if http_token is None else read_token(http_token)
    status = EdgeStatus(url, token, _TIMEOUT_S)
    report, plan = status.report_and_plan()
    live, picture = LiveLine(), TerminalPicture()
    if as_json:
        click.echo(json.dumps(report))
        return
    if once or not has_room(live):
        lines = room_lines(picture, report, plan, _MAX_ROWS)
        click.echo(
            "\n".join(lines) if any(lines) else f"{url}: {report.get('loading') or 'no agent has come yet'}"
        )
        return
    answered_s = time.monotonic()
    try:
        while True:
            with reading_report():
                below = _last_line(url, report, time.monotonic() - answered_s)
            draw_room(live, picture, report, plan, below)
            time.sleep(_PERIOD_S)
            try:
                report, plan = status.report_and_plan()
                answered_s = time.monotonic()
            except ShareError:
                continue  # the last line says for how long
    finally:
        live.end()


def _status_url(address: str) -> str:
    """Return http://HOST:PORT/. Raises UsageError."""
    from share.net.transport import parse_address

    bare = address.removeprefix("http://").rstrip("/")
    if bare.isdigit():
        bare = f"127.0.0.1:{bare}"
    elif ":" not in bare.rpartition("]")[2]:
        bare = f"{bare}:{_PORT}"
    try:
        if address.startswith("https://"):
            raise UsageError(address)
        parsed = parse_address(f"tcp://{bare}")
    except UsageError:
        raise UsageError(
            f"'{address}' is not the address of a status page; expected HOST:PORT, such as 127.0.0.1:{_PORT}"
        ) from None
    host = f"[{parsed.host}]" if ":" in parsed.host else parsed.host
    return f"http://{host}:{parsed.port}/"


def _last_line(url: str, report: dict[str, Any], silent_s: float) -> str:
    """Return what is wrong with the edge itself, else how long it has run."""
    if silent_s > 2 * _PERIOD_S + _TIMEOUT_S:
        return f"{url} has not answered for {silent_s:.0f} s; this is what it said last"
    if troubles := report.get("trouble"):
        return f"the edge: {troubles[0]}"
    if loading := report.get("loading"):
        return f"{url} is {printable(str(loading))}"
    minutes, seconds = divmod(int(report.get("uptime_s") or 0), 60)
    merges = (report.get("merges") or {}).get("done", 0)
    return f"{url} up {minutes}:{seconds:02d} min, policy {report.get('policy')}, {merges} merges"
