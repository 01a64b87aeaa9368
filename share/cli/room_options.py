"""Options of commands that are clients of an edge, and how they wait for answers."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.errors import ShareError, UsageError

if TYPE_CHECKING:
    from share.net.keys import AgentKeys
    from share.protocol.room_events import ClientEffect
    from share.runtime.room_link import RoomLink

ANSWER_S = 10.0  # an edge that does not answer for so long is given up

server_key = click.option(
    "--server-key",
    metavar="FILE|KEY",
    help="Public key of the edge; required for an edge on another machine. Turns on encryption.",
)
name = click.option(
    "--name",
    metavar="NAME",
    help="Your name at the edge, needed with --edge; your key has to be authorized for it.",
)


def edge(help_text: str, required: bool = False) -> Callable[[Any], Any]:
    """The option --edge."""
    return click.option("--edge", "address", metavar="tcp://H:P", required=required, help=help_text)


def read_keys(folder: Path | None, server: str | None) -> AgentKeys | None:
    """Return the keys of this machine and the edge, None without --server-key. Raises UsageError."""
    from share.net.keys import agent_keys

    if server is None:
        if folder is not None:
            raise UsageError("--keys needs --server-key, the public key of the edge")
        return None
    return agent_keys(folder, server)


def open_room(
    address: str, name: str | None, keys: Path | None, server: str | None, **wants: Any
) -> RoomLink:
    """Return a client of the edge. wants: as of `RoomLink`. Raises UsageError."""
    from share.runtime.room_link import RoomLink

    if name is None:
        raise UsageError("--name is required with --edge: by the name the edge knows what you may do")
    return RoomLink(address, options.agent_name(name), read_keys(keys, server), **wants)


def news(room: RoomLink, is_waiting: Callable[[], bool]) -> Iterator[ClientEffect]:
    """Yield what happens while `is_waiting`. Raises ShareError if no edge answers for ANSWER_S."""
    from share.runtime.room_link import no_answer

    heard_s = time.monotonic()
    while is_waiting():
        yield from room.step(50)
        if room.client.is_connected:
            heard_s = time.monotonic()
        elif time.monotonic() - heard_s > ANSWER_S:
            raise no_answer(room)


def wait_for_objects(room: RoomLink) -> None:
    """Wait until all objects have come. Raises ShareError if they do not."""
    end_s = time.monotonic() + ANSWER_S
    for _ in news(room, lambda: not room.client.has_all_objects and time.monotonic() < end_s):
        pass
    if not room.client.has_all_objects:
        raise ShareError(f"the edge did not send all objects of the room for {ANSWER_S:g} s")


def answer(room: RoomLink, request: int) -> None:
    """Wait for the answer to a request about an object. Raises ShareError if it is refused, or none comes."""
    from share.protocol.room_events import RequestAnswered

    end_s = time.monotonic() + ANSWER_S
    for one in news(room, lambda: time.monotonic() < end_s):
        if isinstance(one, RequestAnswered) and one.request == request:
            if one.reason:
                raise ShareError(one.reason)
            return
    raise ShareError(f"the edge did not answer for {ANSWER_S:g} s; it may still do as asked")
