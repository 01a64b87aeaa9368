"""A headset page as its server meets it: a WebSocket that speaks its messages."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from share.headset.headset_page import HeadsetPage

WAIT_S = 60.0  # tests may have a busy machine


def soon(is_true: Callable[[], Any], within_s: float = WAIT_S) -> Any:
    """What is true, as soon as it is; else the last that was not."""
    deadline = time.monotonic() + within_s
    while not (found := is_true()) and time.monotonic() < deadline:
        time.sleep(0.01)
    return found


def code(page: HeadsetPage, used: str = "") -> str:
    """The code that the edge shows, as soon as it is another than the one that is used up."""
    return str(soon(lambda: page.report().get("code", used) != used and page.report()["code"]))


class PageClient:
    """A socket to the page's server at `endpoint`."""

    def __init__(self, endpoint: str, scheme: str = "http", **options: Any) -> None:
        url = endpoint if "://" in endpoint else f"{scheme}://{endpoint}"
        options = {"origin": url, "open_timeout": WAIT_S, "max_size": 2**18} | options
        self.socket = connect(url.replace("http", "ws", 1) + "/room", **options)
        self.seen: list[dict[str, Any]] = []
        self._is_closed = threading.Event()

    def keep_alive(self) -> None:
        """Ping now and then, as a page does, whatever the test waits for."""

        def ping() -> None:
            with suppress(ConnectionClosed):
                while not self._is_closed.wait(1.0):
                    self.send(type="ping", n=10**6, sent_ms=0)

        threading.Thread(target=ping, daemon=True).start()

    def close(self) -> None:
        self._is_closed.set()
        self.socket.close()

    def __enter__(self) -> PageClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def send(self, **message: Any) -> None:
        self.socket.send(json.dumps(message))

    def hello(self, **fields: Any) -> dict[str, Any]:
        """Say hello; return the answer, a welcome or a refusal."""
        self.send(type="hello", schema=1, **fields)
        return self.hear()

    def hear(self, timeout_s: float = WAIT_S) -> dict[str, Any]:
        message: dict[str, Any] = json.loads(self.socket.recv(timeout=timeout_s))
        self.seen.append(message)
        if message["type"] == "poses":  # a page acknowledges every fourth
            with suppress(ConnectionClosed):
                self.send(type="seen", n=message["n"])
        return message

    def wait(self, kind: str, is_it: Callable[[dict[str, Any]], bool] = lambda m: True) -> dict[str, Any]:
        """The next message of this kind that is it."""
        deadline = time.monotonic() + WAIT_S
        while time.monotonic() < deadline:
            with suppress(TimeoutError):
                message = self.hear(max(0.01, deadline - time.monotonic()))
                if message["type"] == kind and is_it(message):
                    return message
        raise AssertionError(f"no {kind}; the last said: {self.seen[-5:]}")

    def is_closed(self, within_s: float = WAIT_S) -> bool:
        """Whether the server closes it, whatever it says before."""
        deadline = time.monotonic() + within_s
        try:
            while time.monotonic() < deadline:
                self.hear(max(0.01, deadline - time.monotonic()))
        except ConnectionClosed:
            return True
        except TimeoutError:
            pass
        return False

    def put(self, request: int, object_id: int, x: float, **more: Any) -> None:
        about = {"kind": "cube", "map_id": None, "position": [x, 0, 0], "quaternion": [0, 0, 0, 1]}
        self.send(type="put", request=request, id=object_id, **(about | more))


def paired(page: HeadsetPage, name: str, agent: str | None = None, keeps_alive: bool = True) -> PageClient:
    """A page that has paired as this wearer, and has heard what is told at first."""
    client = PageClient(page.endpoint, page.scheme)
    shown = code(page)
    answer = client.hello(code=shown, name=name, agent=agent)
    assert answer["type"] == "welcome", answer
    code(page, shown)
    if keeps_alive:
        client.keep_alive()
    client.wait("edge", lambda m: m["is_connected"])
    return client
