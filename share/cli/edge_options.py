"""Options that `share edge` and `share site` share."""

from __future__ import annotations

import click

from share.cli import options

bind = click.option(
    "--bind", default="tcp://127.0.0.1:5555", metavar="tcp://H:P", help="Address to listen on."
)
http = click.option(
    "--http", metavar="[H:]P", help="Serve a status page, /health, /metrics and /snapshot.json here."
)
http_token = click.option(
    "--http-token",
    metavar="FILE",
    type=options.PATH,
    help="Ask for the token in this file, made if it is not there; needed to serve other machines.",
)
allow = click.option(
    "--allow",
    "allow",
    type=click.Choice(["commands", "objects"]),
    multiple=True,
    help="Without keys: what all on this machine may do: commands (send robots), objects (place them). "
    "May be repeated.",
)
out = click.option("--out", metavar="DIR", type=options.PATH, help="Folder for events.jsonl and edge.json.")
