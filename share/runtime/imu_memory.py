"""What a live camera's IMU was like in the run before: read at the start, written at the end.

Only a camera is remembered: a recording gives the same poses whatever was run before it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from share.cameras.live import LiveSource
from share.config import InertialConfig
from share.errors import ShareError
from share.geometry.camera import ImuBias
from share.runtime.source import Source
from share.sensors import imu_memory
from share.sensors.imu_memory import Remembered, aged


class ImuMemory:
    """bias: to begin with; None: nothing is known. What cannot be read or written costs one line."""

    def __init__(
        self,
        source: Source,
        config: InertialConfig,
        say: Callable[[str], None],
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._say, self._now_ns = say, now_ns
        live = isinstance(source, LiveSource) and source.rig.imu is not None
        self._serial = source.serial if live else None
        self.bias: ImuBias | None = None
        self._from_ns: int | None = None
        if self._serial is not None:
            self._recall(self._serial, source, config)

    def keep(self, bias: ImuBias | None) -> None:
        """For the next run, at the end of this one; None: it has learnt nothing, and what was known stays."""
        if self._serial is None or bias is None:
            return
        try:
            imu_memory.remember(self._serial, Remembered(self._now_ns(), bias))
        except ShareError as error:
            self._say(f"the IMU's bias is not remembered: {error}")

    def report(self) -> dict[str, Any]:
        """Of a live camera with an IMU: the end of the run that its bias is known from, or none."""
        return {} if self._serial is None else {"imu_bias": {"from": _utc(self._from_ns)}}

    def _recall(self, serial: str, source: Source, config: InertialConfig) -> None:
        assert source.rig.imu is not None
        try:
            found = imu_memory.recall(serial)
        except ShareError as error:
            self._say(f"the IMU's bias is taken as unknown: {error}")
            return
        if found is None:
            return
        age_s = (self._now_ns() - found.at_ns) * 1e-9
        if age_s < 0:
            self._say("the IMU's bias is taken as unknown: it is from later than this machine's clock says")
            return
        self.bias = aged(found.bias, source.rig.imu, age_s, config)
        self._from_ns = None if self.bias is None else found.at_ns


def _utc(at_ns: int | None) -> str | None:
    return None if at_ns is None else time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(at_ns // 10**9))
