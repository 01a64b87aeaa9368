"""What to do when a device falls silent. It has no clock: the time is told with every call (ns)."""

from __future__ import annotations

from collections.abc import Collection
from enum import Enum

from share.core.intake import ACCEL, GYRO


class Action(Enum):
    """What the watchdog asks for."""

    NOTHING = "nothing"
    RESET = "reset"  # the device by its hardware, once; then reconnect
    VISION_ONLY = "vision only"  # say that the IMU stays silent; go on without it
    HEARD_AGAIN = "heard again"  # say that the IMU is back
    RECONNECT = "reconnect"  # look for the device by its serial number


class Health(Enum):
    """What a person sees."""

    OK = "OK"
    VISION_ONLY = "VISION_ONLY"
    AWAY = "AWAY"


class Watchdog:
    """Silence of the IMU while images come: one reset, then vision only. Silence of the images, or a device
    that is gone: reconnect, again and again. The IMU is silent if one of accel and gyro is, the images if one
    of their streams is. Silence is not counted in the first warm_up_ms after a connection. `resets` and
    `reconnections` are counted.
    """

    def __init__(
        self,
        now_ns: int,
        streams: Collection[str],
        silent_ms: float = 1000.0,
        warm_up_ms: float = 4000.0,
        retry_ms: float = 1000.0,
    ) -> None:
        """streams: that are expected."""
        self.health = Health.OK
        self.resets = 0
        self._connections = 0
        self._motion = [name for name in streams if name in (ACCEL, GYRO)]
        self._images = [name for name in streams if name not in (ACCEL, GYRO)]
        self._silent_ns, self._warm_up_ns = int(silent_ms * 1e6), int(warm_up_ms * 1e6)
        self._retry_ns = int(retry_ms * 1e6)
        self._listen(now_ns)

    @property
    def reconnections(self) -> int:
        """Connections after the first."""
        return max(0, self._connections - 1)

    def connected(self, now_ns: int) -> None:
        """The device delivers, or is about to."""
        self.health = Health.OK
        self._connections += 1
        self._listen(now_ns)

    def _listen(self, now_ns: int) -> None:
        patience = now_ns + self._warm_up_ns - self._silent_ns
        self._heard_ns = dict.fromkeys([*self._motion, *self._images], patience)

    def lost(self, now_ns: int) -> None:
        """The device is gone, or cannot be opened."""
        self.health = Health.AWAY
        self._try_ns = now_ns + self._retry_ns

    def heard(self, stream: str, now_ns: int) -> None:
        """A sample of the stream came."""
        if stream in self._heard_ns:
            self._heard_ns[stream] = max(self._heard_ns[stream], now_ns)

    def tick(self, now_ns: int) -> Action:
        """What to do now."""
        if self.health is Health.AWAY:
            return self._retry(now_ns)
        image_ns = self._since(self._images, now_ns)
        if now_ns - image_ns > self._silent_ns:
            self.lost(now_ns)
            return Action.RECONNECT
        if not self._motion:
            return Action.NOTHING
        # by the last image and not by now: where all fall silent, it is gone
        return self._watch_imu(now_ns, image_ns - self._since(self._motion, now_ns) > self._silent_ns)

    def _since(self, streams: list[str], now_ns: int) -> int:
        """Until when all of them were heard; now, if there are none."""
        return min((self._heard_ns[name] for name in streams), default=now_ns)

    def _retry(self, now_ns: int) -> Action:
        if now_ns < self._try_ns:
            return Action.NOTHING
        self._try_ns = now_ns + self._retry_ns
        return Action.RECONNECT

    def _watch_imu(self, now_ns: int, silent: bool) -> Action:
        if self.health is Health.VISION_ONLY:
            if silent:
                return Action.NOTHING
            self.health = Health.OK
            return Action.HEARD_AGAIN
        if not silent:
            return Action.NOTHING
        if self.resets == 0:
            self.resets = 1
            self.lost(now_ns)
            return Action.RESET
        if not self._images:  # nothing is left to go on with
            self.lost(now_ns)
            return Action.RECONNECT
        self.health = Health.VISION_ONLY
        return Action.VISION_ONLY
