"""Load firmware profiles: one YAML file per sensor and host, shipped in firmware_profiles/ or the user's."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

from share.errors import ConfigError
from share.files.yaml_file import Section, read_yaml
from share.plain_data import MAX_NUMBER, from_mapping
from share.sensors.profile_types import (
    CameraMode,
    DeviceFacts,
    EmulatorModel,
    HostFacts,
    InertialFacts,
    Profile,
)


@dataclass(frozen=True, eq=False)
class _ProfileFile:
    """The top level of a profile file. role: of the computer: ar, robot, edge; "" for any."""

    name: str
    host: HostFacts
    device: DeviceFacts | None = None
    emulation: EmulatorModel | None = None
    role: str = ""

    def __post_init__(self) -> None:
        if self.role not in _ROLES:
            raise ValueError(f"role: '{self.role}' is not one of {', '.join(_ROLES[1:])}")
        if (self.device is None) != (self.emulation is None):
            raise ValueError("device and emulation: give both, neither, or the name of a shipped device")


_ROLES = ("", "ar", "robot", "edge")


@dataclass(frozen=True, eq=False)
class HostProfile:
    """The settings of one computer. sensor: the device plugged into it; None for an edge."""

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
    """Load a shipped profile by name (`d435i`, `euroc`), or a file (ends in .yaml or contains a `/`).

    mode: "640x480@30", or "640x480" for that mode's first rate; default: the file's. gyro_hz, accel_hz:
    another rate that the device offers. Raises ConfigError that lists the valid choices.
    """
    path = _find_file(str(name_or_file))
    file = _read_file(path)
    if file.device is None or file.emulation is None:
        raise ConfigError(f"profile '{file.name}' has no device; give one with a device, such as d435i")
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
    """Load the profile of a computer, with its device if it has one. Raises ConfigError."""
    file = _read_file(_find_file(str(name_or_file)))
    sensor = None if file.device is None else load_profile(name_or_file)
    return HostProfile(file.name, file.role, file.host, sensor)


def _read_file(path: Path) -> _ProfileFile:
    """Read a profile file. A `device` given by name takes device and emulation of that shipped profile."""
    top = read_yaml(path)
    if isinstance(name := top.data.get("device"), str):
        if "emulation" in top:
            raise ConfigError(f"{path}: emulation: device '{name}' has its own; leave one of them out")
        base = read_yaml(shipped_profiles()[name]) if name in shipped_profiles() else Section({}, "")
        if not isinstance(base.data.get("device"), dict):
            raise ConfigError(
                f"{path}: device: '{name}' is not a shipped profile with a device, such as d435i"
            )
        top = Section(top.data | {key: base.section(key).data for key in ("device", "emulation")}, top.where)
    return from_mapping(_ProfileFile, top.data, top.where, lowest=-MAX_NUMBER)


def shipped_profiles() -> dict[str, Path]:
    """Return the files of the shipped profiles, by name. Raises ConfigError if the folder is missing."""
    for folder in _profile_folders():
        profiles = {path.stem: path for path in sorted(folder.glob("*.yaml"))}
        if profiles:
            return profiles
    raise ConfigError(
        "the folder firmware_profiles is missing from this installation; give a profile's file instead"
    )


def _profile_folders() -> list[Path]:
    """Return where the folder may be: in a frozen bundle, the source tree, or a wheel (package or data)."""
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
    """Return the mode and rate that `text` names. Raises ValueError."""
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
