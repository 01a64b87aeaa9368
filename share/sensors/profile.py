"""Firmware profiles: one YAML file per sensor and host, shipped in firmware_profiles/ or one's own."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

from share.errors import ConfigError
from share.files.yaml_file import Section, read, read_yaml
from share.sensors.profile_types import DeviceFacts, Emulation, HostFacts, Inertial, Mode, Profile


@dataclass(frozen=True, eq=False)
class _File:
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


def profile(
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
    path = _path(str(name_or_file))
    file = _read(path)
    if file.device is None or file.emulation is None:
        raise ConfigError(f"profile '{file.name}' has no device; give one that has, such as d435i")
    try:
        chosen, rate_hz = _mode(file.device, mode or file.device.default_mode)
        imu = file.device.imu
        imu = replace(imu, gyro=_at(imu.gyro, gyro_hz, "gyro"), accel=_at(imu.accel, accel_hz, "accel"))
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None
    return Profile(
        file.name, replace(file.device, imu=imu), file.host, file.emulation, mode=chosen, rate_hz=rate_hz
    )


def host_profile(name_or_file: str | Path) -> HostProfile:
    """A profile as that of a computer, with its device if it has one. Raises ConfigError."""
    file = _read(_path(str(name_or_file)))
    sensor = None if file.device is None else profile(name_or_file)
    return HostProfile(file.name, file.role, file.host, sensor)


def _read(path: Path) -> _File:
    """A `device` that is a name stands for the device and the emulation of that shipped profile."""
    top = read_yaml(path)
    if isinstance(name := top.data.get("device"), str):
        if "emulation" in top:
            raise ConfigError(f"{path}: emulation: comes with device '{name}'; leave one of them out")
        of = read_yaml(shipped()[name]) if name in shipped() else Section({}, "")
        if not isinstance(of.data.get("device"), dict):
            raise ConfigError(
                f"{path}: device: '{name}' is no shipped profile that describes one, such as d435i"
            )
        top = Section(top.data | {key: of.section(key).data for key in ("device", "emulation")}, top.where)
    return read(_File, top)


def shipped() -> dict[str, Path]:
    """The profiles that come with SHARE, by name. Raises ConfigError where the folder is missing."""
    for folder in _folders():
        found = {path.stem: path for path in sorted(folder.glob("*.yaml"))}
        if found:
            return found
    raise ConfigError(
        "the folder firmware_profiles is missing from this installation; give a profile's file instead"
    )


def _folders() -> list[Path]:
    """In a frozen bundle, in the source tree, in a wheel (beside the package, and as its data)."""
    package = Path(__file__).resolve().parents[1]
    bundle = getattr(sys, "_MEIPASS", None)
    roots = ([Path(bundle)] if bundle else []) + [
        package.parent,
        package,
        Path(sys.prefix) / "share" / "share-slam",
    ]
    return [root / "firmware_profiles" for root in roots]


def _path(name: str) -> Path:
    if name.endswith((".yaml", ".yml")) or "/" in name:
        if not Path(name).is_file():
            raise ConfigError(f"{name}: no such profile file")
        return Path(name)
    known = shipped()
    if name not in known:
        raise ConfigError(f"profile '{name}' is not known; known: {', '.join(known)}, or give a .yaml file")
    return known[name]


def _mode(device: DeviceFacts, text: str) -> tuple[Mode, float]:
    """The mode and rate that `text` names."""
    size, _, rate = text.partition("@")
    for mode in device.modes:
        if size == f"{mode.width}x{mode.height}":
            for hz in mode.rates_hz:
                if not rate or rate == f"{hz:g}":
                    return mode, hz
    known = (f"{m.width}x{m.height}@{'/'.join(f'{hz:g}' for hz in m.rates_hz)}" for m in device.modes)
    raise ValueError(f"mode '{text}' is not known; known: {', '.join(known)}")


def _at(sensor: Inertial, hz: float | None, name: str) -> Inertial:
    try:
        return sensor if hz is None else replace(sensor, rate_hz=hz)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
