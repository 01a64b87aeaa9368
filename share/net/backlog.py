"""How much of what one connection sent waits unread in libzmq, and how much may. Pure: no socket, no clock.

libzmq gathers a whole message, however many parts it has, before it hands it over. What it has gathered is
told by two counters: bytes that it has read from the connection, and bytes of the messages that it handed
over. Their difference is what waits, and commands (handshake, heartbeats), which are never handed over.

Small parts take more memory than they have bytes. How small those are that wait is taken from those that the
connection had handed over last.
"""

from __future__ import annotations

from dataclasses import dataclass, field

PART_OVERHEAD_BYTES = 64  # that libzmq holds for a part, however small it is
_MAX_TOTAL_BYTES = 24_000_000  # that what waits of all together may take
_BUFFER_FACTOR = (
    1.5  # bytes of memory for a byte: parts of less than 8 kB stay in the buffer that they came in
)
_DENSITY_WINDOW_BYTES = 16_000  # handed over, of which the size of parts is taken
_DEFAULT_DENSITY = 8 / 1024  # parts a byte, before any are known
SMALL_PARTS_FACTOR = (
    8.0  # times its bytes: what takes that much memory is of parts that no agent sends so many of
)
SMALL_PARTS_DIVISOR = (
    4  # of these much less may wait: the more there are, the longer it takes to throw them away
)
_MAX_MESSAGES, _MAX_IMAGE_MESSAGES = (
    32,
    4,
)  # largest messages: an agent has 16 keyframes under way, or 3 frames
_MIN_IMAGE_BYTES = 1_000_000  # from this on frames are images


@dataclass(frozen=True)
class BacklogLimits:
    message_bytes: int  # the largest message, bytes on the wire
    peer_bytes: int  # bytes of memory that what waits of one peer may take
    total_bytes: int  # and of all together

    @classmethod
    def for_frame_size(cls, max_frame_bytes: int) -> BacklogLimits:
        max_messages = _MAX_IMAGE_MESSAGES if max_frame_bytes >= _MIN_IMAGE_BYTES else _MAX_MESSAGES
        message = 2 * max_frame_bytes + max_frame_bytes // 8  # two images; the rest of any is less
        total = max(2 * message, _MAX_TOTAL_BYTES)
        return cls(message, min(max_messages * message, total), total)


def wire_bytes(size: int, is_encrypted: bool) -> int:
    """Of a part of `size` bytes: with its seal, flags and size (RFC 23, RFC 26)."""
    size += 33 if is_encrypted else 0
    return size + (2 if size < 256 else 9)


@dataclass
class Backlog:
    """Of one connection."""

    last_message_s: float  # when it came, then when its last message was handed over
    read_bytes: int = 0
    delivered_bytes: int = 0
    message_count: int = 0
    _parts_per_byte: float = _DEFAULT_DENSITY  # parts a byte, of what was handed over lately
    _command_bytes: int = 0  # of what was read, as far as is known
    _has_new_message: bool = False  # a message since `_command_bytes` was looked at
    _mark: tuple[int, int] = field(default=(0, 0))  # read and messages when marked

    @property
    def waiting_bytes(self) -> int:
        return self.read_bytes - self.delivered_bytes - self._command_bytes

    @property
    def memory_per_byte(self) -> float:
        """Bytes of memory for a byte that waits."""
        return _BUFFER_FACTOR + PART_OVERHEAD_BYTES * self._parts_per_byte

    @property
    def memory_bytes(self) -> float:
        """Bytes that what waits is thought to take."""
        return max(0, self.waiting_bytes) * self.memory_per_byte

    @property
    def has_small_parts(self) -> bool:
        """Whether what waits is of small parts."""
        return self.memory_per_byte > SMALL_PARTS_FACTOR

    def exceeds(self, limits: BacklogLimits) -> bool:
        """Whether more waits than may of one peer."""
        return self.memory_bytes > limits.peer_bytes / (SMALL_PARTS_DIVISOR if self.has_small_parts else 1)

    @property
    def marked_bytes(self) -> int:
        """What waited when it was marked and still does."""
        return self._mark[0] - self.delivered_bytes - self._command_bytes

    def update_read(self, read: int, is_exact: bool) -> None:
        """libzmq has read so many bytes so far, or at least so many."""
        self.read_bytes = max(self.read_bytes, read)
        if is_exact:
            self._command_bytes = max(0, min(self._command_bytes, self.read_bytes - self.delivered_bytes))

    def deliver(self, size: int, parts: int, messages: int, now_s: float) -> None:
        """So many bytes in so many parts and messages more were handed over. To be followed by a
        `update_read`."""
        self.delivered_bytes += size
        self._parts_per_byte += (parts - size * self._parts_per_byte) / (_DENSITY_WINDOW_BYTES + size)
        self.message_count += messages
        self.last_message_s = now_s
        self._has_new_message = True

    def mark(self) -> None:
        self._mark = self.read_bytes, self.message_count

    def is_quiet(self) -> bool:
        """Whether no message has been handed over since it was marked."""
        return self.message_count == self._mark[1]

    def classify_commands(self) -> None:
        """No whole message waits of what was read when it was marked: the rest is commands, or the beginning
        of a message, which is corrected when that is handed over. Without a message since the last time
        nothing is settled: one that does not end cannot be passed off as commands."""
        if self._has_new_message and self.marked_bytes > 0:
            self._command_bytes += self.marked_bytes
        self._has_new_message = False
