"""A client of the edge as a state machine: it commands robots, places objects, or drives a robot.

`RoomClient.handle` takes one event and the time and returns effects. Requests are repeated until they are
answered. A goal is repeated until it is final; if the repetition ends before, its robot stops.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

from share.errors import UsageError, printable
from share.protocol import room_events as ev
from share.protocol.common_events import Connected, EdgeMessageReceived, FailRun, SendToEdge, Tick
from share.protocol.edge_connection import EdgeConnection, WelcomeOutcome
from share.protocol.object_replica import ObjectReplica
from share.timing import SECOND_NS, PeriodicTimer, seconds_to_ns
from share.wire import messages as m
from share.wire import room_messages as room
from share.wire.codec import encode
from share.wire.layouts import Bytes

REPEAT_S = 0.5  # of what is not answered, and of goals
MAX_OPEN = 64  # requests about objects that are not answered
_WINDOW = 16  # of them that are sent at a time
_PING_S = 0.5
_NO_WORD_S = 10.0  # a command without any state for so long is given up
_MAX_PINGS = 16


@dataclass
class _OpenRequest:
    message: room.PutObject | room.RemoveObject
    sent_ns: int | None = None
    session: int | None = None  # in which it was sent first
    replaced: tuple[int, ...] = ()  # requests about the same object that it came instead of


@dataclass
class _OpenCommand:
    message: room.Goto | room.Cancel
    heard_ns: int
    sent_ns: int | None = None
    is_repeated: bool = True


class RoomClient:
    """One run of a client. `hello` is repeated until an edge welcomes it. keeps_trying: a refusal does not
    end it."""

    def __init__(self, hello: room.ClientHello, silent_s: float, keeps_trying: bool = False) -> None:
        self._hello, self._keeps_trying = hello, keeps_trying
        self._connection = EdgeConnection(hello, silent_s, "it goes on trying")
        self._replica = ObjectReplica()
        self._ping_timer, self._sequence = PeriodicTimer(_PING_S), 0
        self._pings: deque[m.Ping] = deque(maxlen=_MAX_PINGS)
        self._requests: dict[int, _OpenRequest] = {}
        self._commands: dict[int, _OpenCommand] = {}
        self._ended: deque[int] = deque(maxlen=MAX_OPEN)  # commands
        self._is_over = False
        self._trouble = ""  # of the link
        self._effects: list[ev.ClientEffect] = []
        self._now_ns = 0

    @property
    def is_connected(self) -> bool:
        """Whether an edge has welcomed it and is not silent."""
        return self._connection.is_connected

    @property
    def objects(self) -> dict[int, room.RoomObject]:
        """The objects of the room, by id, as far as they have come."""
        return self._replica.objects

    @property
    def has_all_objects(self) -> bool:
        """Whether a list of all objects has come, and all that it names."""
        return self._replica.is_complete

    @property
    def is_idle(self) -> bool:
        """Whether nothing waits for an answer."""
        return not (self._requests or self._commands)

    def handle(self, event: ev.ClientEvent, now_ns: int) -> list[ev.ClientEffect]:
        """Return the effects of `event` at `now_ns` (host monotonic clock, never falling)."""
        if self._is_over:
            return []
        self._effects, self._now_ns = [], now_ns
        self._connection.begin(now_ns)
        match event:
            case EdgeMessageReceived():
                self._on_received(event.frames)
            case Connected():
                self._connection.mark_reached()
                self._send_hello()
            case ev.MessageWanted():
                self._on_wanted(event.message)
            case ev.LinkTroubled():
                self._trouble = event.text
            case ev.ClientEnded():
                self._send_if_connected(m.Bye())
                self._is_over = True
                return self._effects
            case Tick():
                pass
        if not self._is_over:
            self._send_due()
        return self._effects

    def _on_wanted(self, message: room.ClientUplink) -> None:
        encode(message)  # what cannot be sent fails here, once, and not in each step
        match message:
            case room.PutObject() | room.RemoveObject():
                self._on_request(message)
            case room.Goto() | room.Cancel():
                self._on_command(message)
            case _:
                self._send_if_connected(message)

    # ------------------------------------------------------------ messages from the edge

    def _on_received(self, frames: Sequence[Bytes]) -> None:
        message, lines = self._connection.receive(frames, self._now_ns)
        self._effects += lines
        match message:
            case None:
                pass
            case m.Welcome():
                self._on_welcome(message)
            case m.Refused():
                self._on_refused(message)
            case m.Pong():
                self._on_pong(message)
            case room.Receipt():
                self._on_receipt(message)
            case room.RoomObject() | room.ObjectList():
                self._on_objects(message)
            case room.CommandState():
                self._on_command_state(message)
            case room.RobotPlace():
                self._effects.append(ev.RobotSeen(message))
            case room.Goto() | room.Cancel() if self._hello.drives_robot:
                self._effects.append(ev.RobotCommanded(message))
            case _:
                self._effects += self._connection.report_unexpected(message, "this client", self._now_ns)

    def _on_welcome(self, welcome: m.Welcome) -> None:
        is_restart = self._connection.sessions.session is not None
        match self._connection.welcome(welcome):
            case WelcomeOutcome.NEW_SESSION:
                self._replica.begin_session(welcome.session)
                self._hasten()
                self._print("the edge has restarted" if is_restart else "connected to the edge")
            case WelcomeOutcome.RECONNECTED:
                self._hasten()
                self._print("reconnected to the edge")
            case WelcomeOutcome.UNSOLICITED:
                text = "the edge sent a welcome without a hello; ignored"
                self._effects += self._connection.report_invalid(text, self._now_ns)

    def _hasten(self) -> None:
        """Send everything that is open now."""
        for request in self._requests.values():
            request.sent_ns = None
        for command in self._commands.values():
            command.sent_ns = None

    def _on_refused(self, refused: m.Refused) -> None:
        text = self._connection.refuse(refused, self._now_ns)
        if self._keeps_trying or self._connection.sessions.session is not None:
            self._print(f"{text}; it goes on trying")
            return
        self._is_over = True
        self._effects.append(FailRun(UsageError(text)))

    def _on_pong(self, pong: m.Pong) -> None:
        if (ping := m.Ping(pong.sequence, pong.sent_ns)) not in self._pings:
            return
        self._pings.remove(ping)
        if pong.session != self._connection.sessions.session:
            self._connection.is_connected = False  # the edge has restarted and does not know us: hello

    # ------------------------------------------------------------ objects

    def _on_request(self, message: room.PutObject | room.RemoveObject) -> None:
        replaced: tuple[int, ...] = ()
        for number, one in list(self._requests.items()):
            if one.message.object_id == message.object_id:  # its effect would be overwritten at once
                del self._requests[number]
                replaced = (*one.replaced, number)[-MAX_OPEN:]
        if len(self._requests) >= MAX_OPEN:
            self._effects.append(
                ev.RequestAnswered(message.request, f"{MAX_OPEN} requests wait for an answer already")
            )
            return
        self._requests[message.request] = _OpenRequest(message, replaced=replaced)

    def _on_receipt(self, receipt: room.Receipt) -> None:
        if (one := self._requests.pop(receipt.request, None)) is None:
            return
        reason, is_removal = receipt.reason, isinstance(one.message, room.RemoveObject)
        is_of_dead_edge = is_removal and one.session != self._connection.sessions.session
        if is_of_dead_edge and reason == room.no_object_text(one.message.object_id):
            reason = ""  # the edge that it was sent to first has done it, or it was never there
        numbers = (*one.replaced, receipt.request)
        self._effects += [ev.RequestAnswered(number, reason) for number in numbers]

    def _on_objects(self, message: room.RoomObject | room.ObjectList) -> None:
        if isinstance(message, room.RoomObject):
            changed = self._replica.add(message)
            self._effects += [] if changed is None else [ev.ObjectChanged(changed)]
            return
        self._effects += [ev.ObjectChanged(gone) for gone in self._replica.check(message)]
        if (seen := self._replica.seen()) is not None:
            self._send(seen)

    # ------------------------------------------------------------ commands

    def _on_command(self, message: room.Goto | room.Cancel) -> None:
        if isinstance(message, room.Cancel):  # its own goals are repeated no longer
            goals = [one for one in self._commands.values() if isinstance(one.message, room.Goto)]
            robots = {one.message.robot for one in goals if one.is_repeated}
            if message.robot is None and len(robots) == 1:
                message = replace(message, robot=robots.pop())
            for one in goals:
                if one.message.robot == message.robot or None in (one.message.robot, message.robot):
                    one.is_repeated = False
        self._commands[message.command] = _OpenCommand(message, self._now_ns)

    def _on_command_state(self, state: room.CommandState) -> None:
        is_own = state.commander in ("", self._hello.name)
        one = self._commands.get(state.command) if is_own else None
        if one is not None and not _is_same_robot(one.message.robot, state.robot):
            self._print(f"robot '{state.robot}' answers for '{one.message.robot}'; ignored")
            return
        if state.command in self._ended or (one is None and not self._hello.wants_robots):
            return  # late, or of another client of this name
        self._effects.append(ev.CommandChanged(state))
        if one is None:
            return
        one.heard_ns = self._now_ns
        if state.is_final:
            self._end_command(state.command)
        elif isinstance(one.message, room.Goto) and not one.message.has_begun:
            robot = one.message.robot or state.robot  # that one, where further robots come
            one.message = replace(one.message, has_begun=True, robot=robot)
            one.sent_ns = None  # the robot waits for it

    def _give_up(self, command: int, one: _OpenCommand) -> None:
        """End a command that nobody answers; a robot that has it stops, since it is not repeated."""
        self._end_command(command)
        text = f"no word from the robot for {_NO_WORD_S:g} s"
        if not self.is_connected:
            reason = f": {printable(self._trouble)}" if self._trouble else ""
            text = f"no edge answers{reason}"[: room.MAX_ANSWER_LENGTH]
        state = room.CommandState(command, one.message.robot, self._hello.name, text, is_final=True)
        self._effects.append(ev.CommandChanged(state))

    def _end_command(self, command: int) -> None:
        del self._commands[command]
        self._ended.append(command)

    # ------------------------------------------------------------ messages to the edge

    def _send_due(self) -> None:
        self._effects += self._connection.check_silence(self._now_ns)
        for command, open_command in list(self._commands.items()):
            if self._now_ns - open_command.heard_ns > _NO_WORD_S * SECOND_NS:
                self._give_up(command, open_command)
        if not self.is_connected:
            if self._connection.is_hello_due(self._now_ns):
                self._send_hello()
            return
        if self._ping_timer.fire_if_due(self._now_ns):
            self._sequence += 1
            self._pings.append(m.Ping(self._sequence, self._now_ns))
            self._send(self._pings[-1])
        for request in list(self._requests.values())[:_WINDOW]:
            if self._is_due(request.sent_ns):
                request.sent_ns = self._now_ns
                request.session = request.session or self._connection.sessions.session
                self._send(request.message)
        for open_command in self._commands.values():
            if open_command.is_repeated and self._is_due(open_command.sent_ns):
                open_command.sent_ns = self._now_ns
                self._send(open_command.message)

    def _is_due(self, sent_ns: int | None) -> bool:
        return sent_ns is None or self._now_ns - sent_ns >= seconds_to_ns(REPEAT_S)

    def _send_hello(self) -> None:
        self._effects += [SendToEdge(frames) for frames in self._connection.hello(self._now_ns)]

    def _send(self, message: m.UplinkMessage | room.ClientUplink) -> None:
        self._effects.append(SendToEdge(encode(message)))

    def _send_if_connected(self, message: m.UplinkMessage | room.ClientUplink) -> None:
        if self.is_connected:
            self._send(message)

    def _print(self, text: str) -> None:
        self._effects += self._connection.print(text, self._now_ns)


def _is_same_robot(commanded: str | None, answering: str | None) -> bool:
    """Whether a state may be about a command. None: the only robot, before the first state; no robot."""
    return commanded is None or answering is None or commanded == answering
