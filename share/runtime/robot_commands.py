"""How `share robot goto`, `cancel` and `watch` reach the bridge of their machine: a Unix socket of the same
user.

Lines of JSON. A goal lives as long as its commander's connection: who is gone does not drive.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from share.errors import ShareError, TransportError
from share.files.json_file import parse_json
from share.robot import robot_events as ev
from share.timing import PeriodicTimer

_MAX_LINE_BYTES = 4096
_MAX_CONNECTIONS = 16
_MAX_UNREAD_BYTES = 1 << 16  # of one that does not read; then it is cut off
_WATCH_S = 0.5
_CONNECT_S = 2.0


def command_path(domain: int, namespace: str) -> Path:
    """Return the socket of the bridge of one robot."""
    folder = Path(os.environ.get("XDG_RUNTIME_DIR") or Path.home() / ".config" / "share")
    name = "-".join(["share-robot", str(domain), *namespace.strip("/").split("/")]).rstrip("-")
    return folder / f"{name}.sock"


class _CommandConnection:
    def __init__(self, link: socket.socket, name: str) -> None:
        self.link, self.name = link, name
        self.received, self.unsent = b"", b""
        self.cancel_id = b""  # of its wish to stop the robot
        self.is_watching = self.is_ending = False


class CommandServer:
    """Listens at `path`, readable by this user only. Raises TransportError if another bridge does."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._connections: dict[str, _CommandConnection] = {}
        self._count = 0
        self._watch_timer = PeriodicTimer(_WATCH_S)
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as probe:
                probe.connect(str(path))
                raise TransportError("a bridge of this robot runs already; stop that one first")
            path.unlink()
        self._listener = socket.socket(socket.AF_UNIX)
        before = os.umask(0o177)
        try:
            self._listener.bind(str(path))
        except OSError as error:
            raise TransportError(f"{path}: {error.strerror}") from None
        finally:
            os.umask(before)
        self._listener.listen(_MAX_CONNECTIONS)
        self._listener.setblocking(False)

    def poll(self, goal_id: Callable[[], bytes]) -> list[ev.RobotEvent]:
        """Return what commanders want; never waits. goal_id: makes the id of a goal or a cancellation."""
        self._accept()
        events: list[ev.RobotEvent] = []
        for connection in list(self._connections.values()):
            is_open = self._receive(connection)
            while b"\n" in connection.received:
                line, _, connection.received = connection.received.partition(b"\n")
                if (event := self._event(connection, line, goal_id)) is not None:
                    events.append(event)
            if not is_open or len(connection.received) > _MAX_LINE_BYTES:
                self._drop(connection)
                events.append(ev.CommanderLost(connection.name))
        return events

    def _accept(self) -> None:
        while True:
            try:
                link, _ = self._listener.accept()
            except OSError:
                return
            if len(self._connections) >= _MAX_CONNECTIONS:
                link.close()
                continue
            link.setblocking(False)
            self._count += 1
            name = f"goto {self._count}"
            self._connections[name] = _CommandConnection(link, name)

    def _receive(self, connection: _CommandConnection) -> bool:
        """Read what has come. Return whether the connection is open."""
        self._flush(connection)
        if connection.is_ending and not connection.unsent:
            return False
        try:
            data = connection.link.recv(_MAX_LINE_BYTES)
        except BlockingIOError:
            return True
        except OSError:
            return False
        connection.received += data
        return bool(data)

    def _event(
        self, connection: _CommandConnection, line: bytes, goal_id: Callable[[], bytes]
    ) -> ev.RobotEvent | None:
        try:
            wish = parse_json(line)
            match wish["do"]:
                case "goto":
                    yaw, map_id = wish["yaw"], wish["map_id"]
                    place = float(wish["x"]), float(wish["y"]), None if yaw is None else float(yaw)
                    return ev.GotoRequested(
                        connection.name, goal_id(), *place, None if map_id is None else str(map_id)
                    )
                case "cancel":
                    connection.cancel_id = goal_id()
                    return ev.CancelRequested("`share robot cancel`", connection.cancel_id)
                case "watch":
                    connection.is_watching = True
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
            connection.is_ending, connection.unsent = True, b""
        return None

    def report(self, report: ev.GoalReport) -> None:
        """Tell a commander of its goal, and all that watch."""
        self.notify_watchers({"commander": report.commander, "goal": report.text})
        by_cancel = (one for one in self._connections.values() if one.cancel_id == report.goal_id != b"")
        connection = next(by_cancel, self._connections.get(report.commander))
        if connection is not None:
            form = {"goal": report.text, "is_final": report.is_final, "is_reached": report.is_reached}
            self._send(connection, form)
            connection.is_ending = report.is_final

    def show(self, state: Callable[[], dict[str, Any]], now_ns: int) -> None:
        """Tell those that watch where the robot is, twice a second."""
        if any(one.is_watching for one in self._connections.values()) and self._watch_timer.fire_if_due(
            now_ns
        ):
            self.notify_watchers({"state": state()})

    def notify_watchers(self, message: dict[str, Any]) -> None:
        for connection in self._connections.values():
            if connection.is_watching:
                self._send(connection, message)

    def _send(self, connection: _CommandConnection, message: dict[str, Any]) -> None:
        connection.unsent += json.dumps(message).encode() + b"\n"
        self._flush(connection)
        if len(connection.unsent) > _MAX_UNREAD_BYTES:
            connection.is_ending, connection.unsent = True, b""

    def _flush(self, connection: _CommandConnection) -> None:
        with contextlib.suppress(OSError):
            connection.unsent = connection.unsent[connection.link.send(connection.unsent) :]

    def _drop(self, connection: _CommandConnection) -> None:
        self._connections.pop(connection.name, None)
        connection.link.close()

    def close(self) -> None:
        """Disconnect all, and remove the socket."""
        for connection in list(self._connections.values()):
            self._flush(connection)
            self._drop(connection)
        self._listener.close()
        self._path.unlink(missing_ok=True)


def ask_bridge(path: Path, wish: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Send a wish to the bridge at `path` and yield its answers until it closes. Raises ShareError if none
    runs."""
    with socket.socket(socket.AF_UNIX) as link:
        link.settimeout(_CONNECT_S)
        try:
            link.connect(str(path))
        except OSError:
            raise ShareError(
                "no bridge of this robot runs on this machine; start `share robot bridge`, "
                "with the same --domain and --namespace"
            ) from None
        link.settimeout(None)
        link.sendall(json.dumps(wish).encode() + b"\n")
        with link.makefile("rb") as lines:
            for line in lines:
                yield parse_json(line)
