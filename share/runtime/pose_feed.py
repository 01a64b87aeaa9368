"""Live poses for another program, JSON of one frame in each message (docs/do/integrate.md).

By UDP to one address: no receiver is needed, and a slow one cannot delay the agent, as lost datagrams are
not resent. By WebSocket to all that connect: each gets the newest message that it has time for.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import socket
import sys
import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from share.errors import ShareError, UsageError, install_hint
from share.geometry.se3 import quat_from_matrix
from share.net.transport import bind_error
from share.net.udp import HostPort, parse_host, resolve
from share.runtime.pose import Pose, PoseSink
from share.types import F64, TrackState

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

SCHEMA = 3  # 3: velocity, covariances; all keys of 2 are as they were
DEFAULT_PORT = 5570
UDP, WEBSOCKET = "udp://", "ws://"
_DIGITS = 9  # 1 nm
_UPPER = np.triu_indices(6)
_LOCAL_ORIGIN = r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?"
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
        return json.dumps(message, separators=(",", ":"), ensure_ascii=False)  # \u is six bytes a letter


def _print_error(text: str) -> None:
    print(text, file=sys.stderr)


def open_pose_sinks(
    addresses: Sequence[str],
    agent: str,
    origins: Sequence[str] = (),
    notify: Callable[[str], None] = _print_error,
) -> list[PoseSink]:
    """Return what sends poses by UDP to each udp:// address, or serves them at each ws:// one.

    origins: web pages that may read the latter. notify: as in `PoseWebSocket`. Raises UsageError, ShareError
    without the extra for WebSocket, TransportError if a port is in use.
    """
    if origins and not any(address.startswith(WEBSOCKET) for address in addresses):
        raise UsageError("--poses-origin works only with --poses ws://HOST:PORT; leave it out")
    sinks: list[PoseSink] = []
    try:
        for address in addresses:
            sinks.append(_open_pose_sink(address, agent, origins, notify))
    except ShareError:
        for sink in sinks:
            sink.close()
        raise
    return sinks


def _open_pose_sink(
    address: str, agent: str, origins: Sequence[str], notify: Callable[[str], None]
) -> PoseSink:
    if not address.startswith(WEBSOCKET):
        return PoseFeed(address, agent)
    return PoseWebSocket(address, agent, origins, notify)


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


MAX_READERS = 16  # at once; for one more see `share.net.bounded_websocket`
OWN_READERS = 4  # of these, places that only programs of this machine get: engines run beside the agent
_MAX_RECEIVED_BYTES = 1024  # of a message from a reader, which none needs to send
_MAX_WAITING = 32  # connections that are not served yet
_BACKLOG = 128  # connections that the kernel holds; more would wait for seconds
_CLOSE_S = 1.0
_SEND_S = 5.0  # after that a reader that does not read is disconnected
_LOOK_S = 1.0  # between checks for readers that have gone, while there is no message
_UNSENT_BYTES = 4096  # of a reader that does not read; newer messages are left out
_SLEEP_RATIO = 9.0  # the server's thread uses at most a tenth of a core


class PoseWebSocket:
    """Serves poses by WebSocket (RFC 6455) at ws://HOST:PORT until closed, for web pages and engines.

    One thread serves all. It sends the newest message to each reader and leaves out those that it has no
    time for, so a slow or silent reader delays neither the agent nor another reader; one that sends more than
    a few messages a second is disconnected.

    origins: web pages that may read them, such as https://app.example; others are refused, except those of
    this machine (localhost). A program that is no browser sends none and may. notify: called once with a
    line, from the server's thread, if this process has no file descriptors left for readers. Raises
    UsageError, ShareError without the package, TransportError if the port is in use.
    """

    def __init__(
        self,
        address: str,
        agent: str,
        origins: Sequence[str] = (),
        notify: Callable[[str], None] = _print_error,
    ) -> None:
        try:
            from share.net.bounded_websocket import (
                BoundedListener,
                ModestSelector,
                PeerConnections,
                PeerLimits,
            )
        except ImportError:
            raise ShareError(install_hint("websockets", "websocket")) from None
        if bad := [one for one in origins if not re.fullmatch(r"https?://[^/\s]+", one)]:
            raise UsageError(
                f"--poses-origin {bad[0]}: expected a page's origin, such as https://app.example"
            )
        host = parse_host(address.removeprefix(WEBSOCKET), DEFAULT_PORT, bind=True)
        self._messages = PoseMessages(agent)
        self._newest = 0, ""  # number and text
        self._is_closed, self._has_reported_shortage, self._readers = False, False, set[Any]()
        self._allowed: list[Any] = [None, re.compile(_LOCAL_ORIGIN), *origins]
        self._notify = notify
        family = socket.AF_INET6 if ":" in host.name else socket.AF_INET
        try:
            listener = socket.create_server((host.name, host.port), family=family)
        except OSError as error:
            raise bind_error(host, error.errno, error.strerror or str(error), "server") from None
        self.host = HostPort(host.name, int(listener.getsockname()[1]))
        # a page's request has some kB; a reader then sends an answer to a ping now and then
        limits = PeerLimits(MAX_READERS, _MAX_WAITING, 20, 2.0, 2**14, 2**10, OWN_READERS)
        self.peer_connections = PeerConnections(limits)
        self._listener = BoundedListener(listener, self.peer_connections)
        self._loop = asyncio.SelectorEventLoop(ModestSelector(_SLEEP_RATIO))
        self._loop.set_exception_handler(self._take_loop_error)
        self._new_message = asyncio.Event()  # replaced at each message
        self._thread = threading.Thread(target=self._run, name="poses", daemon=True)
        self._thread.start()

    def publish(self, pose: Pose) -> None:
        self._show(self._messages.of_pose(pose))

    def publish_state(self, stamp_ns: int, state: TrackState, age_ms: float | None = None) -> None:
        self._show(self._messages.of_state(stamp_ns, state, age_ms))

    def close(self) -> None:
        """Disconnect all readers and free the port."""
        self._is_closed = True
        self._wake()
        self._thread.join(timeout=3 * _CLOSE_S)

    def _show(self, text: str) -> None:
        self._newest = self._newest[0] + 1, text
        if self._readers:
            self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._signal_new_message)

    # ------------------------------------------------------------------ the server's thread

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()
            self._listener.close()

    async def _serve(self) -> None:
        from share.net.bounded_websocket import serve_bounded

        server = await serve_bounded(
            self._serve_reader,
            self._listener,
            origins=self._allowed,
            max_size=_MAX_RECEIVED_BYTES,
            write_limit=_UNSENT_BYTES,
            close_timeout=_CLOSE_S,
            process_request=self._refuse_excess,
        )
        self._listener.listen(_BACKLOG)
        while not self._is_closed:
            await self._new_message.wait()
        server.close()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_CLOSE_S):
                await server.wait_closed()
        self.peer_connections.abort_all()
        await server.wait_closed()

    def _signal_new_message(self) -> None:
        self._new_message.set()
        if not self._is_closed:
            self._new_message = asyncio.Event()

    def _refuse_excess(self, connection: Any, _request: Any) -> Any:
        if self.peer_connections.admit(connection):
            return None
        return connection.respond(503, f"{MAX_READERS} readers already\n")

    async def _serve_reader(self, connection: ServerConnection) -> None:
        """Send the newest message again and again until either end closes."""
        from websockets.exceptions import ConnectionClosed
        from websockets.protocol import State

        self._readers.add(connection)
        sent, _ = self._newest
        try:
            with contextlib.suppress(ConnectionClosed):
                while not self._is_closed and connection.state is State.OPEN:
                    if self._newest[0] == sent:
                        await self._wait_for_new_message()
                        continue
                    sent, text = self._newest
                    async with asyncio.timeout(_SEND_S):
                        await connection.send(text)
        except TimeoutError:
            connection.transport.abort()
        finally:
            self._readers.discard(connection)

    async def _wait_for_new_message(self) -> None:
        """Wait for a message, but not so long that a reader that has gone is kept."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_LOOK_S):
                await self._new_message.wait()

    def _take_loop_error(self, _loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Say once that there are no file descriptors left; the loop goes on accepting after a second."""
        if isinstance(context.get("exception"), OSError) and not self._has_reported_shortage:
            self._has_reported_shortage = True
            self._notify(
                f"poses at ws://{self.host}: no new reader for now: {context['exception'].strerror}; "
                "raise `ulimit -n`, or close what is open"
            )
