"""The wearers that have paired: who they are, what they may do, and their state between two connections."""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from share.agent_names import checked_name
from share.errors import ShareError, UsageError
from share.headset.outbox import Outbox
from share.headset.page_messages import (
    PageCancel,
    PageCommand,
    PageGoto,
    PageHello,
    PageMeasured,
    PageRequest,
)
from share.headset.pairing import PairingDesk, PairingError
from share.headset.session_ledger import SessionLedger, moment_now
from share.headset.wearer_link import Tell, WearerLink, refusal_of
from share.headset.wearer_session import (
    SessionOverError,
    WearerSession,
    check_end,
    seal,
    unseal,
)
from share.net.keys import AgentKeys, AllowList, allow_list
from share.net.lent_keys import LentKeys
from share.timing import TokenBucket, TokenBuckets
from share.wire.room_messages import Permission

MAX_WEARERS = 8
ABSENT_S = 6.0  # a page that is away for longer commands no robot: what it sent stops
_END_S = 3.0  # after that its client of the edge ends, which has told the robots by then
_POINTS_LIMIT = (2.0, 0.5)  # times that a page is sent the points of a map, at once and a second
_COMMAND_LIMIT = (5.0, 2.0)  # goals of a page, and as many stops, at once and a second
_MAX_COMMANDS = 16  # of a wearer, whose state is told again to a page that comes back


class ListDamagedError(PairingError):
    """The edge's list of keys cannot be read: who is on it is not known now."""


@dataclass(frozen=True)
class EdgeAccess:
    """How the clients of wearers reach their edge. permissions: of all, without keys. keys_folder: of the
    edge, with its list; None: it uses no keys. secret: of `LentKeys`."""

    address: str
    permissions: frozenset[Permission] = frozenset()
    keys_folder: Path | None = None
    edge_key: str = ""
    secret: bytes = field(default=b"", repr=False)

    @cached_property
    def _list(self) -> AllowList | None:
        return None if self.keys_folder is None else allow_list(self.keys_folder)

    def rights_of(self, name: str) -> frozenset[Permission]:
        """Return what a wearer may do, as the list says now. Raises PairingError if it does not have the
        name, ListDamagedError if it cannot be read."""
        if self._list is None:
            return self.permissions
        try:
            rights = self._list.rights()
        except UsageError as error:
            raise ListDamagedError(f"the edge's list of keys cannot be used: {error}"[:300]) from None
        if name not in rights:
            raise PairingError(
                f"the edge's list of keys has no agent '{name}'; on the edge's machine, with the public key "
                f"of the device of '{name}': share keys authorize {name} {name}.public"
            )
        return rights[name]

    def keys_of(self, name: str) -> AgentKeys | None:
        if self.keys_folder is None:
            return None
        return AgentKeys(LentKeys(self.secret).pair(name), self.edge_key, is_lent=True)


class PageSeat:
    """One page that is connected as a wearer. rights: that it was told. wake: set when there is something to
    send."""

    def __init__(self, connection: Any, rights: frozenset[Permission]) -> None:
        self.rights = rights
        self.connection, self.outbox, self.wake = connection, Outbox(), asyncio.Event()
        self.points_limit, self._command_limits = TokenBucket(*_POINTS_LIMIT), TokenBuckets(*_COMMAND_LIMIT)

    def takes(self, command: PageCommand) -> bool:
        """Return whether the page may give a command now: goals never keep it from stopping a robot."""
        now_ns = time.monotonic_ns()
        return self._command_limits.bucket(type(command).__name__, now_ns).take(now_ns)

    def reply(self, message: dict[str, Any]) -> None:
        self.outbox.reply(message)
        self.wake.set()


