"""The edge's guard: no connection makes libzmq gather more than an honest agent could have waiting.

It learns of connections from the socket's monitor, of what libzmq has read of each from the kernel, and of
what was handed over from whoever receives (`took`, `empty`). It cuts off who has more waiting than may be,
whose message has too many parts, who is no agent, and who says nothing.

It looks in a thread of its own, and in that of whoever receives, which on a busy machine has its turn sooner.
Newcomers wait at its gate after somebody was cut off, so that an attack that is repeated brings nothing, and
honest ones are not turned away.

No whole message of a connection waits when `receive` has found nothing at all, and neither when as many
messages of others were handed over as there can be connections: libzmq takes one of each in turn. What still
waits then of what had been read before is one message; if it is larger than any may be, it does not end.
"""

from __future__ import annotations

import math
import random
import select
import struct
import time
from collections import Counter, deque
from collections.abc import Callable
from threading import Lock, Thread

import zmq

from share.net import tcp
from share.net.account import Account, Bounds
from share.net.connection import Connection
from share.net.gate import Gate, KeepOut

CONNECTIONS = 128  # at a time
STRANGERS = 32  # of these, that have not said anything yet
MUTE_S = 60.0  # without a message; agents ping every half second
_STRANGE_S = 10.0  # to the first message
_TICK_MS, _ALERT_MS = 20, 5
_MANY = 64  # messages in less than _TICK_MS
_ROUND = 2 * CONNECTIONS  # messages; those of connections that are closed by now wait beside the others
GROWTH_BYTES = 12_000_000  # of memory, beyond the bytes that wait: small parts take much more than they have
_HOMES = 4096
_EVENTS = (
    zmq.EVENT_LISTENING
    | zmq.EVENT_ACCEPTED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_MONITOR_STOPPED
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)


