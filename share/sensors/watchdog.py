"""What to do when a device falls silent. It has no clock: the time is told with every call (ns)."""

from __future__ import annotations

from collections.abc import Collection
from enum import Enum

from share.sensors.intake import ACCEL, GYRO
from share.sensors.measurement import CAM0, CAM1, DEPTH

_IN_VAIN = 2  # connections after a reset in which a stream never came: then it is broken


class Action(Enum):
    """What the watchdog asks for."""

    NOTHING = "nothing"
    RESET = "reset"  # the device by its hardware, once; then reconnect
    GO_WITHOUT = "go without"  # say what stays silent; go on without it
    HEARD_AGAIN = "heard again"  # say that it is back
    RECONNECT = "reconnect"  # look for the device by its serial number
    GIVE_UP = "give up"  # what is needed has never come: say so, and end


class Health(Enum):
    """What a person sees."""

    OK = "OK"
    VISION_ONLY = "VISION_ONLY"
    DEGRADED = "DEGRADED"
    AWAY = "AWAY"


def enough(streams: Collection[str], sees: bool = True) -> bool:
    """Whether one can go on with these: the left eye, and what tells how far things are. sees: else it is the
    IMU alone that is wanted."""
    imu = ACCEL in streams and GYRO in streams
    return CAM0 in streams and (imu or CAM1 in streams or DEPTH in streams) if sees else imu


class Watchdog:
    """Some streams silent for twice silent_ms while others come: one reset in a run; then they are done
    without if the rest is `enough` (`VISION_ONLY`: the IMU; `DEGRADED`: others), else reconnect. All silent
    for silent_ms, or a device that is gone: reconnect, again and again. What is needed and has never come,
    not in _IN_VAIN connections after the reset either, will not come: give up. Silence is not counted in the
    first warm_up_ms after a connection, nor at a tick that comes late: who has slept cannot know. `silent`
    names the streams of the last action; `resets` and `reconnections` are counted.
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
        """streams: that are expected; reset_ms: what a device needs after its reset."""
        self.health, self.silent = Health.OK, tuple[str, ...]()
        self.resets = 0
        self._connections = self._vain = 0
        self._without, self._ever = set[str](), set[str]()
        self._silent_ns, self._warm_up_ns = int(silent_ms * 1e6), int(warm_up_ms * 1e6)
        self._retry_ns, self._reset_ns = int(retry_ms * 1e6), int(reset_ms * 1e6)
        self._heard_ns = dict.fromkeys(streams, now_ns)
        self._tick_ns, self._late = now_ns, False
        self._listen(now_ns)

    @property
    def reconnections(self) -> int:
        """Connections after the first."""
        return max(0, self._connections - 1)

    @property
    def without(self) -> tuple[str, ...]:
        """Streams that are done without."""
        return tuple(name for name in self._heard_ns if name in self._without)

    def connected(self, now_ns: int) -> None:
        """The device delivers, or is about to."""
        self.health = Health.OK
        self._connections += 1
        self._listen(now_ns)

    def lost(self, now_ns: int) -> None:
        """The device is gone, or cannot be opened."""
        self._away(now_ns + self._retry_ns)

    def heard(self, stream: str, now_ns: int) -> None:
        """A sample of the stream came."""
        if stream in self._heard_ns:
            self._ever.add(stream)
            self._heard_ns[stream] = max(self._heard_ns[stream], now_ns)

    def tick(self, now_ns: int) -> Action:
        """What to do now."""
        slept, self._tick_ns = now_ns - self._tick_ns > self._silent_ns // 2, now_ns
        if self.health is Health.AWAY:
            return self._retry(now_ns)
        self._late = slept and not self._late  # but who is always late must judge all the same
        return Action.NOTHING if self._late else self._judge(now_ns)

    def _listen(self, now_ns: int) -> None:
        self._without = set()
        self._tick_ns = now_ns
        self._heard_ns = dict.fromkeys(self._heard_ns, now_ns + self._warm_up_ns - self._silent_ns)

    def _away(self, until_ns: int) -> None:
        self.health, self._try_ns = Health.AWAY, until_ns

    def _retry(self, now_ns: int) -> Action:
        if now_ns < self._try_ns:
            return Action.NOTHING
        self._try_ns = now_ns + self._retry_ns
        return Action.RECONNECT

    def _judge(self, now_ns: int) -> Action:
        ages = {name: now_ns - at_ns for name, at_ns in self._heard_ns.items()}
        silent = {name for name, age in ages.items() if age > self._silent_ns}
        if back := self._without - silent:
            return self._back(back)
        if len(silent) == len(ages):  # where all fall silent, it is gone
            self._name(silent - self._without)
            return self._lose(now_ns, gone=bool(self._ever))
        # what is pulled out falls silent stream by stream, since queues differ: so the others must go on
        surely = {name for name in silent if ages[name] > 2 * self._silent_ns}
        if surely <= self._without or min(ages.values()) > self._silent_ns // 2:
            return Action.NOTHING
        self._name(surely - self._without)
        if self.resets == 0:
            return self._reset(now_ns)
        if enough(self._heard_ns.keys() - surely, sees=CAM0 in self._heard_ns):
            return self._go_without(surely)
        return self._lose(now_ns, gone=False)

    def _name(self, silent: set[str]) -> None:
        self.silent = tuple(name for name in self._heard_ns if name in silent)

    def _lose(self, now_ns: int, gone: bool) -> Action:
        """gone: the device as a whole, which has delivered before."""
        if not gone and not set(self.silent) <= self._ever:
            if self.resets == 0:
                return self._reset(now_ns)
            self._vain += 1
            if self._vain >= _IN_VAIN:
                return Action.GIVE_UP
        self.lost(now_ns)
        return Action.RECONNECT

    def _reset(self, now_ns: int) -> Action:
        self.resets += 1
        self._away(now_ns + self._reset_ns)
        return Action.RESET

    def _go_without(self, silent: set[str]) -> Action:
        self._without = set(silent)
        self._say_health()
        return Action.GO_WITHOUT

    def _back(self, back: set[str]) -> Action:
        self._name(back)
        self._without -= back
        self._say_health()
        return Action.HEARD_AGAIN

    def _say_health(self) -> None:
        if self._without & {ACCEL, GYRO}:
            self.health = Health.VISION_ONLY
        else:
            self.health = Health.DEGRADED if self._without else Health.OK
