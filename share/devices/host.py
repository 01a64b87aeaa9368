"""Facts of this computer from Linux: what this process may use of it, processor, USB, udev rules, disk,
libraries.

Missing facts are None or empty: containers and virtual machines show little. root: a test can pass a tree.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import socket
from pathlib import Path

from share.devices.camera_check import UsbCamera

_VENDOR, _D435I = "8086", "0b3a"
_RULE_FOLDERS = ("etc/udev/rules.d", "lib/udev/rules.d", "usr/lib/udev/rules.d")
_CPUS = "sys/devices/system/cpu/cpu[0-9]*"
_NATIVE_LIBRARIES = ("numpy", "cv2", "scipy.linalg", "zmq", "onnxruntime")
_OPTIONAL_LIBRARIES = ("poselib",)  # share.geometry.absolute_pose also works without it


def core_count() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def free_memory_bytes(proc: Path = Path("/proc"), cgroups: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Return the memory that this process may still take: the machine's available memory, or less where a
    control group (container, systemd unit) has a limit. None if unknown."""
    candidates = [
        free
        for free in (_available_bytes(proc / "meminfo"), *_free_in_cgroups(proc, cgroups))
        if free is not None
    ]
    return min(candidates, default=None)


def governors(root: Path = Path("/")) -> list[str]:
    """Return the CPU governor of each core."""
    return [text for path in root.glob(f"{_CPUS}/cpufreq/scaling_governor") if (text := _read_text(path))]


def throttle_counts(root: Path = Path("/")) -> list[int]:
    """Return how often heat slowed each core since the start (Intel only: core_throttle_count)."""
    files = root.glob(f"{_CPUS}/thermal_throttle/core_throttle_count")
    return [count for path in files if (count := _read_int(path)) is not None]


def hottest_celsius(root: Path = Path("/")) -> float | None:
    """Return the temperature of the hottest sensor of the processor and the board."""
    readings = [_read_int(path) for path in root.glob("sys/class/thermal/thermal_zone*/temp")]
    return max((value / 1000 for value in readings if value is not None), default=None)


def pi_throttled_bits(root: Path = Path("/")) -> int | None:
    """Return a Raspberry Pi's supply and heat bits as `vcgencmd get_throttled`; None on other computers. A
    kernel that is not the Pi's own shows the supply alone (rpi_volt)."""
    for path in root.glob("sys/devices/platform/soc*/*firmware*/get_throttled"):
        if re.fullmatch(r"(0x)?[0-9a-fA-F]{1,8}", text := _read_text(path) or ""):
            return int(text, 16)
    for path in root.glob("sys/class/hwmon/hwmon*/in0_lcrit_alarm"):
        if _read_text(path.parent / "name") == "rpi_volt":
            return _read_int(path)
    return None


def is_governor_reset(root: Path = Path("/")) -> bool:
    """Return whether a power-profiles-daemon may run: at each start it sets the governor of processors with
    an energy preference (Intel, AMD) to powersave."""
    unit = "systemd/system/power-profiles-daemon.service"
    masked = os.path.realpath(root / "etc" / unit) == "/dev/null"
    is_installed = any((root / folder / unit).exists() for folder in ("lib", "usr/lib"))
    preference = "sys/devices/system/cpu/cpufreq/policy*/energy_performance_preference"
    return is_installed and not masked and any(root.glob(preference))


def usb_memory_mb(root: Path = Path("/")) -> int | None:
    return _read_int(root / "sys/module/usbcore/parameters/usbfs_memory_mb")


def cameras(root: Path = Path("/")) -> list[UsbCamera] | None:
    """Return all attached D435i by port; None if the system shows no USB devices."""
    folder = root / "sys/bus/usb/devices"
    if not folder.is_dir():
        return None
    return [_read_camera(path, root / "dev/bus/usb") for path in sorted(folder.iterdir()) if _is_d435i(path)]


def camera_rules(root: Path = Path("/")) -> list[str]:
    """Return the udev rule files that match the camera and its IMU."""
    files = [path for folder in _RULE_FOLDERS for path in sorted((root / folder).glob("*.rules"))]
    # By resolved path: /lib may be a link to /usr/lib.
    rule_files = {path.resolve(): path for path in files if _names_camera(_read_text(path) or "")}
    return [f"/{path.relative_to(root)}" for path in rule_files.values()]


