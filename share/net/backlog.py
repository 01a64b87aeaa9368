"""How much data of one connection waits in libzmq, and how much may. Pure: no socket, no clock.

libzmq collects all parts of a message before it delivers it. Two counters tell how much it holds: bytes read
from the connection, and bytes of the messages delivered. Their difference is the data that wait, plus
commands (handshake, heartbeats), which are never delivered.

Small parts take more memory than they have bytes. The size of waiting parts is estimated from those that the
connection delivered last.
"""

from __future__ import annotations

from dataclasses import dataclass, field

PART_OVERHEAD_BYTES = 64  # memory that libzmq holds per part
CURVE_OVERHEAD_BYTES = 33  # per encrypted part: name and nonce 16, authenticator 16, flags 1 (RFC 26)
_MAX_TOTAL_BYTES = 24_000_000  # memory of the data that wait, of all connections
_BUFFER_FACTOR = 1.5  # memory per waiting byte: parts under 8 kB stay in their receive buffer
_DENSITY_WINDOW_BYTES = 16_000  # of delivered data over which the part size is averaged
_DEFAULT_DENSITY = 8 / 1024  # parts per byte, before any are known
SMALL_PARTS_FACTOR = 8.0  # memory per byte above which a peer sends more small parts than any agent does
SMALL_PARTS_DIVISOR = 4  # of the limit for small parts: the more there are, the longer discarding them takes
_MAX_MESSAGES = 32  # of the largest size that may wait: an agent has up to 16 keyframes in flight
_MAX_IMAGE_MESSAGES = 4  # the same for frames that are images: an agent has up to 3 in flight
_MIN_IMAGE_BYTES = 1_000_000  # frame size limit from which frames are images


@dataclass(frozen=True)
class BacklogLimits:
    message_bytes: int  # the largest message, bytes on the wire
    peer_bytes: int  # memory of one peer's waiting data
    total_bytes: int  # memory of all peers' waiting data

    @classmethod
    def for_frame_size(cls, max_frame_bytes: int) -> BacklogLimits:
        """Return the limits for a largest frame (message part) of `max_frame_bytes`."""
        max_messages = _MAX_IMAGE_MESSAGES if max_frame_bytes >= _MIN_IMAGE_BYTES else _MAX_MESSAGES
        message = 2 * max_frame_bytes + max_frame_bytes // 8  # two images and less for the other parts
        total = max(2 * message, _MAX_TOTAL_BYTES)
        return cls(message, min(max_messages * message, total), total)


def wire_bytes(size: int, is_encrypted: bool) -> int:
    """Return the bytes on the wire of a part of `size` bytes: encryption, flags and size included (RFC 23,
    RFC 26)."""
    size += CURVE_OVERHEAD_BYTES if is_encrypted else 0
    return size + (2 if size < 256 else 9)


@dataclass
class Backlog:
    """The backlog of one connection."""

    last_message_s: float  # time of the last delivered message, before that of the connection
    read_bytes: int = 0
    delivered_bytes: int = 0
    message_count: int = 0
    _parts_per_byte: float = _DEFAULT_DENSITY  # of recently delivered data
    _command_bytes: int = 0  # of the read bytes, as far as known
    _has_new_message: bool = False  # since the last `classify_commands`
    _mark: tuple[int, int] = field(default=(0, 0))  # read bytes and message count at the last `mark`

    @property
    def waiting_bytes(self) -> int:
        return self.read_bytes - self.delivered_bytes - self._command_bytes

    @property
    def memory_per_byte(self) -> float:
        """Estimated memory per waiting byte."""
        return _BUFFER_FACTOR + PART_OVERHEAD_BYTES * self._parts_per_byte

    @property
    def memory_bytes(self) -> float:
        """Estimated memory of the waiting data, bytes."""
        return max(0, self.waiting_bytes) * self.memory_per_byte

    @property
    def has_small_parts(self) -> bool:
        """Whether the waiting data consist of small parts."""
        return self.memory_per_byte > SMALL_PARTS_FACTOR

    def exceeds(self, limits: BacklogLimits) -> bool:
        """Return whether more waits than one peer may have."""
        return self.memory_bytes > limits.peer_bytes / (SMALL_PARTS_DIVISOR if self.has_small_parts else 1)

    @property
    def marked_bytes(self) -> int:
        """Bytes that waited at the mark and still do."""
        return self._mark[0] - self.delivered_bytes - self._command_bytes

    def update_read(self, read: int, is_exact: bool) -> None:
        """Set the number of bytes that libzmq has read so far; a lower bound unless `is_exact`."""
        self.read_bytes = max(self.read_bytes, read)
        if is_exact:
            self._command_bytes = max(0, min(self._command_bytes, self.read_bytes - self.delivered_bytes))

    def deliver(self, size: int, parts: int, messages: int, now_s: float) -> None:
        """Record delivered messages of `size` bytes and `parts` frames in all. Call `update_read`
        afterwards."""
        self.delivered_bytes += size
        self._parts_per_byte += (parts - size * self._parts_per_byte) / (_DENSITY_WINDOW_BYTES + size)
        self.message_count += messages
        self.last_message_s = now_s
        self._has_new_message = True

    def mark(self) -> None:
        self._mark = self.read_bytes, self.message_count

    def is_quiet(self) -> bool:
        """Return whether no message was delivered since the mark."""
        return self.message_count == self._mark[1]

    def classify_commands(self) -> None:
        """Count the bytes left from the mark as commands. Call when no complete message waits of what was
        read then: the rest is commands, or the beginning of a message, which `update_read` corrects once it
        is delivered. Does nothing without a new message since the last call, so that an endless message
        cannot pass as commands."""
        if self._has_new_message and self.marked_bytes > 0:
            self._command_bytes += self.marked_bytes
        self._has_new_message = False
