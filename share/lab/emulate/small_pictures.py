"""A device's profile with smaller pictures than the device has, for quick experiments."""

from __future__ import annotations

import yaml

from share.errors import UsageError
from share.files.writing import atomic_write, writable_dir
from share.lab.emulate.session import default_cache
from share.sensors.profile import shipped_profiles

_DEVICE, _FULL = "d435i", (640, 480)


def profile_of_mode(mode: str) -> str:
    """Return a D435i with pictures of a mode, `WxH@HZ`: its own, or a file in the user's cache with the view
    of 640x480 scaled. Raises UsageError."""
    size, _, rate = mode.partition("@")
    width, _, height = size.partition("x")
    if not (width.isdecimal() and height.isdecimal() and rate.isdecimal()):
        raise UsageError(f"--mode {mode}: expected WxH@HZ such as 320x240@15")
    if (int(width), int(height)) == _FULL:
        return f"{_DEVICE}:{mode}"
    scale = int(height) / _FULL[1]
    profile = yaml.safe_load(shipped_profiles()[_DEVICE].read_text())
    full = next(one for one in profile["device"]["modes"] if (one["width"], one["height"]) == _FULL)
    fx, fy, cx, cy = full["cam0"]["intrinsics"]
    across = (int(width) - scale * _FULL[0]) / 2  # a narrower picture is cut from the middle
    lens = [scale * fx, scale * fy, scale * (cx + 0.5) - 0.5 + across, scale * (cy + 0.5) - 0.5]
    cameras = {name: {"intrinsics": [round(value, 3) for value in lens]} for name in ("cam0", "cam1")}
    scaled = {"width": int(width), "height": int(height), "rates_hz": [int(rate)], **cameras}
    profile["device"] |= {"modes": [scaled], "default_mode": mode}
    file = writable_dir(default_cache()) / f"{_DEVICE}-{mode}.yaml"
    atomic_write(file, yaml.safe_dump(profile))
    return str(file)
