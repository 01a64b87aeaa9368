"""One wearer's client of the edge, in a thread: what its page asks for goes out under its own name.

What comes back is told in the page's messages and numbers. It connects again by itself; what it cannot do is
answered.
"""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable
from contextlib import closing
from typing import Any

from share.errors import ShareError
from share.headset import page_messages as page
from share.net.keys import AgentKeys
from share.protocol import room_events as ev
from share.runtime.room_link import RoomLink
from share.wire.room_messages import CommandState

_STEP_MS = 200
_RETRY_S = 2.0  # after a refusal
_MAX_WISHES = 256  # of a page that wait to be taken
_MAX_COMMANDS = 64  # whose numbers are remembered

Tell = Callable[[dict[str, Any]], None]


class WearerLink:
    """A client of the edge at `address` with the wearer's name. tell: is called from its thread with
    messages for the page, of which `objects` and `robots` have one entry each. `close` may be repeated."""

    def __init__(self, address: str, name: str, keys: AgentKeys | None, tell: Tell) -> None:
        self._address, self._name, self._keys, self._tell = address, name, keys, tell
        self._wishes: queue.Queue[page.PageRequest | page.PageCommand] = queue.Queue(_MAX_WISHES)
        self._ended = threading.Event()
        self._link: RoomLink | None = None
        self._requests: dict[int, int] = {}  # the page's numbers by the link's
        self._commands: dict[int, int] = {}
        self._is_connected, self._said = False, ""
        self._thread = threading.Thread(target=self._run, name=f"wearer {name}", daemon=True)
        self._thread.start()

    def ask(self, wish: page.PageRequest | page.PageCommand) -> bool:
        """Take what the page wants; return whether there is room. Safe from any thread."""
        try:
            self._wishes.put_nowait(wish)
        except queue.Full:
            return False
        self._wake()
        return True

    def close(self) -> None:
        """End in a moment: its robots stop."""
        self._ended.set()
        self._wake()

    def join(self, timeout_s: float) -> None:
        self._thread.join(timeout_s)

    def _wake(self) -> None:
        if (link := self._link) is not None:
            link.wake()

    # ------------------------------------------------------------------ its thread

    def _run(self) -> None:
        while not self._ended.is_set():
            try:
                with closing(self._open()) as link:
                    self._link = link
                    self._serve(link)
            except ShareError as error:
                self._fail(str(error))
                self._ended.wait(_RETRY_S)
            finally:
                self._link = None

    def _open(self) -> RoomLink:
        return RoomLink(
            self._address,
            self._name,
            self._keys,
            print_line=self._note,
            wants_objects=True,
            wants_robots=True,
        )

    def _serve(self, link: RoomLink) -> None:
        while not self._ended.is_set():
            with contextlib.suppress(queue.Empty):
                while True:
                    self._send(link, self._wishes.get_nowait())
            effects = link.step(_STEP_MS)
            self._watch(link.client.is_connected)
            for effect in effects:
                self._take(effect)

    def _send(self, link: RoomLink, wish: page.PageRequest | page.PageCommand) -> None:
        number = next(link.numbers)
        try:
            if isinstance(wish, page.PageRequest):
                message: Any = page.as_request(wish, number)
                self._requests[number] = wish.request
            else:
                message = page.as_command(wish, number)
                self._commands[number] = wish.command
                while len(self._commands) > _MAX_COMMANDS:
                    del self._commands[next(iter(self._commands))]
        except ValueError as error:
            self._refuse(wish, str(error))
            return
        link.handle(ev.MessageWanted(message))

    def _refuse(self, wish: page.PageRequest | page.PageCommand, reason: str) -> None:
        self._tell(refusal_of(wish, reason, self._name))

    def _take(self, effect: ev.ClientEffect) -> None:
        match effect:
            case ev.RequestAnswered(number, reason):
                if (request := self._requests.pop(number, None)) is not None:
                    self._tell({"type": "receipt", "request": request, "reason": reason})
            case ev.ObjectChanged(changed) if changed.removed:
                gone = {"id": changed.object_id, "reason": changed.removed}
                self._tell({"type": "objects", "objects": [], "removed": [gone]})
            case ev.ObjectChanged(changed):
                self._tell({"type": "objects", "objects": [page.object_fields(changed)], "removed": []})
            case ev.RobotSeen(place):
                self._tell({"type": "robots", "robots": [page.robot_fields(place)]})
            case ev.CommandChanged(state):
                self._tell(page.command_fields(state, self._page_number(state)))

    def _page_number(self, state: CommandState) -> int | None:
        """Return the page's number of a command; None of another's."""
        if state.commander not in ("", self._name):
            return None
        if state.is_final:
            return self._commands.pop(state.command, None)
        return self._commands.get(state.command)

    # ------------------------------------------------------------------ how it stands with the edge

    def _note(self, text: str) -> None:
        self._said = text

    def _watch(self, is_connected: bool) -> None:
        """Tell when the edge is there, or is not."""
        if is_connected != self._is_connected:
            self._is_connected = is_connected
            text = self._said or ("connected to the edge" if is_connected else "the edge does not answer")
            self._tell({"type": "edge", "is_connected": is_connected, "text": text})

    def _fail(self, reason: str) -> None:
        """Answer all that is open: the edge does not serve this client."""
        self._is_connected = False
        self._tell({"type": "edge", "is_connected": False, "text": reason})
        for request in self._requests.values():
            self._tell({"type": "receipt", "request": request, "reason": reason})
        for command in self._commands.values():
            self._refuse(page.PageCancel(command), reason)
        self._requests, self._commands = {}, {}
        with contextlib.suppress(queue.Empty):
            while True:
                self._refuse(self._wishes.get_nowait(), reason)


def refusal_of(wish: page.PageRequest | page.PageCommand, reason: str, name: str) -> dict[str, Any]:
    """Return the answer to what is not done."""
    if isinstance(wish, page.PageRequest):
        return {"type": "receipt", "request": wish.request, "reason": reason}
    text = f"refused: {reason}"
    about = {"command": wish.command, "robot": wish.robot, "commander": name, "text": text}
    return {"type": "command", **about, "is_final": True, "is_reached": False}
