"""The edge's guard: no connection makes libzmq gather more than an honest agent could have waiting.

It learns of connections from the socket's monitor, of what libzmq has read of each from the kernel, and of
what was handed over from whoever receives (`deliver`, `empty`). It cuts off who has more waiting than may be,
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
from share.net.backlog import Backlog, BacklogLimits
from share.net.connection import Connection
from share.net.connection_gate import Blocklist, ConnectionGate

MAX_CONNECTIONS = 128  # at a time
MAX_UNIDENTIFIED = 32  # of these, that have not said anything yet
SILENCE_TIMEOUT_S = 60.0  # without a message; agents ping every half second
_IDENTIFY_TIMEOUT_S = 10.0  # to the first message
_CHECK_MS, _ALERT_CHECK_MS = 20, 5
_BURST_MESSAGES = 64  # messages in less than _TICK_MS
_ROUND_MESSAGES = (
    2 * MAX_CONNECTIONS
)  # messages; those of connections that are closed by now wait beside the others
MAX_GROWTH_BYTES = (
    12_000_000  # of memory, beyond the bytes that wait: small parts take much more than they have
)
_MAX_AGENT_ADDRESSES = 4096
_EVENTS = (
    zmq.EVENT_LISTENING
    | zmq.EVENT_ACCEPTED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_MONITOR_STOPPED
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)


class ConnectionGuard:
    """Of `socket`, before it is bound. A thread of its own, which ends when `close` is called.

    poke: makes whoever receives look for a message, from any thread.
    """

    def __init__(
        self,
        socket: zmq.Socket[bytes],
        limits: BacklogLimits,
        blocklist: Blocklist,
        wake_receiver: Callable[[], None],
    ) -> None:
        self._socket, self._limits, self._blocklist, self._wake_receiver = (
            socket,
            limits,
            blocklist,
            wake_receiver,
        )
        self._event_socket: zmq.Socket[bytes] = socket.get_monitor_socket(_EVENTS)
        self._event_poller = select.poll()  # which, unlike libzmq's, several threads may use
        self._event_poller.register(int(self._event_socket.getsockopt(zmq.FD)), select.POLLIN)
        self._lock = Lock()  # of what several threads use, the next two
        self._delivered: dict[
            int, tuple[int, int, int, str]
        ] = {}  # bytes, parts, messages, key by descriptor
        self._failed_handshakes = 0
        self._offences: deque[tuple[Connection | int, str]] = deque(maxlen=MAX_CONNECTIONS)
        self._admissions: deque[tuple[str, str]] = deque(maxlen=MAX_CONNECTIONS)  # key and address
        self._reports: deque[str] = deque(maxlen=128)
        self._last_empty_s = 0.0
        self._gate = ConnectionGate()
        self._unchecked_messages = 0  # messages since somebody looked
        self._check_lock = Lock()  # of who looks, and of what follows
        self._next_check_s, self._last_check_s = 0.0, 0.0  # when to look again, and when last
        self._is_stopped = False
        self._connections: dict[int, Connection] = {}  # by descriptor
        self._closed_s: dict[int, float] = {}  # when a descriptor was last given back
        self._expected_failures = 0  # handshakes that were cut off
        self._orphaned_bytes = 0.0  # bytes of memory of connections that ended, since nothing waited
        self._agent_addresses: set[str] = set()  # addresses from which a key has sent a message
        self._resident_bytes = tcp.resident_bytes()  # memory of this process when last little waited
        self._delivered_bytes = 0  # bytes handed over since then: whoever took them may have kept them
        self._marked_s = 0.0
        self._messages_since_mark = 0  # messages handed over
        self._thread = Thread(target=self._run, name="guard", daemon=True)
        self._thread.start()

    # ------------------------------------------------------------------ for other threads

    def deliver(self, descriptor: int, size: int, parts: int, key: str) -> None:
        """A message of so many bytes on the wire, in so many parts, was received from that connection."""
        with self._lock:
            all_bytes, all_parts, messages, _ = self._delivered.get(descriptor, (0, 0, 0, ""))
            self._delivered[descriptor] = all_bytes + size, all_parts + parts, messages + 1, key

    def check(self) -> None:
        """Between two messages."""
        self._unchecked_messages += 1
        due_s = (
            self._last_check_s + _ALERT_CHECK_MS * 1e-3
            if self._unchecked_messages >= _BURST_MESSAGES
            else self._next_check_s
        )
        if time.monotonic() >= due_s and self._check_lock.acquire(blocking=False):
            try:
                self._next_check_s = min(self._next_check_s, time.monotonic())
                self._try_to_check()
            finally:
                self._check_lock.release()

    def is_discarding(self, descriptor: int) -> bool:
        """Whether what comes from that connection is to be thrown away."""
        return self._gate.is_discarding(descriptor)

    def record_empty(self, asked_s: float) -> None:
        """There was no message when asked at `asked_s` (time.monotonic)."""
        self._last_empty_s = asked_s

    def report_offence(self, descriptor: int, reason: str) -> None:
        """What that connection sent no agent sends."""
        connection = self._connections.get(descriptor)
        if connection is not None and connection.is_unambiguous:  # at once; who it is will be looked at later
            connection.abort()
            self._offences.append((connection, reason))
        else:
            self._offences.append((descriptor, reason))

    def admit(self, key: str, address: str) -> bool:
        """Whether that key, which is authorized, may come in now."""
        if self._blocklist.is_blocked(key, time.monotonic()):
            return False
        self._admissions.append((key, address))
        return True

    def take_reports(self) -> list[str]:
        """Who was cut off since the last call."""
        return [self._reports.popleft() for _ in range(len(self._reports))]

    def take_failed_handshakes(self) -> int:
        """Handshakes that were broken off or made no sense, since the last call."""
        with self._lock:
            failed, self._failed_handshakes = self._failed_handshakes, 0
        return failed

    def close(self) -> None:
        """Before the socket itself is closed. May be repeated."""
        if not self._socket.closed:
            self._socket.disable_monitor()
        self._thread.join()

    # ------------------------------------------------------------------ whose turn it is

    def _run(self) -> None:
        wait_ms: float | None = None
        while not self._is_stopped:
            self._event_poller.poll(wait_ms)
            with self._check_lock:
                self._try_to_check()
                left_s = max(0.0, self._next_check_s - time.monotonic())
                wait_ms = math.ceil(1e3 * left_s) if self._connections else None
        self._event_socket.close(linger=0)

    def _try_to_check(self) -> None:
        """A fault of our own costs this look, and neither the guard nor who receives."""
        try:
            self._check_if_due()
        except Exception as error:
            self._next_check_s = time.monotonic() + _CHECK_MS * 1e-3
            self._reports.append(f"the guard of connections failed and goes on: {error!r}")

    def _check_if_due(self) -> None:
        self._is_stopped = self._is_stopped or not self._handle_events()
        if not self._is_stopped and time.monotonic() >= self._next_check_s:
            self._next_check_s = time.monotonic() + _CHECK_MS * 1e-3
            wait_ms = self._check(time.monotonic())
            self._unchecked_messages, self._last_check_s = 0, time.monotonic()
            self._next_check_s = self._last_check_s + wait_ms * 1e-3

    def _handle_events(self) -> bool:
        """Events that have come. False once there will be no more."""
        while True:
            try:
                message, _ = self._event_socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return True
            event, value = struct.unpack("=Hi", message)
            if event == zmq.EVENT_MONITOR_STOPPED:
                return False
            if event == zmq.EVENT_LISTENING:
                self._gate.set_listener(value)
            elif event == zmq.EVENT_ACCEPTED:
                self._accept(value)
            elif event == zmq.EVENT_DISCONNECTED:
                self._remove(value)
            elif self._expected_failures:
                self._expected_failures -= 1
            elif not any(connection.is_held for connection in self._connections.values()):
                with self._lock:  # who is held may fail for that
                    self._failed_handshakes += 1

    def _accept(self, descriptor: int) -> None:
        self._remove(descriptor)  # libzmq does not tell of connections that another took over
        number, ends = tcp.socket_cookie(descriptor), tcp.addresses(descriptor)
        if number is None or ends is None:
            return
        now_s = time.monotonic()
        connection = Connection(descriptor, number, ends[0], Backlog(now_s), self._is_unambiguous(descriptor))
        self._connections[descriptor] = connection
        if self._blocklist.is_blocked(connection.address, now_s):
            self._abort(connection)
            self._gate.discard(descriptor)
        else:
            self._gate.admit(connection, self._is_full, now_s)
        self._enforce_connection_limit()

    def _is_unambiguous(self, descriptor: int) -> bool:
        return self._closed_s.get(descriptor, -1.0) < self._last_empty_s

    @property
    def _is_full(self) -> bool:
        """Whether more waits to be thrown away than may wait at all."""
        return self._orphaned_bytes > self._limits.total_bytes

    def _release_waiting(self, now_s: float) -> None:
        for connection in self._gate.release_waiting(self._connections.values(), self._is_full, now_s):
            connection.is_unambiguous = self._is_unambiguous(connection.descriptor)
            connection.backlog.last_message_s = now_s

    def _enforce_connection_limit(self) -> None:
        """Where there are too many, one that has said nothing goes, by chance among those of the address that
        has the most: the first or the last could be foreseen. Where all have spoken, that is the newest."""
        live = self._live_connections()
        unidentified = [connection for connection in live if connection.is_unidentified]
        if unidentified and (len(unidentified) > MAX_UNIDENTIFIED or len(live) > MAX_CONNECTIONS):
            address = Counter(connection.address for connection in unidentified).most_common(1)[0][0]
            self._abort(
                random.choice([connection for connection in unidentified if connection.address == address])
            )
            self._reports.append(f"{address}: more connections than may be open at a time")

    def _live_connections(self) -> list[Connection]:
        return [connection for connection in self._connections.values() if not connection.is_aborted]

    def _remove(self, descriptor: int) -> None:
        connection = self._connections.pop(descriptor, None)
        if connection is not None:
            self._closed_s[descriptor] = time.monotonic()
            self._orphaned_bytes += connection.backlog.memory_bytes

    def _check(self, now_s: float) -> int:
        """Milliseconds until the next one is due."""
        empty_s = self._last_empty_s  # first: what was received before is then among what was taken
        while self._admissions:
            self._assign_key(*self._admissions.popleft())
        self._record_deliveries(now_s)
        self._update_backlogs()
        while self._offences:
            self._apply_offence(*self._offences.popleft())
        if empty_s > self._marked_s or self._messages_since_mark >= _ROUND_MESSAGES:
            self._check_quiet_connections(empty_s, now_s)
        self._enforce_limits(now_s)
        self._gate.record_empty(empty_s)
        waiting_bytes = sum(
            max(0, connection.backlog.waiting_bytes) for connection in self._live_connections()
        )
        if waiting_bytes > self._limits.message_bytes:
            self._check_memory_growth(waiting_bytes, now_s)
        self._release_waiting(now_s)
        if waiting_bytes <= self._limits.message_bytes and not self._gate.is_discarding_any:
            self._resident_bytes, self._delivered_bytes = tcp.resident_bytes(), 0
            return _CHECK_MS
        self._wake_receiver()
        return _ALERT_CHECK_MS

    def _check_memory_growth(self, waiting_bytes: int, now_s: float) -> None:
        """Whoever hides small parts behind large ones is known by how this process grows."""
        explained = (
            self._resident_bytes + self._delivered_bytes + self._discarded_memory_bytes() + waiting_bytes
        )
        if (grown := tcp.resident_bytes() - explained) > MAX_GROWTH_BYTES:
            self._disconnect_and_block(self._heaviest(now_s), "many small parts", now_s)
            self._orphaned_bytes += grown  # that is its own: nobody else is to be taken for it

    def _discarded_memory_bytes(self) -> float:
        """Bytes of memory of what waits to be thrown away, were none thrown away yet."""
        return self._orphaned_bytes + sum(
            c.backlog.memory_bytes for c in self._connections.values() if c.is_aborted
        )

    def _record_deliveries(self, now_s: float) -> None:
        """What was handed over since the last time."""
        with self._lock:
            delivered, self._delivered = self._delivered, {}
        for descriptor, (size, parts, messages, key) in delivered.items():
            self._messages_since_mark += messages
            self._delivered_bytes += size
            connection = self._connections.get(descriptor)
            if connection is not None:
                if connection.is_unidentified:
                    self._identify(connection, key)
                connection.backlog.deliver(size, parts, messages, now_s)

    def _identify(self, connection: Connection, key: str) -> None:
        """Its first message: now it is known whose it is."""
        connection.key = key
        if key and len(self._agent_addresses) < _MAX_AGENT_ADDRESSES:
            self._agent_addresses.add(connection.address)
        if key and sum(other.key == key for other in self._live_connections()) > MAX_CONNECTIONS // 2:
            self._abort(connection)
            self._reports.append(f"the key '{key}': more connections than may be open at a time")

    def _assign_key(self, key: str, address: str) -> None:
        """A key was let in: at which connection is known if only one is waiting there."""
        unidentified = [c for c in self._live_connections() if c.address == address and c.is_unidentified]
        if len(unidentified) == 1:
            unidentified[0].key = key

    def _update_backlogs(self) -> None:
        for connection in list(self._connections.values()):
            if not connection.update_backlog():
                self._remove(connection.descriptor)

    def _check_quiet_connections(self, empty_s: float, now_s: float) -> None:
        """No whole message waits of who was quiet since the mark; of nobody if it was empty since."""
        is_empty = empty_s > self._marked_s
        for connection in self._connections.values():
            backlog = connection.backlog
            if is_empty:
                connection.is_unambiguous |= self._closed_s.get(connection.descriptor, -1.0) < empty_s
            if is_empty or backlog.is_quiet():
                if backlog.marked_bytes > self._limits.message_bytes:
                    self._disconnect_and_block(connection, "a message that does not end", now_s)
                elif not connection.is_held and now_s - backlog.last_message_s > (
                    _IDENTIFY_TIMEOUT_S if connection.is_unidentified else SILENCE_TIMEOUT_S
                ):
                    self._abort(connection)
                backlog.classify_commands()
            backlog.mark()
        self._orphaned_bytes = 0.0 if is_empty else self._orphaned_bytes
        self._marked_s, self._messages_since_mark = time.monotonic(), 0

    def _enforce_limits(self, now_s: float) -> None:
        """Whatever it is that waits: who has too much of it goes, then who has the most for the longest."""
        for connection in self._live_connections():
            if connection.backlog.exceeds(self._limits):
                self._disconnect_overloaded(connection, "more than may wait", now_s)
        discarded, share = (
            self._discarded_memory_bytes(),
            self._limits.peer_bytes / 8,
        )  # which an agent may have in any case
        while live := self._live_connections():
            live_bytes = sum(connection.backlog.memory_bytes for connection in live)
            worst = self._heaviest(now_s)
            if (
                live_bytes + (discarded if worst.backlog.memory_bytes > share else 0.0)
                <= self._limits.total_bytes
            ):
                break
            self._disconnect_overloaded(worst, "more than may wait of all together", now_s)

    def _disconnect_overloaded(self, connection: Connection, reason: str, now_s: float) -> None:
        if connection.backlog.has_small_parts:
            self._disconnect_and_block(connection, "many small parts", now_s)
        else:
            self._disconnect(connection, reason)

    def _heaviest(self, now_s: float) -> Connection:
        """Who has the most waiting, for the longest."""
        return max(
            self._live_connections(),
            key=lambda c: c.backlog.memory_bytes * (now_s - c.backlog.last_message_s + 0.1),
        )

    def _apply_offence(self, offender: Connection | int, reason: str) -> None:
        connection = self._connections.get(offender) if isinstance(offender, int) else offender
        if connection is not None and connection.is_unambiguous:
            self._disconnect_and_block(connection, reason, time.monotonic())

    def _disconnect(self, connection: Connection, reason: str) -> None:
        """Too much waits. An honest agent comes to that where the edge is very busy: it may come back."""
        self._abort_and_discard(connection)
        self._reports.append(f"{connection.key or connection.address}: {reason}; cut off")

    def _abort_and_discard(self, connection: Connection) -> None:
        self._abort(connection)
        self._gate.record_abort(connection.descriptor, time.monotonic())

    def _disconnect_and_block(self, connection: Connection, reason: str, now_s: float) -> None:
        """It sends what no agent does: it is kept out."""
        if connection.is_aborted:
            return
        self._abort_and_discard(connection)
        target = connection.block_target(self._agent_addresses)
        self._reports.append(f"{connection.name}: {reason}; cut off{' and kept out' if target else ''}")
        if target is not None:
            self._blocklist.block(target, now_s)
        else:
            self._gate.pause_address(connection.address, now_s)

    def _abort(self, connection: Connection) -> None:
        connection.is_aborted = True
        was_open = connection.abort()
        if was_open and connection.is_unidentified and self._expected_failures < MAX_CONNECTIONS:
            self._expected_failures += 1
