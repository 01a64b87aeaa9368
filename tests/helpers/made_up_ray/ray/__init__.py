"""A made-up Ray of one machine. Its head is gone while a file (`MADE_UP_HEAD`) is: calls never return."""

import os
import socket
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from ray import exceptions

__all__ = ["exceptions", "get", "init", "nodes", "remote", "shutdown"]
_server = socket.create_server(("127.0.0.1", 0))


def _wait_for_head() -> None:
    while not Path(os.environ["MADE_UP_HEAD"]).exists():
        time.sleep(0.02)


def init(**_: Any) -> None:
    if not Path(os.environ["MADE_UP_HEAD"]).exists():
        raise ConnectionError("Could not find any running Ray instance")


def nodes() -> list[dict[str, Any]]:
    _wait_for_head()
    where = {"NodeManagerAddress": "127.0.0.1", "NodeManagerPort": _server.getsockname()[1]}
    return [{"NodeID": "one", "Alive": True, "Resources": {"CPU": 0.5}, **where}]


def get(call: Any, timeout: float | None = None) -> Any:
    _wait_for_head()
    return call()


def remote(cls: type) -> Any:
    def make() -> Any:
        host = cls()
        return SimpleNamespace(
            call=SimpleNamespace(remote=lambda room, request: lambda: host.call(room, request)),
            drop=SimpleNamespace(remote=host.drop),
        )

    return SimpleNamespace(options=lambda **_: SimpleNamespace(remote=make))


def shutdown() -> None: ...
