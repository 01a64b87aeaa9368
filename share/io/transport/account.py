"""How much of what one connection sent waits unread in libzmq, and how much may. Pure: no socket, no clock.

libzmq gathers a whole message, however many parts it has, before it hands it over. What it has gathered is
told by two counters: bytes that it has read from the connection, and bytes of the messages that it handed
over. Their difference is what waits, and commands (handshake, heartbeats), which are never handed over.
"""

from __future__ import annotations

from dataclasses import dataclass, field

PART_BYTES = 64  # that libzmq holds for a part, however small it is
_EMPTY_PART_BYTES = 2  # on the wire
_SEALED_PART_BYTES = 35  # with CURVE
_MEMORY_BYTES = 200_000_000  # that may wait in all, were it all of the smallest parts
_WAITING, _IMAGES_WAITING = 64, 4  # largest messages: an agent has 16 keyframes under way, or 3 frames
_IMAGE_BYTES = 1_000_000  # from this on frames are images


@dataclass(frozen=True)
class Bounds:
    """Bytes on the wire."""

    message: int  # the largest message
    peer: int  # all that may wait of one peer
    total: int  # and of all together

    @classmethod
    def of(cls, max_frame_bytes: int, sealed: bool) -> Bounds:
        """sealed: with keys, by which even an empty part takes its place on the wire."""
        most = _IMAGES_WAITING if max_frame_bytes >= _IMAGE_BYTES else _WAITING
        message = 2 * max_frame_bytes + max_frame_bytes // 8  # two images; the rest of any is less
        peer = most * message
        part = _SEALED_PART_BYTES if sealed else _EMPTY_PART_BYTES
        total = max(2 * message, _MEMORY_BYTES * part // PART_BYTES)
        return cls(message, min(peer, total), total)


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
    _commands: int = 0  # of what was read, as far as is known
    _news: bool = False  # a message since `_commands` was looked at
    _mark: tuple[int, int] = field(default=(0, 0))  # read and messages when marked

    @property
    def waiting(self) -> int:
        return self.read - self.handed - self._commands

    @property
    def marked(self) -> int:
        """What waited when it was marked and still does."""
        return self._mark[0] - self.handed - self._commands

    def sample(self, read: int, exact: bool) -> None:
        """libzmq has read so many bytes so far, or at least so many."""
        self.read = max(self.read, read)
        if exact:
            self._commands = max(0, min(self._commands, self.read - self.handed))

    def took(self, size: int, messages: int, now_s: float) -> None:
        """So many bytes and messages more were handed over. To be followed by a `sample`."""
        self.handed += size
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
