"""Live poses for another program: one UDP datagram of JSON per frame (docs/do/integrate.md).

No receiver is needed, and a slow one cannot delay the agent: lost datagrams are not resent.
"""

from __future__ import annotations

import contextlib
import json
import socket
from typing import Any

from share.errors import UsageError
from share.geometry.se3 import quat_from_matrix
from share.net.udp import HostPort, parse_host, resolve
from share.types import F64

SCHEMA = 2
_SCHEME = "udp://"
_DEFAULT_PORT = 5570
_DIGITS = 9  # 1 nm


class PoseFeed:
    """Sends poses to one address. Raises UsageError for a malformed address or an unknown host."""

    def __init__(self, address: str, agent: str) -> None:
        if not address.startswith(_SCHEME):
            raise UsageError(
                f"--poses {address}: expected udp://HOST:PORT, such as udp://127.0.0.1:{_DEFAULT_PORT}"
            )
        self.host: HostPort = parse_host(address.removeprefix(_SCHEME), _DEFAULT_PORT)
        family, self._target = resolve(self.host)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._agent, self._sequence = agent, 0

    def publish(
        self,
        stamp_ns: int,
        state: str,
        age_ms: float | None = None,
        segment: int | None = None,
        T_odom_body: F64 | None = None,
        T_map_body: F64 | None = None,
        map_id: str | None = None,
    ) -> None:
        """Send one frame's pose. age_ms: time since it arrived in this process. segment: of odometry. Poses
        (4, 4), None where unknown."""
        message = {
            "schema": SCHEMA,
            "agent": self._agent,
            "sequence": self._sequence,
            "stamp_ns": stamp_ns,
            "age_ms": None if age_ms is None else round(age_ms, 3),
            "state": state,
            "segment": segment,
            "odom": _pose_fields(T_odom_body),
            "map": _pose_fields(T_map_body),
            "map_id": None if T_map_body is None else map_id,
        }
        self._sequence += 1
        with contextlib.suppress(OSError):  # no network, a full buffer: the next one is newer
            self._socket.sendto(json.dumps(message).encode(), self._target)

    def close(self) -> None:
        self._socket.close()


def _pose_fields(T: F64 | None) -> dict[str, Any] | None:
    if T is None:
        return None
    position, rotation = T[:3, 3].round(_DIGITS).tolist(), quat_from_matrix(T[:3, :3]).round(_DIGITS).tolist()
    return {"position": position, "quaternion": rotation}