class Wearer:
    """A wearer that has paired, in the server's loop. open_link: makes its client of the edge."""

    def __init__(self, session: WearerSession, open_link: Callable[[Tell], WearerLink]) -> None:
        self.session = session
        self.seat: PageSeat | None = None
        self.measured: PageMeasured | None = None
        self.left_s = time.monotonic()
        self.has_moved: dict[tuple[str, str], None] = {}  # maps, of which the page was told
        self._edge: dict[str, Any] = {
            "type": "edge",
            "is_connected": False,
            "text": "no answer from the edge yet",
        }
        self._objects: dict[int, dict[str, Any]] = {}
        self._robots: dict[str | None, dict[str, Any]] = {}
        self._commands: dict[int, tuple[PageCommand, dict[str, Any] | None]] = {}
        loop = asyncio.get_running_loop()
        self._link = open_link(lambda message: _call(loop, self._take, message))

    @property
    def name(self) -> str:
        return self.session.name

    @property
    def is_connected_to_edge(self) -> bool:
        return bool(self._edge["is_connected"])

    def sit(self, seat: PageSeat) -> None:
        """Let a page take over; it is told all that there is."""
        self.seat = seat
        self.has_moved.clear()
        seat.reply(self._edge)
        seat.outbox.put_all_objects(list(self._objects.values()))
        for robot in self._robots.values():
            seat.outbox.put_robot(robot)
        for _, state in self._commands.values():
            if state is not None:
                seat.reply(state)

    def leave(self, seat: PageSeat) -> None:
        if self.seat is seat:
            self.seat, self.left_s = None, time.monotonic()

    def stop_robots(self) -> None:
        """Stop the robots that drive by this wearer's goals: nobody is there to stop them."""
        goals = [(goal, state) for goal, state in self._commands.values() if isinstance(goal, PageGoto)]
        open_ones = [goal for goal, state in goals if state is None or not state["is_final"]]
        for robot in dict.fromkeys(goal.robot for goal in open_ones):
            self._link.ask(PageCancel(0, robot))
        for goal in open_ones:
            text = "stopped: its wearer was away"
            about = {"command": goal.command, "robot": goal.robot, "commander": self.name, "text": text}
            state = {"type": "command", **about, "is_final": True, "is_reached": False}
            self._commands[goal.command] = goal, state

    def refuse(self, wish: PageRequest | PageCommand, reason: str) -> None:
        self._reply(refusal_of(wish, reason, self.name))

    def ask(self, wish: PageRequest | PageCommand) -> None:
        """Do what the page wants, or answer why not. A command that it repeats is the same one."""
        if isinstance(wish, PageGoto | PageCancel):
            if self.seat is not None and not self.seat.takes(wish):
                self.refuse(wish, "too many commands at once")
                return
            known, state = self._commands.get(wish.command, (None, None))
            if known == wish:
                if state is not None:
                    self._reply(state)
                return
            self._commands[wish.command] = wish, None
            while len(self._commands) > _MAX_COMMANDS:
                del self._commands[next(iter(self._commands))]
        if not self._link.ask(wish):
            self._take(refusal_of(wish, "the edge does not answer, and too much waits for it", self.name))

    def end(self) -> None:
        """Close its client of the edge, in a moment."""
        self._link.close()

    def join(self, timeout_s: float) -> None:
        self._link.join(timeout_s)

    def _reply(self, message: dict[str, Any]) -> None:
        if self.seat is not None:
            self.seat.reply(message)

    def _take(self, message: dict[str, Any]) -> None:
        """Take what the client of the edge tells."""
        match message["type"]:
            case "objects":
                self._take_objects(message)
            case "robots":
                for robot in message["robots"]:
                    self._robots[robot["robot"]] = robot
                    if self.seat is not None:
                        self.seat.outbox.put_robot(robot)
            case kind:
                if kind == "edge":
                    self._edge = message
                elif kind == "command" and message["command"] in self._commands:
                    wish, state = self._commands[message["command"]]
                    if state is not None and state["is_final"]:
                        return
                    self._commands[message["command"]] = wish, message
                self._reply(message)
        if self.seat is not None:
            self.seat.wake.set()

    def _take_objects(self, message: dict[str, Any]) -> None:
        outbox = None if self.seat is None else self.seat.outbox
        for one in message["objects"]:
            self._objects[one["id"]] = one
            if outbox is not None:
                outbox.put_object(one)
        for gone in message["removed"]:
            self._objects.pop(gone["id"], None)
            if outbox is not None:
                outbox.remove_object(gone["id"], gone["reason"])


def _call(loop: asyncio.AbstractEventLoop, function: Callable[..., None], *arguments: Any) -> None:
    try:
        loop.call_soon_threadsafe(function, *arguments)
    except RuntimeError:  # the server has ended
        return


