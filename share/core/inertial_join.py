"""Accelerometer and gyroscope with stamps of their own to one IMU stream, at the gyroscope's stamps."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence

Three = Sequence[float]
Six = list[float]


class InertialJoin:
    """Linear interpolation of the accelerometer between its neighbours; nothing is extrapolated.

    A gyroscope sample waits for the next accelerometer sample. Where the accelerometer has a gap longer
    than most_gap_ns, the samples in it are left out, so that a gap stays one. `joined` and `alone` (left
    out: no accelerometer on both sides) count samples. Each stream must come in order; the two may be
    out of step. At most most_wait_ns of the gyroscope is kept waiting.
    """

    def __init__(self, most_gap_ns: int, most_wait_ns: int = 10**9) -> None:
        self.joined = self.alone = 0
        self._most_gap_ns, self._most_wait_ns = most_gap_ns, most_wait_ns
        self._waiting: deque[tuple[int, Three]] = deque()  # gyro, later than the accel before
        self._accel: deque[tuple[int, Three]] = deque()  # the last one that is used up, and later ones

    def gyro(self, stamp_ns: int, rates: Three) -> Iterator[tuple[int, Six]]:
        """Feed one sample (3,) rad/s; gives (stamp_ns, (wx wy wz ax ay az)) of all that can be joined."""
        self._waiting.append((stamp_ns, rates))
        while stamp_ns - self._waiting[0][0] > self._most_wait_ns:
            self._waiting.popleft()
            self.alone += 1
        yield from self._join()

    def accel(self, stamp_ns: int, force: Three) -> Iterator[tuple[int, Six]]:
        """Feed one sample (3,) m/s^2; gives what `gyro` gives."""
        self._accel.append((stamp_ns, force))
        while not self._waiting and self._accel[0][0] < stamp_ns - self._most_wait_ns:
            self._accel.popleft()
        yield from self._join()

    def _join(self) -> Iterator[tuple[int, Six]]:
        while self._waiting and self._accel and self._waiting[0][0] <= self._accel[-1][0]:
            stamp, rates = self._waiting.popleft()
            while len(self._accel) > 1 and self._accel[1][0] <= stamp:
                self._accel.popleft()
            force = self._at(stamp)
            if force is None:
                self.alone += 1
            else:
                self.joined += 1
                yield stamp, [*rates, *force]

    def _at(self, stamp: int) -> Six | None:
        """The accelerometer at `stamp`, None outside of its samples or in a gap."""
        before, a = self._accel[0]
        if before == stamp:
            return list(a)
        if before > stamp or self._accel[1][0] - before > self._most_gap_ns:
            return None
        after, b = self._accel[1]
        part = (stamp - before) / (after - before)
        return [(1 - part) * x + part * y for x, y in zip(a, b, strict=True)]
