"""How much of what one connection sent waits unread in libzmq, and how much may. Pure: no socket, no clock.

libzmq gathers a whole message, however many parts it has, before it hands it over. What it has gathered is
told by two counters: bytes that it has read from the connection, and bytes of the messages that it handed
over. Their difference is what waits, and commands (handshake, heartbeats), which are never handed over.

Small parts take more memory than they have bytes. How small those are that wait is taken from those that the
connection had handed over last.
"""

from __future__ import annotations

from dataclasses import dataclass, field

PART_BYTES = 64  # that libzmq holds for a part, however small it is
_MEMORY_BYTES = 24_000_000  # that what waits of all together may take
_BUFFERED = 1.5  # bytes of memory for a byte: parts of less than 8 kB stay in the buffer that they came in
_LATELY_BYTES = 16_000  # handed over, of which the size of parts is taken
_USUAL = 8 / 1024  # parts a byte, before any are known
TINY = 8.0  # times its bytes: what takes that much memory is of parts that no agent sends so many of
TINY_SHARE = 4  # of these much less may wait: the more there are, the longer it takes to throw them away
_WAITING, _IMAGES_WAITING = 32, 4  # largest messages: an agent has 16 keyframes under way, or 3 frames
_IMAGE_BYTES = 1_000_000  # from this on frames are images


@dataclass(frozen=True)
class Bounds:
    message: int  # the largest message, bytes on the wire
    peer: int  # bytes of memory that what waits of one peer may take
    total: int  # and of all together

    @classmethod
    def of(cls, max_frame_bytes: int) -> Bounds:
        most = _IMAGES_WAITING if max_frame_bytes >= _IMAGE_BYTES else _WAITING
        message = 2 * max_frame_bytes + max_frame_bytes // 8  # two images; the rest of any is less
        total = max(2 * message, _MEMORY_BYTES)
        return cls(message, min(most * message, total), total)


def wire_bytes(size: int, sealed: bool) -> int:
    """Of a part of `size` bytes: with its seal, flags and size (RFC 23, RFC 26)."""
    size += 33 if sealed else 0
    return size + (2 if size < 256 else 9)


@dataclass
class Account:
    """Of one connection."""

    since_s: float  # when it came, then when its last message was handed over
    read: int = 0
    handed: int = 0
    messages: int = 0
    _density: float = _USUAL  # parts a byte, of what was handed over lately
    _commands: int = 0  # of what was read, as far as is known
    _news: bool = False  # a message since `_commands` was looked at
    _mark: tuple[int, int] = field(default=(0, 0))  # read and messages when marked

    @property
    def waiting(self) -> int:
        return self.read - self.handed - self._commands

    @property
    def weight(self) -> float:
        """Bytes of memory for a byte that waits."""
        return _BUFFERED + PART_BYTES * self._density

    @property
    def memory(self) -> float:
        """Bytes that what waits is thought to take."""
        return max(0, self.waiting) * self.weight

    @property
    def is_tiny(self) -> bool:
        """Whether what waits is of small parts."""
        return self.weight > TINY

    def exceeds(self, bounds: Bounds) -> bool:
        """Whether more waits than may of one peer."""
        return self.memory > bounds.peer / (TINY_SHARE if self.is_tiny else 1)

    @property
    def marked(self) -> int:
        """What waited when it was marked and still does."""
        return self._mark[0] - self.handed - self._commands

    def sample(self, read: int, exact: bool) -> None:
        """libzmq has read so many bytes so far, or at least so many."""
        self.read = max(self.read, read)
        if exact:
            self._commands = max(0, min(self._commands, self.read - self.handed))

    def took(self, size: int, parts: int, messages: int, now_s: float) -> None:
        """So many bytes in so many parts and messages more were handed over. To be followed by a `sample`."""
        self.handed += size
        self._density += (parts - size * self._density) / (_LATELY_BYTES + size)
        self.messages += messages
        self.since_s = now_s
        self._news = True

    def mark(self) -> None:
        self._mark = self.read, self.messages

    def quiet(self) -> bool:
        """Whether no message has been handed over since it was marked."""
        return self.messages == self._mark[1]

    def settle(self) -> None:
        """No whole message waits of what was read when it was marked: the rest is commands, or the beginning
        of a message, which is corrected when that is handed over. Without a message since the last time
        nothing is settled: one that does not end cannot be passed off as commands."""
        if self._news and self.marked > 0:
            self._commands += self.marked
        self._news = False