class WearerRegistry:
    """Lets wearers in. key: that sessions are signed with. ledger: of the newest ones. notify: is called with
    a line for the operator. dismiss: with a wearer and its page, where another session takes its place."""

    def __init__(
        self,
        access: EdgeAccess,
        key: bytes,
        ledger: SessionLedger,
        notify: Callable[[str], None],
        dismiss: Callable[[Wearer, PageSeat, PairingError], None],
    ) -> None:
        self.desk = PairingDesk(secrets.randbelow)
        self._access, self._key = access, key
        self._wearers: dict[str, Wearer] = {}
        self._ledger, self._notify, self._dismiss = ledger, notify, dismiss

    def __iter__(self) -> Any:
        return iter(list(self._wearers.values()))

    def let_in(self, hello: PageHello, address: str) -> tuple[Wearer, str, frozenset[Permission]]:
        """Return the wearer of a hello, its session's secret and its rights. Raises PairingError."""
        if hello.session is not None:
            session = unseal(self._key, hello.session, self._ledger.edge, moment_now())
            if not self._ledger.is_newest(session):
                raise _replaced(session.name)
            rights = self._access.rights_of(session.name)
        else:
            session, rights = self._pair(hello, address)
        wearer = self._wearers.get(session.name)
        if wearer is not None and wearer.session.nonce != session.nonce:
            if (seat := wearer.seat) is not None:  # else its STOP would reach nobody, without a word
                self._dismiss(wearer, seat, _replaced(session.name))
            self.remove(wearer)
            wearer = None
        if wearer is None:
            wearer = self._add(session)
        return wearer, seal(self._key, session), rights

    def _pair(self, hello: PageHello, address: str) -> tuple[WearerSession, frozenset[Permission]]:
        """Return a new session by a code, which is used up; not if the names are refused."""
        self.desk.check(hello.code or "", address, time.monotonic_ns())
        try:
            name = checked_name(hello.name or "")
            agent = checked_name(hello.agent) if hello.agent else None
        except ValueError as error:
            raise PairingError(str(error)) from None
        wearer = self._wearers.get(name)
        if wearer is not None and wearer.seat is not None:
            raise PairingError(f"'{name}' is connected already; use another name, or close that page")
        rights = self._access.rights_of(name)
        if wearer is None and len(self._wearers) >= MAX_WEARERS:
            raise PairingError(f"{MAX_WEARERS} wearers are here already")
        self.desk.renew()
        return self._ledger.new_session(name, agent, moment_now()), rights

    def _add(self, session: WearerSession) -> Wearer:
        if len(self._wearers) >= MAX_WEARERS:
            raise PairingError(f"{MAX_WEARERS} wearers are here already")
        try:
            self._ledger.note(session)
        except ShareError as error:
            self._notify(f"headset page: {error}")
        name, access = session.name, self._access
        wearer = Wearer(session, lambda tell: WearerLink(access.address, name, access.keys_of(name), tell))
        self._wearers[name] = wearer
        return wearer

    def remove(self, wearer: Wearer) -> None:
        if self._wearers.get(wearer.name) is wearer:
            del self._wearers[wearer.name]
        wearer.end()

    def remove_absent(self, now_s: float) -> None:
        """Stop the robots of wearers whose page is away too long, and end their clients; their sessions
        stay."""
        for wearer in self:
            away_s = now_s - wearer.left_s if wearer.seat is None else 0.0
            if away_s > ABSENT_S:
                wearer.stop_robots()
            if away_s > ABSENT_S + _END_S:
                self.remove(wearer)

    def rights_now(self, wearer: Wearer) -> frozenset[Permission]:
        """Return what a wearer may do by now. Raises PairingError if it may be here no more, ListDamagedError
        where that is not known."""
        check_end(wearer.session, moment_now())
        if not self._ledger.is_newest(wearer.session):  # by another edge of this address
            raise _replaced(wearer.name)
        return self._access.rights_of(wearer.name)

    def close(self) -> None:
        """End the clients of all."""
        wearers = list(self)
        for wearer in wearers:
            self.remove(wearer)
        for wearer in wearers:
            wearer.join(0.5)


def _replaced(name: str) -> SessionOverError:
    return SessionOverError(f"another headset has paired as '{name}' since; pair again")
