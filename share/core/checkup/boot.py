"""What a computer is set to at every start: lines of systemd-tmpfiles, tmpfiles.d(5)."""

from __future__ import annotations

FILE = "/etc/tmpfiles.d/share.conf"
_GOVERNOR = "/sys/devices/system/cpu/cpufreq/policy*/scaling_governor"
_USB_MEMORY = "/sys/module/usbcore/parameters/usbfs_memory_mb"


def lines(cpu_governor: str, usbfs_mb: int) -> tuple[str, ...]:
    """None of what is "" or 0, which is left as it is."""
    wanted = {_GOVERNOR: cpu_governor, _USB_MEMORY: str(usbfs_mb or "")}
    return tuple(f"w {path} - - - - {value}" for path, value in wanted.items() if value)


def mend(cpu_governor: str, usbfs_mb: int) -> tuple[str, ...]:
    """What sets both, now and at every start: `tools/deploy` writes the same file."""
    quoted = " ".join(f"'{line}'" for line in lines(cpu_governor, usbfs_mb))
    return f"printf '%s\\n' {quoted} | sudo tee {FILE}", f"sudo systemd-tmpfiles --create {FILE}"