class Guard:
    """Of `socket`, before it is bound. A thread of its own, which ends when `close` is called.

    poke: makes whoever receives look for a message, from any thread.
    """

    def __init__(
        self, socket: zmq.Socket[bytes], bounds: Bounds, kept_out: KeepOut, poke: Callable[[], None]
    ) -> None:
        self._monitored, self._bounds, self._kept_out, self._poke = socket, bounds, kept_out, poke
        self._events: zmq.Socket[bytes] = socket.get_monitor_socket(_EVENTS)
        self._events_ready = select.poll()  # which, unlike libzmq's, several threads may use
        self._events_ready.register(int(self._events.getsockopt(zmq.FD)), select.POLLIN)
        self._lock = Lock()  # of what several threads use, the next two
        self._taken: dict[int, tuple[int, int, int, str]] = {}  # bytes, parts, messages, key by descriptor
        self._failed = 0
        self._charges: deque[tuple[Connection | int, str]] = deque(maxlen=CONNECTIONS)
        self._admitted: deque[tuple[str, str]] = deque(maxlen=CONNECTIONS)  # key and address
        self._lines: deque[str] = deque(maxlen=128)
        self._empty_s = 0.0
        self._gate = Gate()
        self._unlooked = 0  # messages since somebody looked
        self._turn = Lock()  # of who looks, and of what follows
        self._due_s, self._looked_s = 0.0, 0.0  # when to look again, and when last
        self._is_over = False
        self._open: dict[int, Connection] = {}  # by descriptor
        self._ended: dict[int, float] = {}  # when a descriptor was last given back
        self._to_fail = 0  # handshakes that were cut off
        self._orphaned = 0.0  # bytes of memory of connections that ended, since nothing waited
        self._homes: set[str] = set()  # addresses from which a key has sent a message
        self._resident = tcp.resident_bytes()  # memory of this process when last little waited
        self._handed = 0  # bytes handed over since then: whoever took them may have kept them
        self._marked_s = 0.0
        self._since_mark = 0  # messages handed over
        self._thread = Thread(target=self._watch, name="guard", daemon=True)
        self._thread.start()

    # ------------------------------------------------------------------ for other threads

    def took(self, descriptor: int, size: int, parts: int, key: str) -> None:
        """A message of so many bytes on the wire, in so many parts, was received from that connection."""
        with self._lock:
            all_bytes, all_parts, messages, _ = self._taken.get(descriptor, (0, 0, 0, ""))
            self._taken[descriptor] = all_bytes + size, all_parts + parts, messages + 1, key

    def look(self) -> None:
        """Between two messages."""
        self._unlooked += 1
        due_s = self._looked_s + _ALERT_MS * 1e-3 if self._unlooked >= _MANY else self._due_s
        if time.monotonic() >= due_s and self._turn.acquire(blocking=False):
            try:
                self._due_s = min(self._due_s, time.monotonic())
                self._try_to_look()
            finally:
                self._turn.release()

    def discards(self, descriptor: int) -> bool:
        """Whether what comes from that connection is to be thrown away."""
        return self._gate.discards(descriptor)

    def empty(self, asked_s: float) -> None:
        """There was no message when asked at `asked_s` (time.monotonic)."""
        self._empty_s = asked_s

    def charge(self, descriptor: int, reason: str) -> None:
        """What that connection sent no agent sends."""
        connection = self._open.get(descriptor)
        if connection is not None and connection.sure:  # at once; who it is will be looked at later
            connection.cut()
            self._charges.append((connection, reason))
        else:
            self._charges.append((descriptor, reason))

    def admits(self, key: str, address: str) -> bool:
        """Whether that key, which is authorized, may come in now."""
        if self._kept_out.holds(key, time.monotonic()):
            return False
        self._admitted.append((key, address))
        return True

    def lines(self) -> list[str]:
        """Who was cut off since the last call."""
        return [self._lines.popleft() for _ in range(len(self._lines))]

    def failed(self) -> int:
        """Handshakes that were broken off or made no sense, since the last call."""
        with self._lock:
            failed, self._failed = self._failed, 0
        return failed

    def close(self) -> None:
        """Before the socket itself is closed. May be repeated."""
        if not self._monitored.closed:
            self._monitored.disable_monitor()
        self._thread.join()

    # ------------------------------------------------------------------ whose turn it is

    def _watch(self) -> None:
        wait_ms: float | None = None
        while not self._is_over:
            self._events_ready.poll(wait_ms)
            with self._turn:
                self._try_to_look()
                left_s = max(0.0, self._due_s - time.monotonic())
                wait_ms = math.ceil(1e3 * left_s) if self._open else None
        self._events.close(linger=0)

    def _try_to_look(self) -> None:
        """A fault of our own costs this look, and neither the guard nor who receives."""
        try:
            self._look()
        except Exception as error:
            self._due_s = time.monotonic() + _TICK_MS * 1e-3
            self._lines.append(f"the guard of connections failed and goes on: {error!r}")

    def _look(self) -> None:
        self._is_over = self._is_over or not self._hear()
        if not self._is_over and time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + _TICK_MS * 1e-3
            wait_ms = self._check(time.monotonic())
            self._unlooked, self._looked_s = 0, time.monotonic()
            self._due_s = self._looked_s + wait_ms * 1e-3

    def _hear(self) -> bool:
        """Events that have come. False once there will be no more."""
        while True:
            try:
                what, _ = self._events.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return True
            event, value = struct.unpack("=Hi", what)
            if event == zmq.EVENT_MONITOR_STOPPED:
                return False
            if event == zmq.EVENT_LISTENING:
                self._gate.listen(value)
            elif event == zmq.EVENT_ACCEPTED:
                self._accept(value)
            elif event == zmq.EVENT_DISCONNECTED:
                self._forget(value)
            elif self._to_fail:
                self._to_fail -= 1
            elif not any(connection.is_held for connection in self._open.values()):
                with self._lock:  # who is held may fail for that
                    self._failed += 1

    def _accept(self, descriptor: int) -> None:
        self._forget(descriptor)  # libzmq does not tell of connections that another took over
        number, ends = tcp.cookie(descriptor), tcp.addresses(descriptor)
        if number is None or ends is None:
            return
        now_s = time.monotonic()
        connection = Connection(descriptor, number, ends[0], Account(now_s), self._is_sure(descriptor))
        self._open[descriptor] = connection
        if self._kept_out.holds(connection.address, now_s):
            self._cut(connection)
            self._gate.discard(descriptor)
        else:
            self._gate.admit(connection, self._is_full, now_s)
        self._make_room()

    def _is_sure(self, descriptor: int) -> bool:
        return self._ended.get(descriptor, -1.0) < self._empty_s

    @property
    def _is_full(self) -> bool:
        """Whether more waits to be thrown away than may wait at all."""
        return self._orphaned > self._bounds.total

    def _let_in(self, now_s: float) -> None:
        for connection in self._gate.let_in(self._open.values(), self._is_full, now_s):
            connection.sure = self._is_sure(connection.descriptor)
            connection.account.since_s = now_s

    def _make_room(self) -> None:
        """Where there are too many, one that has said nothing goes, by chance among those of the address that
        has the most: the first or the last could be foreseen. Where all have spoken, that is the newest."""
        present = self._present()
        strange = [connection for connection in present if connection.strange]
        if strange and (len(strange) > STRANGERS or len(present) > CONNECTIONS):
            most = Counter(connection.address for connection in strange).most_common(1)[0][0]
            self._cut(random.choice([connection for connection in strange if connection.address == most]))
            self._lines.append(f"{most}: more connections than may be open at a time")

    def _present(self) -> list[Connection]:
        return [connection for connection in self._open.values() if not connection.is_cut]

    def _forget(self, descriptor: int) -> None:
        connection = self._open.pop(descriptor, None)
        if connection is not None:
            self._ended[descriptor] = time.monotonic()
            self._orphaned += connection.account.memory

    def _check(self, now_s: float) -> int:
        """Milliseconds until the next one is due."""
        empty_s = self._empty_s  # first: what was received before is then among what was taken
        while self._admitted:
            self._recognise(*self._admitted.popleft())
        self._enter(now_s)
        self._sample()
        while self._charges:
            self._convict(*self._charges.popleft())
        if empty_s > self._marked_s or self._since_mark >= _ROUND:
            self._judge(empty_s, now_s)
        self._bound(now_s)
        self._gate.empty(empty_s)
        much = sum(max(0, connection.account.waiting) for connection in self._present())
        if much > self._bounds.message:
            self._weigh(much, now_s)
        self._let_in(now_s)
        if much <= self._bounds.message and not self._gate.discards_any:
            self._resident, self._handed = tcp.resident_bytes(), 0
            return _TICK_MS
        self._poke()
        return _ALERT_MS

    def _weigh(self, much: int, now_s: float) -> None:
        """Whoever hides small parts behind large ones is known by how this process grows."""
        explained = self._resident + self._handed + self._unclaimed() + much
        if (grown := tcp.resident_bytes() - explained) > GROWTH_BYTES:
            self._offend(self._worst(now_s), "many small parts", now_s)
            self._orphaned += grown  # that is its own: nobody else is to be taken for it

    def _unclaimed(self) -> float:
        """Bytes of memory of what waits to be thrown away, were none thrown away yet."""
        return self._orphaned + sum(c.account.memory for c in self._open.values() if c.is_cut)

    def _enter(self, now_s: float) -> None:
        """What was handed over since the last time."""
        with self._lock:
            taken, self._taken = self._taken, {}
        for descriptor, (size, parts, messages, key) in taken.items():
            self._since_mark += messages
            self._handed += size
            connection = self._open.get(descriptor)
            if connection is not None:
                if connection.strange:
                    self._introduce(connection, key)
                connection.account.took(size, parts, messages, now_s)

    def _introduce(self, connection: Connection, key: str) -> None:
        """Its first message: now it is known whose it is."""
        connection.key = key
        if key and len(self._homes) < _HOMES:
            self._homes.add(connection.address)
        if key and sum(other.key == key for other in self._present()) > CONNECTIONS // 2:
            self._cut(connection)
            self._lines.append(f"the key '{key}': more connections than may be open at a time")

    def _recognise(self, key: str, address: str) -> None:
        """A key was let in: at which connection is known if only one is waiting there."""
        strange = [c for c in self._present() if c.address == address and c.strange]
        if len(strange) == 1:
            strange[0].key = key

    def _sample(self) -> None:
        for connection in list(self._open.values()):
            if not connection.sample():
                self._forget(connection.descriptor)

    def _judge(self, empty_s: float, now_s: float) -> None:
        """No whole message waits of who was quiet since the mark; of nobody if it was empty since."""
        empty = empty_s > self._marked_s
        for connection in self._open.values():
            account = connection.account
            if empty:
                connection.sure |= self._ended.get(connection.descriptor, -1.0) < empty_s
            if empty or account.quiet():
                if account.marked > self._bounds.message:
                    self._offend(connection, "a message that does not end", now_s)
                elif not connection.is_held and now_s - account.since_s > (
                    _STRANGE_S if connection.strange else MUTE_S
                ):
                    self._cut(connection)
                account.settle()
            account.mark()
        self._orphaned = 0.0 if empty else self._orphaned
        self._marked_s, self._since_mark = time.monotonic(), 0

    def _bound(self, now_s: float) -> None:
        """Whatever it is that waits: who has too much of it goes, then who has the most for the longest."""
        for connection in self._present():
            if connection.account.exceeds(self._bounds):
                self._unload(connection, "more than may wait", now_s)
        unclaimed, share = self._unclaimed(), self._bounds.peer / 8  # which an agent may have in any case
        while present := self._present():
            all_of_them = sum(connection.account.memory for connection in present)
            worst = self._worst(now_s)
            if all_of_them + (unclaimed if worst.account.memory > share else 0.0) <= self._bounds.total:
                break
            self._unload(worst, "more than may wait of all together", now_s)

    def _unload(self, connection: Connection, reason: str, now_s: float) -> None:
        if connection.account.is_tiny:
            self._offend(connection, "many small parts", now_s)
        else:
            self._shed(connection, reason)

    def _worst(self, now_s: float) -> Connection:
        """Who has the most waiting, for the longest."""
        return max(self._present(), key=lambda c: c.account.memory * (now_s - c.account.since_s + 0.1))

    def _convict(self, whom: Connection | int, reason: str) -> None:
        connection = self._open.get(whom) if isinstance(whom, int) else whom
        if connection is not None and connection.sure:
            self._offend(connection, reason, time.monotonic())

    def _shed(self, connection: Connection, reason: str) -> None:
        """Too much waits. An honest agent comes to that where the edge is very busy: it may come back."""
        self._end(connection)
        self._lines.append(f"{connection.key or connection.address}: {reason}; cut off")

    def _end(self, connection: Connection) -> None:
        self._cut(connection)
        self._gate.cut_off(connection.descriptor, time.monotonic())

    def _offend(self, connection: Connection, reason: str, now_s: float) -> None:
        """It sends what no agent does: it is kept out."""
        if connection.is_cut:
            return
        self._end(connection)
        who = connection.culprit(self._homes)
        self._lines.append(f"{connection.name}: {reason}; cut off{' and kept out' if who else ''}")
        if who is not None:
            self._kept_out.offend(who, now_s)
        else:
            self._gate.pause(connection.address, now_s)

    def _cut(self, connection: Connection) -> None:
        connection.is_cut = True
        there = connection.cut()
        if there and connection.strange and self._to_fail < CONNECTIONS:
            self._to_fail += 1
