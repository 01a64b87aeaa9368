"""Imperfections of an emulated device, and their magnitudes."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from share.errors import UsageError


@dataclass(frozen=True)
class Effects:
    """Each effect can be turned off or set. The defaults are those of a sound device; `NO_EFFECTS` is a
    perfect one.

    Signs: a picture taken at IMU time t is stamped t - time_offset_ms (Kalibr's timeshift_cam_imu: t_imu =
    t_cam + shift). A device's clock shows session time + clock_offset_ms, and gains clock_drift_ppm
    microseconds a second from the start of the session. Raises UsageError for a value out of range.
    """

    noise: bool = True  # of the imager: shot, read, fixed pattern
    vignetting: bool = True
    lens_blur: bool = True
    exposure: bool = True  # auto exposure; off: the reference exposure and gain 1 throughout
    blur: bool = True  # motion blur over the exposure
    depth_noise: bool = True  # errors and holes of stereo matching; off: exact, in mm
    imu_noise: bool = True
    imu_bias: bool = True
    imu_limits: bool = True  # saturation and digits
    vibration: float = 0.0  # m/s^2, rms of each axis: a machine's, at 70 to 220 Hz
    knocks: float = 0.0  # m/s^2 of a knock, as by tiles or heels
    knock_every_s: float = 1.0  # mean time between knocks
    lamp_every_s: float = 0.0  # mean time between switchings of a lamp; 0: none
    lamp_stops: float = 1.5  # largest change of light by a switching, as a power of two
    drops: float = 0.0  # share of frames that are lost
    drop_burst: float = 1.0  # mean number of frames lost together
    jitter_ms: float = 0.0  # sigma of a picture's stamp
    imu_jitter_ms: float = 0.0  # sigma of an IMU sample's stamp
    time_offset_ms: float = 0.0
    camera_phase_ms: float = 0.0  # pictures are taken, and stamped, this much later
    clock_offset_ms: float = 0.0
    clock_drift_ppm: float = 0.0
    wrap: bool = False  # stamps wrap as the device's counter does, if it does

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value, kind = getattr(self, field.name), _field_type(field)
            if type(value) is not kind and not (kind is float and type(value) is int):
                raise UsageError(f"effect {field.name}: expected {_TYPE_NAMES[kind]}, found {value!r}")
            if kind is float and not math.isfinite(value):
                raise UsageError(f"effect {field.name}: {value} is not finite")
        for name, (low, high) in _LIMITS.items():
            if not low <= getattr(self, name) <= high:
                raise UsageError(f"effect {name}: {getattr(self, name):g} must lie in {low:g} .. {high:g}")


def _field_type(field: dataclasses.Field[Any]) -> type[bool] | type[float]:
    return bool if isinstance(field.default, bool) else float


_TYPE_NAMES: dict[type, str] = {bool: "on or off", float: "a number"}
_LIMITS: dict[str, tuple[float, float]] = {
    "lamp_every_s": (0, 1e6),
    "lamp_stops": (0, 6),
    "drops": (0, 0.9),
    "drop_burst": (1, 20),
    "jitter_ms": (0, 20),
    "imu_jitter_ms": (0, 20),
    "time_offset_ms": (-1000, 1000),
    "camera_phase_ms": (0, 1000),
    "vibration": (0, 50),
    "knocks": (0, 100),
    "knock_every_s": (0.05, 1e6),
    "clock_offset_ms": (-1e12, 1e12),
    "clock_drift_ppm": (-1000, 1000),
}
NO_EFFECTS = Effects(**{f.name: False for f in dataclasses.fields(Effects) if f.default is True})


def parse_effects(words: Iterable[str]) -> Effects:
    """Return the usual effects with changes such as "noise=off", "drops=0.02", "time_offset_ms=-8" and "none"
    (a perfect device, then the words that follow). Raises UsageError with the word and the known ones."""
    effects = Effects()
    for word in words:
        if word == "none":
            effects = NO_EFFECTS
            continue
        name, _, text = word.partition("=")
        effects = dataclasses.replace(effects, **{name: _parse_value(name, text)})  # type: ignore[arg-type]
    return effects


def _parse_value(name: str, text: str) -> bool | float:
    kinds = {field.name: _field_type(field) for field in dataclasses.fields(Effects)}
    if name not in kinds:
        near = difflib.get_close_matches(name, kinds, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"known: none, {', '.join(kinds)}"
        raise UsageError(f"effect '{name}' is not known; {hint}")
    if kinds[name] is bool:
        if text not in _SWITCH_VALUES:
            raise UsageError(f"effect {name}: expected {name}=on or {name}=off, found '{text}'")
        return _SWITCH_VALUES[text]
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"effect {name}: expected a number, found '{text}'") from None


_SWITCH_VALUES = {"on": True, "off": False}
