"""State of this machine's chronyd, and the configuration that makes one follow a server."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass

from share.errors import DataError
from share.net.udp import HostPort

_LOCAL_REFERENCE = "7F7F0101"  # reference id of a chronyd that follows its local clock
_FIELDS = 14  # of `chronyc -c tracking`, chrony 2.2 and later
_TIMEOUT_S = 10.0


@dataclass(frozen=True)
class ChronyTracking:
    """Output of `chronyc tracking`. offset_s: reference clock minus this one. rms_s: of that over recent
    updates. delay_s, dispersion_s: root delay and dispersion. source: its reference, may be empty.
    synchronised: it follows a reference. local: the reference is its own clock."""

    source: str
    synchronised: bool
    local: bool
    stratum: int
    offset_s: float
    rms_s: float
    delay_s: float
    dispersion_s: float

    @property
    def uncertainty_s(self) -> float:
        """Largest error of the offset: half the root delay plus the root dispersion (chronyc(1),
        tracking)."""
        return self.delay_s / 2 + self.dispersion_s


def read_tracking() -> ChronyTracking | None:
    """Ask chronyd; None if none runs. Raises DataError for output that cannot be parsed."""
    try:
        result = subprocess.run(
            ["chronyc", "-c", "tracking"], capture_output=True, text=True, timeout=_TIMEOUT_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return parse_tracking(result.stdout) if result.returncode == 0 else None


def parse_tracking(text: str) -> ChronyTracking:
    """Parse the line that `chronyc -c tracking` prints. Raises DataError."""
    row = text.strip().split(",")
    try:
        if len(row) < _FIELDS:
            raise ValueError(f"{len(row)} fields, expected {_FIELDS}")
        offset_s, _last, rms_s = (float(cell) for cell in row[4:7])
        delay_s, dispersion_s = float(row[10]), float(row[11])
        stratum = int(row[2])
    except ValueError as error:
        raise DataError(f"chronyc -c tracking: cannot be parsed ({error}): {text.strip()!r}") from None
    synchronised, local = row[13] != "Not synchronised", row[0].upper() == _LOCAL_REFERENCE
    return ChronyTracking(row[1], synchronised, local, stratum, offset_s, rms_s, delay_s, dispersion_s)


def follow_lines(server: HostPort) -> list[str]:
    """Return the lines of chrony.conf that make a machine follow `server`: polled every 1 to 16 s, stepped
    only at the start if more than 10 ms off. `prefer trust`, because the internet servers of chrony's
    packages would outvote the room's server."""
    return [
        f"server {server.name} port {server.port} iburst minpoll 0 maxpoll 4 prefer trust",
        "makestep 0.01 3",
        "rtcsync",
    ]
