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
from share.sensors.imu_memory import SavedBias, propagate_bias


class ImuBiasStore:
    """bias: to begin with; None: nothing is known. What cannot be read or written costs one line."""

    def __init__(
        self,
        source: Source,
        config: InertialConfig,
        notify: Callable[[str], None],
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._notify, self._now_ns = notify, now_ns
        live = isinstance(source, LiveSource) and source.rig.imu is not None
        self._serial = source.serial if live else None
        self.bias: ImuBias | None = None
        self._saved_ns: int | None = None
        if self._serial is not None:
            self._load(self._serial, source, config)

    def save(self, bias: ImuBias | None) -> None:
        """For the next run, at the end of this one; None: it has learnt nothing, and what was known stays."""
        if self._serial is None or bias is None:
            return
        try:
            imu_memory.save_bias(self._serial, SavedBias(self._now_ns(), bias))
        except ShareError as error:
            self._notify(f"the IMU's bias is not remembered: {error}")

    def report(self) -> dict[str, Any]:
        """Of a live camera with an IMU: the end of the run that its bias is known from, or none."""
        return {} if self._serial is None else {"imu_bias": {"from": _utc(self._saved_ns)}}

    def _load(self, serial: str, source: Source, config: InertialConfig) -> None:
        assert source.rig.imu is not None
        try:
            saved = imu_memory.load_bias(serial)
        except ShareError as error:
            self._notify(f"the IMU's bias is taken as unknown: {error}")
            return
        if saved is None:
            return
        age_s = (self._now_ns() - saved.run_end_ns) * 1e-9
        if age_s < 0:
            self._notify(
                "the IMU's bias is taken as unknown: it is from later than this machine's clock says"
            )
            return
        self.bias = propagate_bias(saved.bias, source.rig.imu, age_s, config)
        self._saved_ns = None if self.bias is None else saved.run_end_ns


def _utc(at_ns: int | None) -> str | None:
    return None if at_ns is None else time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(at_ns // 10**9))
