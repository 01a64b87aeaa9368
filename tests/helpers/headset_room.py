"""A server for the headset page that speaks its protocol, without an edge: a room of one map whose agents a
test moves. Over HTTP on loopback, which browsers take for a secure context."""

from __future__ import annotations

import base64
import contextlib
import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

from share.geometry import se3
from share.headset.page_requests import PageGuard, own_names, read_page
from share.types import F64

PAGE = Path(__file__).resolve().parents[2] / "share" / "headset" / "page"
CODE = "48392175"
MAP = "ann-1/0"
Pose = tuple[F64, F64, F64]  # T_map_body, velocity in the map, angular velocity in the body


class HeadsetRoom:
    """agents: by name, kind and where it is at a wall-clock time, s; sent thirty times a second."""

    def __init__(self, agents: dict[str, tuple[str, Callable[[float], Pose]]], port: int = 0) -> None:
        self.agents, self.objects = agents, dict[int, dict[str, Any]]()
        self.received = list[dict[str, Any]]()  # of pages; with the moment, ns
        self.map_id, self.delay_s, self.refusal = MAP, 0.012, ""
        self.hindrance = ""  # why nobody is let in for now
        self.is_outdated = False  # whether that is the page's release
        self.mount: F64 | None = None
        self.may = {"objects": True, "commands": True}
        self.paths: dict[str, list[list[float]]] = {}
        self._guard = PageGuard("http", own_names("127.0.0.1"), read_page(PAGE))
        self._seats = dict[str, ServerConnection]()
        self._names = dict[str, tuple[str, str | None]]()
        self._lock, self._ended = threading.RLock(), threading.Event()
        self._server: Server = serve(
            self._serve,
            "127.0.0.1",
            port,
            process_request=self._answer,
            ping_interval=None,
            open_timeout=None,
        )
        self.port = self._server.socket.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}/"

    def __enter__(self) -> HeadsetRoom:
        for target in (self._server.serve_forever, self._move):
            threading.Thread(target=target, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self.drop()
        self._server.shutdown()

    def drop(self) -> None:
        """Cut all connections off."""
        with self._lock:
            for seat in self._seats.values():
                seat.socket.close()
            self._seats.clear()

    def tell(self, **message: Any) -> None:
        """Send a message to every page."""
        text = json.dumps(message)
        with self._lock:
            for seat in list(self._seats.values()):
                with contextlib.suppress(ConnectionClosed, OSError):
                    seat.send(text)

    def put(self, object_id: int, kind: str, owner: str, T: F64, map_id: str | None = None) -> None:
        one = {
            "id": object_id,
            "kind": kind,
            "owner": owner,
            "map_id": map_id or self.map_id,
            **pose_fields(T),
        }
        with self._lock:
            self.objects[object_id] = one
            self.tell(type="objects", all=False, objects=[one], removed=[])

    def of_type(self, kind: str) -> list[dict[str, Any]]:
        return [one for one in self.received if one["type"] == kind]

    def _answer(self, _: ServerConnection, request: Request) -> Response | None:
        headers = {name.lower(): value for name, value in request.headers.raw_items()}
        answer = self._guard.answer(request.path, headers, "upgrade" in headers)
        if answer is None:
            return None
        fields = self._guard.headers(headers["host"])
        fields |= {"Content-Type": answer.media_type, "Content-Length": str(len(answer.body))}
        return Response(int(answer.status), "", Headers(fields), answer.body)

    def _serve(self, connection: ServerConnection) -> None:
        hello = json.loads(connection.recv())
        if self.hindrance:
            about = {"is_over": False, "is_outdated": self.is_outdated}
            refused = {"type": "refused", "reason": self.hindrance, **about}
            connection.send(json.dumps(refused))
            return
        if "session" in hello and hello["session"] in self._names:
            session = hello["session"]
        elif hello.get("code") == CODE:
            session = f"secret of {hello['name']}"
            self._names[session] = hello["name"], hello["agent"]
        else:
            reason = (
                "the code is wrong: see the edge's screen"
                if "code" in hello
                else "this session has ended: pair again"
            )
            connection.send(json.dumps({"type": "refused", "reason": reason, "is_over": True}))
            return
        name, agent = self._names[session]
        mount = None if self.mount is None else self.mount.ravel().tolist()
        agents = [{"name": one, "kind": kind} for one, (kind, _) in self.agents.items()]
        about = {
            "name": name,
            "agent": agent,
            "may": self.may,
            "T_body_viewer": mount,
            "mount_timeshift_ms": None,
        }
        welcome = {"type": "welcome", "schema": 1, "session": session, **about, "agents": agents}
        with self._lock:
            self._seats[session] = connection
            connection.send(json.dumps(welcome))
            connection.send(
                json.dumps({"type": "edge", "is_connected": True, "text": "connected to the edge"})
            )
            held = list(self.objects.values())
            connection.send(json.dumps({"type": "objects", "all": True, "objects": held, "removed": []}))
        try:
            for text in connection:
                self._handle(connection, name, json.loads(text))
        except (ConnectionClosed, OSError):
            pass

    def _handle(self, connection: ServerConnection, name: str, message: dict[str, Any]) -> None:
        self.received.append(message | {"from": name, "at_ns": time.monotonic_ns()})
        match message["type"]:
            case "ping":
                pong = {"type": "pong", "n": message["n"], "sent_ms": message["sent_ms"], "t_ms": now_ms()}
                connection.send(json.dumps(pong))
            case "put" | "remove":
                connection.send(
                    json.dumps({"type": "receipt", "request": message["request"], "reason": self.refusal})
                )
                if not self.refusal:
                    self._change(name, message)
            case "points":
                rng = np.random.default_rng(1)
                xyz = np.concatenate([rng.uniform((-3, -3, -1.6), (5, 4, 1.2), (6000, 3)) * [1, 1, 1]])
                side = rng.integers(0, 3, 6000)
                xyz[side == 0, 0], xyz[side == 1, 1], xyz[side == 2, 2] = 5, 4, -1.6
                data = base64.b64encode(xyz.astype("<f4").tobytes()).decode()
                self.tell(type="points", map_id=message["map_id"], part=0, parts=1, count=len(xyz), data=data)
            case "goto" | "cancel":
                text = (
                    f"{np.hypot(message['x'], message['y']):.2f} m to go"
                    if message["type"] == "goto"
                    else "stopped"
                )
                is_final = message["type"] == "cancel"
                about = {"robot": message["robot"] or "bot", "commander": name, "text": text}
                self.tell(
                    type="command", command=message["command"], **about, is_final=is_final, is_reached=False
                )

    def _change(self, name: str, message: dict[str, Any]) -> None:
        with self._lock:
            if message["type"] == "remove":
                self.objects.pop(message["id"], None)
                gone = {"id": message["id"], "reason": f"removed by {name}"}
                self.tell(type="objects", all=False, objects=[], removed=[gone])
                return
            known = self.objects.get(message["id"])
            fields = {key: message[key] for key in ("id", "kind", "map_id", "position", "quaternion")}
            one = fields | {"owner": known["owner"] if known else name}
            self.objects[message["id"]] = one
            self.tell(type="objects", all=False, objects=[one], removed=[])

    def _move(self) -> None:
        tick = 0
        while not self._ended.wait(1 / 30):
            tick += 1
            t_ms, wall_s = now_ms() - 1e3 * self.delay_s, time.time() - self.delay_s
            poses = []
            for name, (kind, motion) in self.agents.items():
                T, velocity, turning = motion(wall_s)
                about = {"agent": name, "kind": kind, "state": "OK", "map_id": self.map_id, "t_ms": t_ms}
                rates = {"velocity": velocity.tolist(), "angular_velocity": turning.tolist()}
                pose = about | pose_fields(T) | rates | {"sigma_m": 0.008, "sigma_rad": 0.002}
                if name in self.paths and tick % 30 == 0:
                    pose["path"] = self.paths[name]
                poses.append(pose)
            self.tell(type="poses", poses=poses)


def now_ms() -> float:
    return time.monotonic_ns() / 1e6


def pose_fields(T: F64) -> dict[str, list[float]]:
    return {"position": T[:3, 3].tolist(), "quaternion": se3.quat_from_matrix(T[:3, :3]).tolist()}


def still(T: F64) -> Callable[[float], Pose]:
    return lambda _: (T, np.zeros(3), np.zeros(3))
