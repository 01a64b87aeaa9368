"""Of one stream: what is missing, and what comes in the wrong order."""

from __future__ import annotations

_LATE = 1.5  # times the expected step: something is missing


class Gaps:
    """Feed stamps, and frame numbers where the device gives them.

    Counts `samples` (in order), `gaps` (steps longer than expected), `missing` (by frame number where
    given, else as many as fit into the gap), `backward` (not later than the last; to be left out).
    """

    def __init__(self, rate_hz: float) -> None:
        """Raises ValueError for a rate that is not positive."""
        if not rate_hz > 0:
            raise ValueError(f"rate_hz: {rate_hz} must be positive")
        self.samples = self.gaps = self.missing = self.backward = 0
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self._step_ns = 1e9 / rate_hz
        self._number: int | None = None

    @property
    def seconds(self) -> float:
        """From the first sample to the last."""
        if self.first_ns is None or self.last_ns is None:
            return 0.0
        return (self.last_ns - self.first_ns) * 1e-9

    def feed(self, stamp_ns: int, number: int | None = None) -> bool:
        """Whether the sample is in order and may be used."""
        if self.last_ns is not None:
            step = stamp_ns - self.last_ns
            if step <= 0:
                self.backward += 1
                return False
            self._missing(step, number)
        self.first_ns = stamp_ns if self.first_ns is None else self.first_ns
        self.last_ns, self._number = stamp_ns, number
        self.samples += 1
        return True

    def _missing(self, step: int, number: int | None) -> None:
        late = step > _LATE * self._step_ns
        lost = round(step / self._step_ns) - 1 if late else 0
        if number is not None and self._number is not None and number > self._number:
            lost = number - self._number - 1
        self.missing += lost
        self.gaps += late or lost > 0
