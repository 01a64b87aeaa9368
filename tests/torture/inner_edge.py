"""The edge from bytes to map in one process: what `share.runtime` does between sockets and solver, each call
timed by its CPU; and agents of a room of textured planes whose keyframes are images.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2
import numpy as np
from helpers.hellos import NOISE
from helpers.textured_planes import CAMERA, T_BODY_CAM, Planes, with_depth_errors
from raw_wire import Message, unpack

from share.config import Config, EdgeConfig
from share.earlier_poses import EarlierPoses
from share.errors import describe_exception
from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.geometry.se3 import umeyama
from share.mapping.corrections import MapEvent
from share.mapping.graph.solver import PoseGraphSolver
from share.mapping.mapper import Mapper
from share.mapping.steps import SolveStep
from share.protocol import edge_events as ed
from share.protocol.common_events import Tick
from share.protocol.edge import EdgeProtocol
from share.types import F64, AgentKind, Keyframe, KeyframeImage, View
from share.vision import corners
from share.vision.keyframe_images import compress
from share.wire.codec import encode
from share.wire.layouts import MESSAGE_CODES
from share.wire.messages import Ack, Bye, Hello, Ping, peer_id

T = TypeVar("T")
STEP_NS = 300_000_000  # between the keyframes of an agent


@dataclass(frozen=True)
class Raised:
    """An exception of a call. is_guarded: by a step, whose failure costs a keyframe its look-up only."""

    call: str
    text: str
    is_guarded: bool


class InnerEdge:
    """raised: all exceptions; cpu_ms: the longest of each kind of call, and during which message.

    keys: of the names that have one."""

    def __init__(self, max_keyframes: int = 300) -> None:
        config = Config(edge=EdgeConfig(max_keyframes=max_keyframes))
        self.edge, self.mapper, self.solver = EdgeProtocol(config, 7), Mapper(config), PoseGraphSolver()
        self.keys: dict[str, str] = {}
        self.raised: list[Raised] = []
        self.cpu_ms: dict[str, tuple[float, int]] = defaultdict(lambda: (0.0, -1))
        self.events: defaultdict[str, int] = defaultdict(int)
        self.messages = 0
        self.now_ns = 0
        self.acked: dict[bytes, int] = {}

    def hear(self, peer: bytes, frames: Message) -> None:
        """One message, and all that follows from it."""
        self.messages += 1
        received = ed.PeerMessageReceived(peer, frames)
        self._carry_out(self._timed("edge", lambda: self.edge.handle(received, self.now_ns), []))

    def tick(self, ns: int) -> None:
        self.now_ns += ns
        self._carry_out(self.edge.handle(Tick(), self.now_ns))

    def work(self, most: int = 200) -> None:
        """The steps that are due."""
        for _ in range(most):
            step = self._timed("next look-up", self.mapper.next_lookup, None)
            if step is not None:
                self._finish(step, step.run)
            self.mapper.note_time(self.now_ns * 1e-9)
            solve = self._timed("next solve", self.mapper.next_solve, None)
            self._found(self.mapper.take_events())
            if solve is not None:
                self._finish(solve, partial(solve.run, self.solver))
            if step is None and solve is None:
                return

    def poses(self) -> dict[tuple[str, int], tuple[F64, str]]:
        """T_map_body (4, 4) and map of each keyframe, by run and id."""
        saved = self.mapper.current_poses()
        return {
            (key.agent, key.id): (pose, map_id)
            for key, pose, map_id in zip(saved.keys, saved.T_map_body, saved.map_ids, strict=True)
        }

    def _finish(self, step: Any, run: Callable[[], Any]) -> None:
        result: Any
        before = time.thread_time()
        try:
            result = run()
        except Exception as error:
            result = error
            self.raised.append(Raised(step.kind, describe_exception(error), True))
        ms = self._note(step.kind, before)
        self._found(self._timed("finish", lambda: self.mapper.finish_step(step, result, ms), []))
        if isinstance(step, SolveStep) and isinstance(result, Exception):
            self.solver = PoseGraphSolver()

    def _carry_out(self, effects: list[ed.EdgeEffect]) -> None:
        mapper = self.mapper
        for effect in effects:
            match effect:
                case ed.SendToPeer(peer, frames):
                    _, code, scalars, _ = unpack(bytes(frames[0]))  # type: ignore[misc]
                    if code == MESSAGE_CODES[Ack]:
                        self.acked[peer] = scalars[0]
                case ed.AddRun(key, hello):
                    mapper.add_run(key, hello, self.keys.get(hello.name, ""))
                case ed.SetPresence(key, is_present):
                    mapper.set_present(key, is_present)
                case ed.DropRun(key):
                    self._timed("forget", partial(mapper.remove_run, key), None)
                case ed.AddKeyframe(key, keyframe, is_over_rate):
                    add = partial(mapper.add_keyframe, key, keyframe, is_over_rate)
                    self._found(self._timed("add", add, []))
                case ed.WriteEvent(fields):
                    self.events[fields["event"]] += 1
                    if fields["event"] == "internal error":
                        self.raised.append(Raised("edge", str(fields["reason"]), False))

    def _found(self, map_events: list[MapEvent]) -> None:
        self.events["step failed"] += sum(map_event.event == "step failed" for map_event in map_events)
        changes, empty = self.mapper.take_changes(), self.mapper.take_empty_runs()
        self._carry_out(self.edge.handle(ed.MapperResult(tuple(map_events), changes, empty), self.now_ns))

    def _timed(self, call: str, work: Callable[[], T], default: T) -> T:
        before = time.thread_time()
        try:
            return work()
        except Exception as error:
            self.raised.append(Raised(call, describe_exception(error), False))
            return default
        finally:
            self._note(call, before)

    def _note(self, call: str, before: float) -> float:
        ms = 1e3 * (time.thread_time() - before)
        self.cpu_ms[call] = max(self.cpu_ms[call], (ms, self.messages))
        return ms


# ------------------------------------------------------------------ agents

ROOM = Planes([[0.1, 0.05, 0.4], [-0.6, 0.0, 0.3], [0.0, 0.7, 0.25]], seed=3)
SMALL = Camera(320, 240, CAMERA.fx / 2, CAMERA.fy / 2, 159.5, 119.5)
RIG = Rig(SMALL, T_BODY_CAM, imu=NOISE)
COV = np.diag([1e-6] * 3 + [4e-6] * 3)
PLACES = 48  # on the way, which is walked again and again
BACK = (3, 7, 13)  # keyframes to which spans lead, as SHARE's agents send them


def place(j: int) -> F64:
    """T_world_body (4, 4) of place j: to and fro before the back wall."""
    a = 2 * np.pi * j / PLACES
    xi = np.array(
        [0.04 * np.sin(2 * a), 0.12 * np.sin(a), 0.0, 0.6 * np.sin(a), 0.1 * np.cos(a), 0.2 * np.cos(a)]
    )
    return se3.exp(xi) @ se3.inverse(T_BODY_CAM)


@cache
def picture(j: int, surfaces: int = 80) -> KeyframeImage:
    """What is sent of place j: 320 x 240 px."""
    rng = np.random.default_rng(j)
    T = place(j)
    large = ROOM.seen_from(T @ T_BODY_CAM, rng)
    image = cv2.resize(large, (SMALL.width, SMALL.height), interpolation=cv2.INTER_AREA)
    px = corners.detect(image, np.zeros((0, 2), np.float32), surfaces, 8)
    uv = SMALL.normalise(px.astype(np.float64))
    return with_depth_errors(ROOM, T, compress(image), uv, rng, 0.005).source


class PictureAgent:
    """Walks round and sends what an honest agent would; its odometry drifts a little."""

    def __init__(self, name: str, run_id: int, start: int) -> None:
        self.hello = Hello(name, AgentKind.AR, run_id, RIG)
        self.peer, self._start = peer_id(run_id), start
        self._rng = np.random.default_rng(run_id)
        self._odom = [se3.exp(self._rng.normal(0, [0.0, 0.0, 0.1, 1, 1, 1]))]

    def __len__(self) -> int:
        return len(self._odom)

    def T_world_body(self, k: int) -> F64:
        return place((self._start + k) % PLACES)

    def keyframe(self, k: int) -> Keyframe:
        """Its keyframe k, after those before it."""
        while len(self._odom) <= k:
            n = len(self._odom)
            step = se3.inverse(self.T_world_body(n - 1)) @ self.T_world_body(n)
            noise = self._rng.normal(0, np.sqrt(COV.diagonal()) / 2)
            self._odom.append(se3.orthonormal(self._odom[-1] @ step @ se3.exp(noise)))
        T = self._odom[k]
        T_ref = se3.inverse(self._odom[k - 1]) @ T if k else T
        ids = [k - back for back in BACK if k >= back]
        spans = EarlierPoses(
            np.array(ids, np.int64),
            np.array([se3.inverse(self._odom[i]) @ T for i in ids]).reshape(-1, 4, 4),
            np.array([(k - i) * COV for i in ids]).reshape(-1, 6, 6),
        )
        image = picture((self._start + k) % PLACES)
        stamp_ns = 10**9 + STEP_NS * k
        none = np.zeros(3)
        return Keyframe(k, k - 1, stamp_ns, T_ref, COV, T, none, 0.0, View.empty(), k - 1, image, spans)


def said(message: Any) -> Message:
    """The bytes of a message."""
    return [bytes(frame) for frame in encode(message)]


BYE, PING = said(Bye()), said(Ping(0, 0))


def joint_error_m(edge: InnerEdge, agents: list[PictureAgent]) -> float:
    """RMSE of all keyframes of these agents in one alignment; inf unless they are in one map."""
    found, true, maps = [], [], set()
    owners = {peer.key: agent for agent in agents if (peer := edge.edge._registry.get(agent.peer))}
    for (run, number), (pose, map_id) in edge.poses().items():
        if run in owners:
            found.append(pose[:3, 3])
            true.append(owners[run].T_world_body(number)[:3, 3])
            maps.add(map_id)
    if len(maps) != 1:
        return float("inf")
    gap = se3.transform(umeyama(np.array(found), np.array(true)), np.array(found)) - np.array(true)
    return float(np.sqrt((gap**2).sum(axis=1).mean()))
