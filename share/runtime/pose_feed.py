"""Live poses for another program, JSON of one frame in each message (docs/do/integrate.md).

By UDP to one address: no receiver is needed, and a slow one cannot delay the agent, as lost datagrams are
not resent. By WebSocket to all that connect: each gets the newest message that it has time for.
"""

from __future__ import annotations

import contextlib
import json
import logging
import re
import socket
import struct
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from share.errors import ShareError, UsageError, install_hint
from share.geometry.se3 import quat_from_matrix
from share.net.transport import bind_error
from share.net.udp import HostPort, parse_host, resolve
from share.runtime.pose import Pose, PoseSink
from share.types import F64, TrackState

if TYPE_CHECKING:
    from websockets.sync.server import ServerConnection

SCHEMA = 3  # 3: velocity, covariances; all keys of 2 are as they were
DEFAULT_PORT = 5570
UDP, WEBSOCKET = "udp://", "ws://"
_DIGITS = 9  # 1 nm
_UPPER = np.triu_indices(6)
_ROS_ORDER = [3, 4, 5, 0, 1, 2]  # translation before rotation


class PoseFeed:
    """Sends poses to one address by UDP. Raises UsageError for a malformed address or an unknown host."""

    def __init__(self, address: str, agent: str) -> None:
        if not address.startswith(UDP):
            raise UsageError(
                f"--poses {address}: expected udp://HOST:PORT or ws://HOST:PORT, "
                f"such as udp://127.0.0.1:{DEFAULT_PORT}"
            )
        self.host: HostPort = parse_host(address.removeprefix(UDP), DEFAULT_PORT)
        family, self._target = resolve(self.host)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._messages = PoseMessages(agent)

    def publish(self, pose: Pose) -> None:
        self._send(self._messages.of_pose(pose))

    def publish_state(self, stamp_ns: int, state: TrackState, age_ms: float | None = None) -> None:
        self._send(self._messages.of_state(stamp_ns, state, age_ms))

    def _send(self, text: str) -> None:
        with contextlib.suppress(OSError):  # no network, a full buffer: the next one is newer
            self._socket.sendto(text.encode(), self._target)

    def close(self) -> None:
        self._socket.close()


class PoseMessages:
    """Numbers an agent's poses and writes them as JSON."""

    def __init__(self, agent: str) -> None:
        self._agent, self._sequence = agent, 0

    def of_pose(self, pose: Pose) -> str:
        odom = _pose_fields(pose.T_odom_body, pose.cov)
        odom |= {"velocity": _rounded(pose.velocity), "angular_velocity": _rounded(pose.angular_velocity)}
        in_map = None if pose.T_map_body is None else _pose_fields(pose.T_map_body, pose.map_cov)
        places = pose.segment, odom, in_map, pose.map_id
        return self._message(pose.stamp_ns, pose.state, pose.age_ms, *places, pose.is_connected)

    def of_state(self, stamp_ns: int, state: TrackState, age_ms: float | None = None) -> str:
        """Return the message of a frame without a pose."""
        return self._message(stamp_ns, state, age_ms)

    def _message(
        self,
        stamp_ns: int,
        state: str,
        age_ms: float | None,
        segment: int | None = None,
        odom: dict[str, Any] | None = None,
        in_map: dict[str, Any] | None = None,
        map_id: str | None = None,
        is_connected: bool | None = None,
    ) -> str:
        message = {
            "schema": SCHEMA,
            "agent": self._agent,
            "sequence": self._sequence,
            "stamp_ns": stamp_ns,
            "age_ms": None if age_ms is None else round(age_ms, 3),
            "state": state,
            "segment": segment,
            "odom": odom,
            "map": in_map,
            "map_id": map_id,
            "edge": is_connected,
        }
        self._sequence += 1
        return json.dumps(message, separators=(",", ":"))


def open_pose_sinks(addresses: Sequence[str], agent: str, origins: Sequence[str] = ()) -> list[PoseSink]:
    """Return what sends poses by UDP to each udp:// address, or serves them at each ws:// one.

    origins: web pages that may read the latter. Raises UsageError, ShareError without the extra for
    WebSocket, TransportError if a port is in use.
    """
    if origins and not any(address.startswith(WEBSOCKET) for address in addresses):
        raise UsageError("--poses-origin works only with --poses ws://HOST:PORT; leave it out")
    sinks: list[PoseSink] = []
    try:
        for address in addresses:
            sinks.append(_open_pose_sink(address, agent, origins))
    except ShareError:
        for sink in sinks:
            sink.close()
        raise
    return sinks


def _open_pose_sink(address: str, agent: str, origins: Sequence[str]) -> PoseSink:
    if not address.startswith(WEBSOCKET):
        return PoseFeed(address, agent)
    from share.runtime.pose_feed import PoseWebSocket

    return PoseWebSocket(address, agent, origins)


def _pose_fields(T: F64, cov: F64 | None) -> dict[str, Any]:
    position, rotation = T[:3, 3].round(_DIGITS).tolist(), quat_from_matrix(T[:3, :3]).round(_DIGITS).tolist()
    covariance = None if cov is None else _upper_triangle(fixed_axes_cov(T, cov))
    return {"position": position, "quaternion": rotation, "covariance": covariance}


