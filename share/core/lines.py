"""Lines for a person, so few that nobody who causes them can fill a terminal or a log."""

from __future__ import annotations

from collections import deque

from share.core.rate import TokenBucket

_BURST, _HZ = 20.0, 0.2  # lines at once, and then one each 5 s
_REMEMBERED = 16  # complaints
_LONGEST = 300
_GONE_NS = 60_000_000_000


class Lasting:
    """Of a trouble that comes and goes: whether it is to be said."""

    def __init__(self) -> None:
        self._there: dict[str, int] = {}  # when it was last there

    def begins(self, text: str, now_ns: int) -> bool:
        """It is there: True the first time, and where it had been gone for a minute."""
        since_ns = self._there.pop(text, None)
        self._there[text] = now_ns
        if len(self._there) > _REMEMBERED:
            del self._there[next(iter(self._there))]
        return since_ns is None or now_ns - since_ns > _GONE_NS


class Lines:
    """What may be said now. What was left out is counted, and told with the next line."""

    def __init__(self) -> None:
        self._bucket = TokenBucket(_BURST)
        self._bucket.limit(_HZ, 0)
        self._complaints: deque[str] = deque(maxlen=_REMEMBERED)
        self._left_out = 0

    def say(self, text: str, now_ns: int) -> str | None:
        """The line in printable characters; None where it is left out."""
        if not self._bucket.take(now_ns):
            self._left_out += 1
            return None
        more, self._left_out = self._left_out, 0
        line = "".join(c if c.isprintable() else "?" for c in text[:_LONGEST])
        return f"{line} ({more} lines before this were left out)" if more else line

    def complain(self, text: str, now_ns: int) -> str | None:
        """The same; None too where this was said lately."""
        if text in self._complaints:
            return None
        self._complaints.append(text)
        return self.say(text, now_ns)
