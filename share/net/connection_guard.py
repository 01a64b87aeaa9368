"""The edge's guard: no connection can make libzmq hold more data than an honest agent could have waiting.

It learns of connections from the socket's monitor, of the bytes that libzmq has read of each from the kernel,
and of delivered messages from the receiver (`deliver`, `record_empty`). It disconnects peers that have too
much waiting, send too many parts, are no agents, or are silent.

It checks in a thread and also in the receiver's thread, which on a busy machine runs sooner. After a
disconnection new connections are held at its gate, so that a repeated attack gains nothing and honest agents
are not refused.

No complete message of a connection waits once `receive` has found nothing at all, or once as many messages of
other connections were delivered as there can be connections: libzmq serves them in turn. What then still
waits of the data read before is one message; if it is larger than the limit, it is endless.
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
from share.net.connection_gate import Blocklist, Connection, ConnectionGate

MAX_CONNECTIONS = 128  # at a time
MAX_UNIDENTIFIED = 32  # of these, without a first message
SILENCE_TIMEOUT_S = 60.0  # without a message; agents ping every half second
_IDENTIFY_TIMEOUT_S = 10.0  # until the first message
_CHECK_MS = 20  # between checks
_ALERT_CHECK_MS = 5  # between checks while much waits
_BURST_MESSAGES = 64  # since the last check; more cause an early one
_ROUND_MESSAGES = 2 * MAX_CONNECTIONS  # after which each connection was served, closed ones included
MAX_GROWTH_BYTES = 12_000_000  # of process memory beyond the waiting bytes: small parts take much more
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
    """Guards `socket`, from before it is bound until `close`. Runs a thread.

    wake_receiver: makes the receiver look for a message; called from any thread.
    """

    def __init__(
        self,
        socket: zmq.Socket[bytes],
        limits: BacklogLimits,
        blocklist: Blocklist,
        wake_receiver: Callable[[], None],
    ) -> None:
        self._socket, self._limits = socket, limits
        self._blocklist, self._wake_receiver = blocklist, wake_receiver
        self._event_socket: zmq.Socket[bytes] = socket.get_monitor_socket(_EVENTS)
        self._event_poller = select.poll()  # unlike libzmq's, several threads may use it
        self._event_poller.register(int(self._event_socket.getsockopt(zmq.FD)), select.POLLIN)
        self._lock = Lock()  # guards the next two
        # By descriptor: bytes, parts, messages, key.
        self._delivered: dict[int, tuple[int, int, int, str]] = {}
        self._failed_handshakes = 0
        self._offences: deque[tuple[Connection | int, str]] = deque(maxlen=MAX_CONNECTIONS)
        self._admissions: deque[tuple[str, str]] = deque(maxlen=MAX_CONNECTIONS)  # key and address
        self._reports: deque[str] = deque(maxlen=128)
        self._last_empty_s = 0.0
        self._gate = ConnectionGate()
        self._unchecked_messages = 0  # since the last check
        self._check_lock = Lock()  # held by the thread that checks; guards all that follows
        self._next_check_s, self._last_check_s = 0.0, 0.0
        self._is_stopped = False
        self._connections: dict[int, Connection] = {}  # by descriptor
        self._closed_s: dict[int, float] = {}  # by descriptor, when it was last closed
        self._expected_failures = 0  # of handshakes that the guard itself aborted
        self._orphaned_bytes = 0.0  # memory of closed connections since the socket was last empty
        self._agent_addresses: set[str] = set()  # from which a key has sent a message
        self._resident_bytes = tcp.resident_bytes()  # memory of this process when little waited last
        self._delivered_bytes = 0  # since then: the receiver may still hold them
        self.expects_growth = False  # this process grows by itself: no peer is blamed for it
        self._marked_s = 0.0
        self._messages_since_mark = 0
        self._thread = Thread(target=self._run, name="guard", daemon=True)
        self._thread.start()

    # ------------------------------------------------------------------ for other threads

    def deliver(self, descriptor: int, size: int, parts: int, key: str) -> None:
        """Record a received message of `size` bytes on the wire in `parts` frames from that connection."""
        with self._lock:
            all_bytes, all_parts, messages, _ = self._delivered.get(descriptor, (0, 0, 0, ""))
            self._delivered[descriptor] = all_bytes + size, all_parts + parts, messages + 1, key

    def check(self) -> None:
        """Check if due; call between two messages."""
        self._unchecked_messages += 1
        due_s = (
            self._last_check_s + _ALERT_CHECK_MS * 1e-3
            if self._unchecked_messages >= _BURST_MESSAGES
            else self._next_check_s
        )
        if time.monotonic() >= due_s and self._check_lock.acquire(blocking=False):
            try:
                self._next_check_s = min(self._next_check_s, time.monotonic())
                self._check_if_due()
            finally:
                self._check_lock.release()

    def is_discarding(self, descriptor: int) -> bool:
        """Return whether messages from that connection are to be discarded."""
        return self._gate.is_discarding(descriptor)

    def record_empty(self, asked_s: float) -> None:
        """Record that no message waited at `asked_s` (time.monotonic)."""
        self._last_empty_s = asked_s

    def report_offence(self, descriptor: int, reason: str) -> None:
        """Report that the connection sent what no agent sends."""
        connection = self._connections.get(descriptor)
        if connection is not None and connection.is_unambiguous:  # abort now; block at the next check
            connection.abort()
            self._offences.append((connection, reason))
        else:
            self._offences.append((descriptor, reason))

    def admit(self, key: str, address: str) -> bool:
        """Return whether an authorized key may connect now, i.e. is not blocked."""
        if self._blocklist.is_blocked(key, time.monotonic()):
            return False
        self._admissions.append((key, address))
        return True

    def take_reports(self) -> list[str]:
        """Return a line for each disconnection since the last call."""
        return [self._reports.popleft() for _ in range(len(self._reports))]

    def take_failed_handshakes(self) -> int:
        """Return the number of failed handshakes since the last call."""
        with self._lock:
            failed, self._failed_handshakes = self._failed_handshakes, 0
        return failed

    def close(self) -> None:
        """End the guard; call before the socket is closed. May be repeated."""
        if not self._socket.closed:
            self._socket.disable_monitor()
        self._thread.join()

    # ------------------------------------------------------------------ scheduling of checks

    def _run(self) -> None:
        wait_ms: float | None = None
        while not self._is_stopped:
            self._event_poller.poll(wait_ms)
            with self._check_lock:
                self._check_if_due()
                left_s = max(0.0, self._next_check_s - time.monotonic())
                wait_ms = math.ceil(1e3 * left_s) if self._connections else None
        self._event_socket.close(linger=0)

    def _check_if_due(self) -> None:
        """Handle events, and check if due. A failure costs this check, not the guard or the receiver."""
        try:
            self._is_stopped = self._is_stopped or not self._handle_events()
            if not self._is_stopped and time.monotonic() >= self._next_check_s:
                self._next_check_s = time.monotonic() + _CHECK_MS * 1e-3
                wait_ms = self._check(time.monotonic())
                self._unchecked_messages, self._last_check_s = 0, time.monotonic()
                self._next_check_s = self._last_check_s + wait_ms * 1e-3
        except Exception as error:
            self._next_check_s = time.monotonic() + _CHECK_MS * 1e-3
            self._reports.append(f"the guard of connections failed and goes on: {error!r}")

    def _handle_events(self) -> bool:
        """Handle all waiting monitor events. Return False once the monitor has stopped."""
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
            elif event == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL:  # else its peer left, or never answered
                with self._lock:
                    self._failed_handshakes += 1

    def _accept(self, descriptor: int) -> None:
        self._remove(descriptor)  # libzmq reports no end of a connection that another took over
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
        """Whether more data wait to be discarded than may wait at all."""
        return self._orphaned_bytes > self._limits.total_bytes

    def _release_waiting(self, now_s: float) -> None:
        for connection in self._gate.release_waiting(self._connections.values(), self._is_full, now_s):
            connection.is_unambiguous = self._is_unambiguous(connection.descriptor)
            connection.backlog.last_message_s = now_s

    def _enforce_connection_limit(self) -> None:
        """If there are too many connections, abort a random unidentified one of the address that has most:
        the oldest or newest would be predictable. If all others are identified, that is the newest."""
        live = self._live_connections()
        unidentified = [connection for connection in live if connection.is_unidentified]
        if unidentified and (len(unidentified) > MAX_UNIDENTIFIED or len(live) > MAX_CONNECTIONS):
            address = Counter(connection.address for connection in unidentified).most_common(1)[0][0]
            self._abort(random.choice([c for c in unidentified if c.address == address]))
            self._reports.append(f"{address}: too many open connections")

    def _live_connections(self) -> list[Connection]:
        return [connection for connection in self._connections.values() if not connection.is_aborted]

    def _remove(self, descriptor: int) -> None:
        connection = self._connections.pop(descriptor, None)
        if connection is not None:
            self._closed_s[descriptor] = time.monotonic()
            self._orphaned_bytes += connection.backlog.memory_bytes

    def _check(self, now_s: float) -> int:
        """Check all connections. Return the milliseconds until the next check."""
        empty_s = self._last_empty_s  # read first: messages received before are then among the deliveries
        while self._admissions:
            self._assign_key(*self._admissions.popleft())
        self._record_deliveries(now_s)
        for connection in list(self._connections.values()):
            if not connection.update_backlog():
                self._remove(connection.descriptor)
        while self._offences:
            offender, reason = self._offences.popleft()
            found = self._connections.get(offender) if isinstance(offender, int) else offender
            if found is not None and found.is_unambiguous:
                self._disconnect(found, reason, now_s, block=True)
        if empty_s > self._marked_s or self._messages_since_mark >= _ROUND_MESSAGES:
            self._check_quiet_connections(empty_s, now_s)
        self._enforce_limits(now_s)
        self._gate.record_empty(empty_s)
        waiting_bytes = sum(max(0, c.backlog.waiting_bytes) for c in self._live_connections())
        if self.expects_growth:
            self._resident_bytes, self._delivered_bytes = tcp.resident_bytes(), 0
        elif waiting_bytes > self._limits.message_bytes:
            self._check_memory_growth(waiting_bytes, now_s)
        self._release_waiting(now_s)
        if waiting_bytes <= self._limits.message_bytes and not self._gate.is_discarding_any:
            self._resident_bytes, self._delivered_bytes = tcp.resident_bytes(), 0
            return _CHECK_MS
        self._wake_receiver()
        return _ALERT_CHECK_MS

    def _check_memory_growth(self, waiting_bytes: int, now_s: float) -> None:
        """Disconnect a peer that hides small parts behind large ones, by the growth of this process."""
        explained = self._resident_bytes + self._delivered_bytes + waiting_bytes
        grown = tcp.resident_bytes() - explained - self._discarded_memory_bytes()
        if grown > MAX_GROWTH_BYTES:
            self._disconnect(self._heaviest(now_s), "many small parts", now_s, block=True)
            self._orphaned_bytes += grown  # explained now: no further peer is blamed for it

    def _discarded_memory_bytes(self) -> float:
        """Return the memory of all data to be discarded, as if none were discarded yet, bytes."""
        return self._orphaned_bytes + sum(
            c.backlog.memory_bytes for c in self._connections.values() if c.is_aborted
        )

    def _record_deliveries(self, now_s: float) -> None:
        """Add the deliveries since the last check to the backlogs."""
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
        """Set the key of a connection by its first message."""
        connection.key = key
        if key and len(self._agent_addresses) < _MAX_AGENT_ADDRESSES:
            self._agent_addresses.add(connection.address)
        if key and sum(other.key == key for other in self._live_connections()) > MAX_CONNECTIONS // 2:
            self._abort(connection)
            self._reports.append(f"the key '{key}': too many open connections")

    def _assign_key(self, key: str, address: str) -> None:
        """Assign an admitted key to its connection, if only one of that address is unidentified."""
        unidentified = [c for c in self._live_connections() if c.address == address and c.is_unidentified]
        if len(unidentified) == 1:
            unidentified[0].key = key

    def _check_quiet_connections(self, empty_s: float, now_s: float) -> None:
        """Check connections without a delivery since the mark, or all if the socket was empty since: no
        complete message of them waits."""
        is_empty = empty_s > self._marked_s
        for connection in self._connections.values():
            backlog = connection.backlog
            if is_empty:
                connection.is_unambiguous |= self._closed_s.get(connection.descriptor, -1.0) < empty_s
            if is_empty or backlog.is_quiet():
                if backlog.marked_bytes > self._limits.message_bytes:
                    self._disconnect(connection, "an endless message", now_s, block=True)
                elif not connection.is_held and now_s - backlog.last_message_s > (
                    _IDENTIFY_TIMEOUT_S if connection.is_unidentified else SILENCE_TIMEOUT_S
                ):
                    self._abort(connection)
                backlog.classify_commands()
            backlog.mark()
        self._orphaned_bytes = 0.0 if is_empty else self._orphaned_bytes
        self._marked_s, self._messages_since_mark = time.monotonic(), 0

    def _enforce_limits(self, now_s: float) -> None:
        """Disconnect peers above their limit; then, while all together are above theirs, the heaviest
        ones."""
        for connection in self._live_connections():
            if connection.backlog.exceeds(self._limits):
                self._disconnect_overloaded(connection, "too much data waits", now_s)
        discarded = self._discarded_memory_bytes()
        share = self._limits.peer_bytes / 8  # which a peer may have in any case
        while live := self._live_connections():
            live_bytes = sum(connection.backlog.memory_bytes for connection in live)
            worst = self._heaviest(now_s)
            if (
                live_bytes + (discarded if worst.backlog.memory_bytes > share else 0.0)
                <= self._limits.total_bytes
            ):
                break
            self._disconnect_overloaded(worst, "too much data of all connections waits", now_s)

    def _disconnect_overloaded(self, connection: Connection, reason: str, now_s: float) -> None:
        if connection.backlog.has_small_parts:
            self._disconnect(connection, "many small parts", now_s, block=True)
        else:
            self._disconnect(connection, reason, now_s)

    def _heaviest(self, now_s: float) -> Connection:
        """Return the live connection with the largest product of waiting memory and time since its
        message."""
        return max(
            self._live_connections(),
            key=lambda c: c.backlog.memory_bytes * (now_s - c.backlog.last_message_s + 0.1),
        )

    def _disconnect(self, connection: Connection, reason: str, now_s: float, block: bool = False) -> None:
        """Abort a connection and discard its data. block: its peer sends what no agent does, and stays out
        for a while; else it may be an honest agent of a very busy edge, and may reconnect at once."""
        if connection.is_aborted:
            return
        self._abort(connection)
        self._gate.record_abort(connection.descriptor, time.monotonic())
        if not block:
            self._reports.append(f"{connection.key or connection.address}: {reason}; disconnected")
            return
        target = connection.block_target(self._agent_addresses)
        self._reports.append(f"{connection.name}: {reason}; disconnected{' and blocked' if target else ''}")
        if target is not None:
            self._blocklist.block(target, now_s)
        else:
            self._gate.pause_address(connection.address, now_s)

    def _abort(self, connection: Connection) -> None:
        connection.is_aborted = True
        was_open = connection.abort()
        if was_open and connection.is_unidentified and self._expected_failures < MAX_CONNECTIONS:
            self._expected_failures += 1