def fixed_axes_cov(T: F64, cov: F64) -> F64:
    """Return a covariance (6, 6) in ROS's form (geometry_msgs/PoseWithCovariance): translation before
    rotation, both about the axes of the frame in which the pose `T` (4, 4) is given.

    cov (6, 6): of `T`, rotation before translation, perturbed on the right.
    """
    R = np.kron(np.eye(2), T[:3, :3])
    out: F64 = (R @ cov @ R.T)[np.ix_(_ROS_ORDER, _ROS_ORDER)]
    return out


def _upper_triangle(cov: F64) -> list[float]:
    """Return the 21 numbers on and above the diagonal, row by row, with four digits."""
    return [float(f"{value:.3e}") for value in cov[_UPPER].tolist()]


def _rounded(vector: F64 | None) -> list[float] | None:
    return None if vector is None else [round(value, 6) for value in vector.tolist()]


MAX_READERS = 16  # at once; more are refused
_MAX_RECEIVED_BYTES = 1024  # of a message from a reader, which none needs to send
_CLOSE_S = 1.0
_SEND_TIMEOUT = struct.pack("@ll", 5, 0)  # s, us: after that a reader that does not read is disconnected
_TRY_LATER = 1013  # RFC 6455, section 11.7


class PoseWebSocket:
    """Serves poses by WebSocket (RFC 6455) at ws://HOST:PORT until closed, for web pages and engines.

    A thread for each reader sends the newest message and leaves out those that it has no time for, so a slow
    or silent reader delays neither the agent nor another reader.

    origins: web pages that may read them, such as https://app.example; others are refused, except those of
    this machine (localhost). A program that is no browser sends none and may. Raises UsageError, ShareError
    without the package, TransportError if the port is in use.
    """

    def __init__(self, address: str, agent: str, origins: Sequence[str] = ()) -> None:
        try:
            from websockets.sync.server import serve
        except ImportError:
            raise ShareError(install_hint("websockets", "websocket")) from None
        if bad := [one for one in origins if not re.fullmatch(r"https?://[^/\s]+", one)]:
            raise UsageError(
                f"--poses-origin {bad[0]}: expected a page's origin, such as https://app.example"
            )
        host = parse_host(address.removeprefix(WEBSOCKET), DEFAULT_PORT, bind=True)
        self._messages = PoseMessages(agent)
        self._changed, self._newest, self._number = threading.Condition(), "", 0
        self._is_closed, self._readers = False, set[Any]()
        allowed = [None, re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?"), *origins]
        try:
            self._server = serve(
                self._serve_reader,
                host.name,
                host.port,
                origins=allowed,
                compression=None,
                max_size=_MAX_RECEIVED_BYTES,
                logger=_silent_logger(),
            )
        except OSError as error:
            raise bind_error(host, error.errno, error.strerror or str(error), "server") from None
        self.host = HostPort(host.name, int(self._server.socket.getsockname()[1]))
        self._thread = threading.Thread(target=self._server.serve_forever, name="poses", daemon=True)
        self._thread.start()

    def publish(self, pose: Pose) -> None:
        self._show(self._messages.of_pose(pose))

    def publish_state(self, stamp_ns: int, state: TrackState, age_ms: float | None = None) -> None:
        self._show(self._messages.of_state(stamp_ns, state, age_ms))

    def close(self) -> None:
        """Disconnect all readers and free the port."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
            readers = list(self._readers)
        self._server.shutdown()
        for reader in readers:  # one that does not read would hold its thread up
            with contextlib.suppress(OSError):
                reader.socket.shutdown(socket.SHUT_RDWR)
        self._thread.join(timeout=_CLOSE_S)

    def _show(self, text: str) -> None:
        with self._changed:
            self._newest, self._number = text, self._number + 1
            self._changed.notify_all()

    def _serve_reader(self, connection: ServerConnection) -> None:
        """Send the newest message again and again, in this reader's own thread, until either end closes."""
        from websockets.exceptions import ConnectionClosed

        connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _SEND_TIMEOUT)
        with self._changed:
            sent, is_welcome = self._number, len(self._readers) < MAX_READERS
            self._readers.add(connection)
        try:
            if not is_welcome:
                connection.close(_TRY_LATER, f"{MAX_READERS} readers already")
            with contextlib.suppress(ConnectionClosed, OSError):
                while is_welcome and (message := self._next_message(sent)) is not None:
                    text, sent = message
                    connection.send(text)
        finally:
            with self._changed:
                self._readers.discard(connection)

    def _next_message(self, sent: int) -> tuple[str, int] | None:
        """Return the newest message and its number, once it is newer than number `sent`; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._number > sent or self._is_closed)
            return None if self._is_closed else (self._newest, self._number)


def _silent_logger() -> logging.Logger:
    """Return a logger for failed handshakes that prints nothing: anybody can cause them."""
    logger = logging.Logger("share.poses")
    logger.addHandler(logging.NullHandler())
    return logger