def free_disk_bytes(folder: Path) -> tuple[Path, int]:
    """Return the nearest existing folder at or above `folder`, and the free bytes of its disk."""
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    return existing, shutil.disk_usage(existing).free


def is_port_free(port: int) -> bool:
    """Return whether a TCP port is free on all addresses."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # ignore closed connections
        try:
            probe.bind(("", port))
            probe.listen()
        except OSError:
            return False
    return True


def native_libraries() -> dict[str, str | None]:
    """Return the load error of each library, None if it loads; of the optional ones only if installed."""
    installed = [name for name in _OPTIONAL_LIBRARIES if importlib.util.find_spec(name) is not None]
    return {name: _load_error(name) for name in (*_NATIVE_LIBRARIES, *installed)}


def _available_bytes(meminfo: Path) -> int | None:
    lines = meminfo.read_text().splitlines() if meminfo.exists() else []
    match = next((line for line in lines if line.startswith("MemAvailable:")), None)
    return None if match is None else 1024 * int(match.split()[1])


def _free_in_cgroups(proc: Path, cgroups: Path) -> list[int]:
    """Return the free bytes of this process's control group and its ancestors, of those with a limit."""
    cgroup_file = proc / "self" / "cgroup"
    lines = cgroup_file.read_text().splitlines() if cgroup_file.exists() else []
    out = []
    for line in lines:
        _, kinds, name = line.split(":", 2)
        if kinds == "":  # version 2
            root, limit, used = cgroups, "memory.max", "memory.current"
        elif "memory" in kinds.split(","):
            root, limit, used = cgroups / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes"
        else:
            continue
        folder = root / name.lstrip("/")
        while folder.is_relative_to(root):
            max_bytes, used_bytes = _read_int(folder / limit), _read_int(folder / used)
            if max_bytes is not None and used_bytes is not None:
                out.append(max(0, max_bytes - used_bytes))
            if folder == root:
                break
            folder = folder.parent
    return out


def _load_error(name: str) -> str | None:
    try:
        importlib.import_module(name)
    except ImportError as error:  # also a wrong glibc, a missing .so
        return str(error).splitlines()[0]
    return None


def _is_d435i(path: Path) -> bool:
    return (_read_text(path / "idVendor"), _read_text(path / "idProduct")) == (_VENDOR, _D435I)


def _read_camera(path: Path, nodes: Path) -> UsbCamera:
    speed_mbit_s, control = _read_float(path / "speed") or 0.0, _read_text(path / "power/control")
    node = nodes / f"{_read_int(path / 'busnum') or 0:03}" / f"{_read_int(path / 'devnum') or 0:03}"
    may_open = os.access(node, os.R_OK | os.W_OK)
    return UsbCamera(path.name, speed_mbit_s, control, may_open, _may_start_imu(path))


def _may_start_imu(path: Path) -> bool | None:
    switches = list(path.glob(f"{path.name}:*/*/HID-SENSOR-*/iio:device*/scan_elements/*_en"))
    return all(os.access(switch, os.W_OK) for switch in switches) if switches else None


def _names_camera(text: str) -> bool:
    """Return whether udev rules match the D435i and also its IMU (iio), which needs a rule of its own."""
    lines = [line.lower() for line in text.splitlines() if not line.lstrip().startswith("#")]
    named = [line for line in lines if _VENDOR in line and _D435I in line]
    return any("iio" in line for line in named) and any("iio" not in line for line in named)


def _read_text(path: Path) -> str | None:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return None


def _read_float(path: Path) -> float | None:
    """Return the number in a file, None if absent or `unknown` (the speed of a device that is just coming or
    going)."""
    text = _read_text(path) or ""
    return float(text) if re.fullmatch(r"\d+(\.\d+)?", text) else None


def _read_int(path: Path) -> int | None:
    """Return the number in a file, None if absent or no number ("max")."""
    text = _read_text(path)
    return int(text) if text and text.isdecimal() else None
