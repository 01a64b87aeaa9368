"""An edge whose mapper is a thread, and a link that agents have sent messages over."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable
from typing import Any

from share.net.transport import IncomingMessage
from share.runtime.worker_process import END, Inbox
from share.wire.codec import encode
from share.wire.messages import peer_id


class Thread:
    """A `WorkerProcess` within this process."""

    pid = None

    def __init__(self, name: str, work: Any, arguments: tuple[Any, ...], on_answer: Any, *rest: Any) -> None:
        self._inbox: Inbox = Inbox()
        self._thread = threading.Thread(target=work, args=(self._inbox, on_answer, *arguments), name=name)
        self._thread.start()
        self.send = self._inbox.put

    def close(self) -> None:
        self._inbox.put(END)
        self._thread.join(20)


class Link:
    """A link that agents have sent these messages over."""

    endpoint = "nowhere"

    def __init__(self, messages: Iterable[tuple[int, Any]]) -> None:
        self._waiting = [IncomingMessage(peer_id(run), list(encode(message))) for run, message in messages]
        self._waiting.append(IncomingMessage(peer_id(99), [b"of a stranger"]))

    def receive(self, timeout_ms: int) -> IncomingMessage | None:
        if self._waiting:
            return self._waiting.pop(0)
        time.sleep(min(timeout_ms, 1) / 1e3)
        return None

    def refusals(self) -> list[str]:
        return []

    def send(self, peer: bytes, frames: object) -> None: ...
    def agent_names(self, key: str) -> None: ...
    def trouble(self) -> None: ...
    def expect_growth(self, is_expected: bool) -> None: ...
    def wake(self) -> None: ...
    def close(self) -> None: ...
