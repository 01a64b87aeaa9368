"""What to do when a device falls silent. It has no clock: the time is told with every call (ns)."""

from __future__ import annotations

from enum import Enum

from share.core.intake import ACCEL, GYRO
from share.core.measurement import IMU

_MOTION = (IMU, ACCEL, GYRO)


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
    that is gone: reconnect, again and again. Silence is not counted in the first warm_up_ms after a
    connection. `resets` and `reconnections` are counted.
    """

    def __init__(
        self,
        now_ns: int,
        has_images: bool = True,
        has_imu: bool = True,
        silent_ms: float = 1000.0,
        warm_up_ms: float = 4000.0,
        retry_ms: float = 1000.0,
    ) -> None:
        self.health = Health.OK
        self.resets = 0
        self._connections = 0
        self._has_images, self._has_imu = has_images, has_imu
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
        self._imu_ns = self._image_ns = patience

    def lost(self, now_ns: int) -> None:
        """The device is gone, or cannot be opened."""
        self.health = Health.AWAY
        self._try_ns = now_ns + self._retry_ns

    def heard(self, stream: str, now_ns: int) -> None:
        """A sample of the stream came. cam0, cam1, depth count as images."""
        if stream in _MOTION:
            self._imu_ns = max(self._imu_ns, now_ns)
        else:
            self._image_ns = max(self._image_ns, now_ns)

    def tick(self, now_ns: int) -> Action:
        """What to do now."""
        if self.health is Health.AWAY:
            return self._retry(now_ns)
        if self._has_images and now_ns - self._image_ns > self._silent_ns:
            self.lost(now_ns)
            return Action.RECONNECT
        if self._has_imu:
            latest_ns = self._image_ns if self._has_images else now_ns  # all fall silent: it is gone
            return self._watch_imu(now_ns, latest_ns - self._imu_ns > self._silent_ns)
        return Action.NOTHING

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
        if not self._has_images:  # nothing is left to go on with
            self.lost(now_ns)
            return Action.RECONNECT
        self.health = Health.VISION_ONLY
        return Action.VISION_ONLY
