"""Decide what to do when a device falls silent. Pure: every call is given the time, ns."""

from __future__ import annotations

from collections.abc import Collection
from enum import Enum

from share.sensors.measurement import CAM0, CAM1, DEPTH
from share.sensors.sample_processor import ACCEL, GYRO

_MAX_FAILED_CONNECTIONS = 2  # connections after a reset without a needed stream: then the device is broken


class Action(Enum):
    """A request of the watchdog to its caller."""

    NOTHING = "nothing"
    RESET = "reset"  # reset the hardware, once per run; then reconnect
    GO_WITHOUT = "go without"  # report the silent streams; continue without them
    RECOVERED = "recovered"  # report that the streams are back
    RECONNECT = "reconnect"  # find the device by its serial number
    GIVE_UP = "give up"  # a needed stream never came: report it, and end


class Health(Enum):
    """State of the device, as reported."""

    OK = "OK"
    VISION_ONLY = "VISION_ONLY"
    DEGRADED = "DEGRADED"
    AWAY = "AWAY"


def is_sufficient(streams: Collection[str], needs_image: bool = True) -> bool:
    """Return whether tracking works with these streams: the left image and a source of scale.

    needs_image: False if only the IMU is recorded.
    """
    imu = ACCEL in streams and GYRO in streams
    return CAM0 in streams and (imu or CAM1 in streams or DEPTH in streams) if needs_image else imu


class Watchdog:
    """Watches for silent streams and chooses an `Action` at every tick.

    Some streams silent for 2 silent_ms while others deliver: reset the device once per run; after that, go
    without them if the rest `is_sufficient` (`VISION_ONLY`: without the IMU, `DEGRADED`: without others),
    else reconnect. All silent for silent_ms, or the device gone: reconnect until it is back. A needed stream
    that never came, nor in _MAX_FAILED_CONNECTIONS connections after the reset: give up.

    Silence does not count in the first warm_up_ms after a connection, nor at a late tick, when the process
    itself may have been suspended. `silent`: the streams of the last action. `resets` and `reconnections`
    count.
    """

    def __init__(
        self,
        now_ns: int,
        streams: Collection[str],
        silent_ms: float = 1000.0,
        warm_up_ms: float = 4000.0,
        retry_ms: float = 1000.0,
        reset_ms: float = 3000.0,
    ) -> None:
        """streams: the expected ones. retry_ms: between reconnections. reset_ms: what a reset takes."""
        self.health, self.silent = Health.OK, tuple[str, ...]()
        self.resets = 0
        self._connections = self._failed_connections = 0
        self._excluded, self._delivered = set[str](), set[str]()
        self._silent_ns, self._warm_up_ns = int(silent_ms * 1e6), int(warm_up_ms * 1e6)
        self._retry_ns, self._reset_ns = int(retry_ms * 1e6), int(reset_ms * 1e6)
        self._last_sample_ns = dict.fromkeys(streams, now_ns)
        self._tick_ns, self._is_late = now_ns, False
        self._reset_timers(now_ns)

    @property
    def reconnections(self) -> int:
        """Connections after the first."""
        return max(0, self._connections - 1)

    @property
    def excluded(self) -> tuple[str, ...]:
        """Streams that the run continues without."""
        return tuple(name for name in self._last_sample_ns if name in self._excluded)

    def record_connect(self, now_ns: int) -> None:
        """Record that the device is connected."""
        self.health = Health.OK
        self._connections += 1
        self._reset_timers(now_ns)

    def record_disconnect(self, now_ns: int) -> None:
        """Record that the device is gone, or cannot be opened."""
        self._set_away(now_ns + self._retry_ns)

    def record_sample(self, stream: str, now_ns: int) -> None:
        """Record a sample of a stream."""
        if stream in self._last_sample_ns:
            self._delivered.add(stream)
            self._last_sample_ns[stream] = max(self._last_sample_ns[stream], now_ns)

    def tick(self, now_ns: int) -> Action:
        """Return what to do now."""
        was_late, self._tick_ns = now_ns - self._tick_ns > self._silent_ns // 2, now_ns
        if self.health is Health.AWAY:
            return self._retry(now_ns)
        self._is_late = was_late and not self._is_late  # skip one late tick, not every one
        return Action.NOTHING if self._is_late else self._evaluate(now_ns)

    def _reset_timers(self, now_ns: int) -> None:
        self._excluded = set()
        self._tick_ns = now_ns
        self._last_sample_ns = dict.fromkeys(
            self._last_sample_ns, now_ns + self._warm_up_ns - self._silent_ns
        )

    def _set_away(self, until_ns: int) -> None:
        self.health, self._retry_due_ns = Health.AWAY, until_ns

    def _retry(self, now_ns: int) -> Action:
        if now_ns < self._retry_due_ns:
            return Action.NOTHING
        self._retry_due_ns = now_ns + self._retry_ns
        return Action.RECONNECT

    def _evaluate(self, now_ns: int) -> Action:
        ages = {name: now_ns - at_ns for name, at_ns in self._last_sample_ns.items()}
        silent = {name for name, age in ages.items() if age > self._silent_ns}
        if recovered := self._excluded - silent:
            return self._recover(recovered)
        if len(silent) == len(ages):  # all silent: the device is gone
            self._set_silent(silent - self._excluded)
            return self._reconnect(now_ns, is_device_gone=bool(self._delivered))
        # an unplugged device falls silent stream by stream, as queues differ: so require that others deliver
        long_silent = {name for name in silent if ages[name] > 2 * self._silent_ns}
        if long_silent <= self._excluded or min(ages.values()) > self._silent_ns // 2:
            return Action.NOTHING
        self._set_silent(long_silent - self._excluded)
        if self.resets == 0:
            return self._reset(now_ns)
        if is_sufficient(self._last_sample_ns.keys() - long_silent, needs_image=CAM0 in self._last_sample_ns):
            return self._exclude(long_silent)
        return self._reconnect(now_ns, is_device_gone=False)

    def _set_silent(self, silent: set[str]) -> None:
        self.silent = tuple(name for name in self._last_sample_ns if name in silent)

    def _reconnect(self, now_ns: int, is_device_gone: bool) -> Action:
        """Reconnect; reset or give up if a silent stream never delivered.

        is_device_gone: the whole device, which has delivered before.
        """
        if not is_device_gone and not set(self.silent) <= self._delivered:
            if self.resets == 0:
                return self._reset(now_ns)
            self._failed_connections += 1
            if self._failed_connections >= _MAX_FAILED_CONNECTIONS:
                return Action.GIVE_UP
        self.record_disconnect(now_ns)
        return Action.RECONNECT

    def _reset(self, now_ns: int) -> Action:
        self.resets += 1
        self._set_away(now_ns + self._reset_ns)
        return Action.RESET

    def _exclude(self, silent: set[str]) -> Action:
        self._excluded = set(silent)
        self._update_health()
        return Action.GO_WITHOUT

    def _recover(self, recovered: set[str]) -> Action:
        self._set_silent(recovered)
        self._excluded -= recovered
        self._update_health()
        return Action.RECOVERED

    def _update_health(self) -> None:
        if self._excluded & {ACCEL, GYRO}:
            self.health = Health.VISION_ONLY
        else:
            self.health = Health.DEGRADED if self._excluded else Health.OK
