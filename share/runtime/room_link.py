"""A client of an edge in the caller's thread: the state machine `share.protocol.room_client` and its link."""

from __future__ import annotations

import itertools
import secrets
import time
from collections.abc import Callable

from share.errors import ShareError, describe_exception
from share.net.keys import AgentKeys
from share.net.transport import connect
from share.protocol import room_events as ev
from share.protocol.common_events import Connected, EdgeMessageReceived, FailRun, PrintLine, SendToEdge, Tick
from share.protocol.room_client import RoomClient
from share.timing import LineLimiter
from share.wire.room_messages import ClientHello

_MAX_MESSAGES = 64  # in one step: a flood cannot use up the CPU


class RoomLink:
    """One run of a client. print_line: takes lines for a person. Raises UsageError for a bad address, or one
    that needs keys."""

    def __init__(
        self,
        address: str,
        name: str,
        keys: AgentKeys | None = None,
        *,
        silent_s: float = 3.0,
        print_line: Callable[[str], None] = lambda text: None,
        drives_robot: bool = False,
        wants_objects: bool = False,
        wants_robots: bool = False,
    ) -> None:
        self.address, self._print_line = address, print_line
        run_id = secrets.randbits(63)
        hello = ClientHello(name, run_id, drives_robot, wants_objects, wants_robots)
        self.client = RoomClient(hello, silent_s, keeps_trying=drives_robot)
        # rising within the run, and hardly the same in another
        self.numbers = itertools.count(secrets.randbits(40) << 20)
        self._lines = LineLimiter()
        self._news: list[ev.ClientEffect] = []
        self._trouble: str | None = None
        self._link = connect(address, run_id, keys)

    @property
    def trouble(self) -> str:
        """Why the edge does not answer, as far as it is known."""
        return self._link.trouble() or "is `share edge` running there?"

    def handle(self, event: ev.ClientEvent) -> None:
        """Handle an event; what follows comes with the next `step`. Raises the error of a refusal."""
        try:
            effects = self.client.handle(event, time.monotonic_ns())
        except Exception as error:  # a bug costs this event
            self._say_new(f"handling {type(event).__name__}: {describe_exception(error)}")
            return
        for effect in effects:
            match effect:
                case SendToEdge():
                    self._link.send(effect.frames)  # what counts is repeated
                case PrintLine():
                    self._print_line(effect.text)
                case FailRun():
                    raise effect.error
                case _:
                    self._news.append(effect)

    def step(self, timeout_ms: int) -> list[ev.ClientEffect]:
        """Wait for a message for at most this time, handle all that has come, and return what follows. Raises
        ShareError if the edge refuses this client."""
        for i in range(_MAX_MESSAGES):
            frames = self._link.receive(0 if i or self._news else timeout_ms)
            if self._link.poll_connected():
                self.handle(Connected())
            if frames is None:
                break
            self.handle(EdgeMessageReceived(frames))
        if (trouble := self._link.trouble()) is not None:
            self._say_new(trouble)
        if trouble != self._trouble:
            self._trouble = trouble
            self.handle(ev.LinkTroubled(trouble or ""))
        self.handle(Tick())
        news, self._news = self._news, []
        return news

    def wake(self) -> None:
        """Make the current or next `step` return early. Safe from any thread."""
        self._link.wake()

    def close(self) -> None:
        """Say bye and drop the link."""
        self.handle(ev.ClientEnded())
        self._link.close()

    def _say_new(self, text: str) -> None:
        if (line := self._lines.admit_new(text, time.monotonic_ns())) is not None:
            self._print_line(line)


def no_answer(room: RoomLink) -> ShareError:
    """Return the error for an edge that does not answer."""
    return ShareError(f"no edge answered at {room.address}; {room.trouble}")
