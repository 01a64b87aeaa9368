"""The IMU bias of a live camera, kept from run to run: read at the start, written at the end.

Recordings have none: their poses must not depend on earlier runs.
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
    """Loads and saves the bias. `bias` is the initial one, None if unknown. A file error costs one log
    line."""

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
        """Save the bias at the end of a run; None keeps the saved one."""
        if self._serial is None or bias is None:
            return
        try:
            imu_memory.save_bias(self._serial, SavedBias(self._now_ns(), bias))
        except ShareError as error:
            self._notify(f"the IMU bias is not saved: {error}")

    def report(self) -> dict[str, Any]:
        """Return, for a live camera with an IMU, the end of the run that saved the loaded bias, or None."""
        return {} if self._serial is None else {"imu_bias": {"learnt_at": _utc(self._saved_ns)}}

    def _load(self, serial: str, source: Source, config: InertialConfig) -> None:
        assert source.rig.imu is not None
        try:
            saved = imu_memory.load_bias(serial)
        except ShareError as error:
            self._notify(f"the IMU bias is taken as unknown: {error}")
            return
        if saved is None:
            return
        age_s = (self._now_ns() - saved.run_end_ns) * 1e-9
        if age_s < 0:
            self._notify(
                "the IMU bias is taken as unknown: its file is from the future by this machine's clock"
            )
            return
        self.bias = propagate_bias(saved.bias, source.rig.imu, age_s, config)
        self._saved_ns = None if self.bias is None else saved.run_end_ns


def _utc(at_ns: int | None) -> str | None:
    return None if at_ns is None else time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(at_ns // 10**9))
