"""`share keys`: manage the keys with which other machines connect to an edge."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from share.cli import options
from share.cli.commands import CommandGroup


@click.group(cls=CommandGroup, prefix="keys ")
def keys() -> None:
    """Generate keys, and authorize the agents that may connect to an edge.

    \b
    Both machines:  share keys generate
    At the edge:    share keys authorize ann 'PUBLIC KEY OF ANN'
                    share edge --bind tcp://0.0.0.0:5555
    At the agent:   add --server-key 'PUBLIC KEY OF THE EDGE' to `share agent`

    \b
    Example:  share keys generate
    """


@keys.command(short_help="Generate this machine's key pair.")
@click.option("--name", metavar="NAME", help="Name of the key pair.  [default: this machine's name]")
@options.keys
@options.as_json
def generate(name: str | None, keys: Path | None, as_json: bool) -> None:
    """Generate this machine's key pair and print the public key.

    NAME.public may be copied anywhere; NAME.secret must stay on this machine. An existing pair is kept.

    \b
    Example:  share keys generate
    """
    from share.net.keys import generate_pair as make

    folder = _key_folder(keys)
    pair = make(folder, name)
    if as_json:
        click.echo(json.dumps({"folder": str(folder), "name": pair.name, "public_key": pair.public}))
        return
    click.echo(f"{folder / pair.name}.public: give this key to the other machine:", err=True)
    click.echo(pair.public)


@keys.command(short_help="Allow an agent to connect.")
@click.argument("name")
@click.argument("public_key", metavar="KEY|FILE")
@click.option(
    "--agent",
    "agents",
    multiple=True,
    metavar="AGENT",
    help="Name of an agent on that machine, if not NAME. May be repeated.",
)
@click.option("--commands/--no-commands", default=None, help="Whether it may send robots.")
@click.option("--objects/--no-objects", default=None, help="Whether it may place objects in the room.")
@options.keys
def authorize(
    name: str,
    public_key: str,
    agents: tuple[str, ...],
    commands: bool | None,
    objects: bool | None,
    keys: Path | None,
) -> None:
    """Allow an agent to connect, by the public key of its machine: the text in single quotes, or NAME.public.

    NAME is the machine's name. Its key is valid for the agent of that name, or for those given with --agent,
    and for no other. A running edge accepts the agent's next attempt, within about a second. Repeated for the
    same key, it changes what is given. At first a key may neither send robots nor place objects.

    \b
    Example:  share keys authorize ann ann.public
              share keys authorize headset1 headset1.public --agent ann --commands --objects
    """
    from share.net import keys as store
    from share.wire.room_messages import Permission

    permissions = {Permission.COMMANDS: commands, Permission.OBJECTS: objects}
    store.authorize(_key_folder(keys), name, store.public_key(public_key), agents, permissions)


@keys.command(short_help="Withdraw a machine's authorization.")
@click.argument("name")
@options.keys
def revoke(name: str, keys: Path | None) -> None:
    """Withdraw the authorization of machine NAME. A running edge disconnects its agents at once.

    \b
    Example:  share keys revoke ann
    """
    from share.net.keys import revoke as drop

    drop(_key_folder(keys), name)


@keys.command("list", short_help="List this machine's public key and the authorized ones.")
@options.keys
@options.as_json
def list_keys(keys: Path | None, as_json: bool) -> None:
    """List this machine's public key and the authorized ones.

    \b
    Example:  share keys list
    """
    from share.net.keys import edge_keys

    folder = _key_folder(keys)
    edge_key_set = edge_keys(folder)
    grants = sorted(
        (grant.name, key, grant.agents, sorted(grant.permissions))
        for key, grant in edge_key_set.allowed.grants().items()
    )
    own: dict[str, Any] = {"name": edge_key_set.own.name, "public_key": edge_key_set.own.public}
    if as_json:
        listed = [
            {"name": name, "public_key": key, "agents": agents, "may": may}
            for name, key, agents, may in grants
        ]
        click.echo(json.dumps({"folder": str(folder), "own": own, "authorized": listed}))
        return
    click.echo(f"{edge_key_set.own.public}  {edge_key_set.own.name} (this machine)")
    for name, key, agents, may in grants:
        others = "" if agents == (name,) else f", for {', '.join(agents)}"
        click.echo(f"{key}  {name}{others}{'; may: ' + ', '.join(may) if may else ''}")


def _key_folder(folder_given: Path | None) -> Path:
    from share.net.keys import default_folder

    return folder_given or default_folder()
