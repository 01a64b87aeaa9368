"""Firmware profiles: one YAML file per sensor and host, shipped in firmware_profiles/ or one's own."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

from share.errors import ConfigError
from share.files.yaml_file import Section, read_dataclass, read_yaml
from share.sensors.profile_types import CameraMode, DeviceFacts, Emulation, HostFacts, InertialFacts, Profile


@dataclass(frozen=True, eq=False)
class _ProfileFile:
    """The top of a profile file. role: what the computer does: ar, robot, edge; "" where any may."""

    name: str
    host: HostFacts
    device: DeviceFacts | None = None
    emulation: Emulation | None = None
    role: str = ""

    def __post_init__(self) -> None:
        if self.role not in _ROLES:
            raise ValueError(f"role: '{self.role}' is not one of {', '.join(_ROLES[1:])}")
        if (self.device is None) != (self.emulation is None):
            raise ValueError("device and emulation: give both, or neither, or a device by its name")


_ROLES = ("", "ar", "robot", "edge")


@dataclass(frozen=True, eq=False)
class HostProfile:
    """How one computer is to be set. sensor: what is plugged into it; None at an edge."""

    name: str
    role: str
    host: HostFacts
    sensor: Profile | None


def load_profile(
    name_or_file: str | Path,
    mode: str | None = None,
    gyro_hz: float | None = None,
    accel_hz: float | None = None,
) -> Profile:
    """A shipped profile by name (`d435i`, `euroc`) or a file (ends in .yaml or holds a `/`).

    mode: "640x480@30" or "640x480" (then the first rate), default the file's; gyro_hz, accel_hz:
    another of the rates that the device offers. Raises ConfigError in one line that says what is
    known.
    """
    path = _find_file(str(name_or_file))
    file = _read_file(path)
    if file.device is None or file.emulation is None:
        raise ConfigError(f"profile '{file.name}' has no device; give one that has, such as d435i")
    try:
        chosen, rate_hz = _find_mode(file.device, mode or file.device.default_mode)
        imu = file.device.imu
        imu = replace(
            imu, gyro=_with_rate(imu.gyro, gyro_hz, "gyro"), accel=_with_rate(imu.accel, accel_hz, "accel")
        )
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None
    return Profile(
        file.name, replace(file.device, imu=imu), file.host, file.emulation, mode=chosen, rate_hz=rate_hz
    )


def load_host_profile(name_or_file: str | Path) -> HostProfile:
    """A profile as that of a computer, with its device if it has one. Raises ConfigError."""
    file = _read_file(_find_file(str(name_or_file)))
    sensor = None if file.device is None else load_profile(name_or_file)
    return HostProfile(file.name, file.role, file.host, sensor)


def _read_file(path: Path) -> _ProfileFile:
    """A `device` that is a name stands for the device and the emulation of that shipped profile."""
    top = read_yaml(path)
    if isinstance(name := top.data.get("device"), str):
        if "emulation" in top:
            raise ConfigError(f"{path}: emulation: comes with device '{name}'; leave one of them out")
        base = read_yaml(shipped_profiles()[name]) if name in shipped_profiles() else Section({}, "")
        if not isinstance(base.data.get("device"), dict):
            raise ConfigError(
                f"{path}: device: '{name}' is no shipped profile that describes one, such as d435i"
            )
        top = Section(top.data | {key: base.section(key).data for key in ("device", "emulation")}, top.where)
    return read_dataclass(_ProfileFile, top)


def shipped_profiles() -> dict[str, Path]:
    """The profiles that come with SHARE, by name. Raises ConfigError where the folder is missing."""
    for folder in _profile_folders():
        profiles = {path.stem: path for path in sorted(folder.glob("*.yaml"))}
        if profiles:
            return profiles
    raise ConfigError(
        "the folder firmware_profiles is missing from this installation; give a profile's file instead"
    )


def _profile_folders() -> list[Path]:
    """In a frozen bundle, in the source tree, in a wheel (beside the package, and as its data)."""
    package = Path(__file__).resolve().parents[1]
    bundle = getattr(sys, "_MEIPASS", None)
    roots = ([Path(bundle)] if bundle else []) + [
        package.parent,
        package,
        Path(sys.prefix) / "share" / "share-slam",
    ]
    return [root / "firmware_profiles" for root in roots]


def _find_file(name: str) -> Path:
    if name.endswith((".yaml", ".yml")) or "/" in name:
        if not Path(name).is_file():
            raise ConfigError(f"{name}: no such profile file")
        return Path(name)
    known = shipped_profiles()
    if name not in known:
        raise ConfigError(f"profile '{name}' is not known; known: {', '.join(known)}, or give a .yaml file")
    return known[name]


def _find_mode(device: DeviceFacts, text: str) -> tuple[CameraMode, float]:
    """The mode and rate that `text` names."""
    size, _, rate = text.partition("@")
    for mode in device.modes:
        if size == f"{mode.width}x{mode.height}":
            for hz in mode.rates_hz:
                if not rate or rate == f"{hz:g}":
                    return mode, hz
    known = (f"{m.width}x{m.height}@{'/'.join(f'{hz:g}' for hz in m.rates_hz)}" for m in device.modes)
    raise ValueError(f"mode '{text}' is not known; known: {', '.join(known)}")


def _with_rate(sensor: InertialFacts, hz: float | None, name: str) -> InertialFacts:
    try:
        return sensor if hz is None else replace(sensor, rate_hz=hz)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
