"""One question and its answer between two clocks: what it tells of the one against the other."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Exchange:
    """sent, back: by the clock of who asks; received, replied: by that of who answers (RFC 5905, section
    8: T1, T4 and T2, T3). All ns."""

    sent_ns: int
    received_ns: int
    replied_ns: int
    back_ns: int

    @property
    def offset_ns(self) -> int:
        """The other clock minus the own, to the half ns below; wrong by at most half of `delay_ns`,
        namely by half of what the way there took longer than the way back."""
        return ((self.received_ns - self.sent_ns) + (self.replied_ns - self.back_ns)) // 2

    @property
    def delay_ns(self) -> int:
        """Time on the way, both ways. Negative only if a clock was set meanwhile."""
        return (self.back_ns - self.sent_ns) - (self.replied_ns - self.received_ns)

    @property
    def unproven_ns(self) -> int:
        """Twice what `offset_ns` can be wrong by if one of the two times of the other clock is made up: that
        one was read within the exchange, which the own clock has timed, is all that it cannot feign."""
        return (self.back_ns - self.sent_ns) + (self.replied_ns - self.received_ns)

    @property
    def is_possible(self) -> bool:
        """Whether it can be of clocks that nobody set meanwhile."""
        return self.back_ns >= self.sent_ns and self.replied_ns >= self.received_ns and self.delay_ns >= 0
