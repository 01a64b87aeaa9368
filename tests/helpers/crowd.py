"""Cheap agents for an edge that is a real process: `AgentProtocol`, link, keyframes of a room of points."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import numpy as np
from helpers.edge_sim import Person, walls

from share.config import Config
from share.geometry import se3
from share.net.transport import AgentLink, connect
from share.protocol import agent_events as ev
from share.protocol.agent import AgentProtocol
from share.protocol.common_events import Connected, EdgeMessageReceived, FailRun, PrintLine, SendToEdge
from share.types import F64, OdometryKeyframe, TrackState, View
from share.wire.messages import Hello

FRAME_S = 0.1
EVERY = 3  # frames a keyframe


@dataclass(frozen=True)
class Script:
    """What an agent does, made before it runs: of every frame T_odom_body, of every third what it sees."""

    T_odom_body: list[F64]
    views: dict[int, View]


def script(person: Person, frames: int) -> Script:
    """Between two keyframes the pose of the first stays."""
    poses, views = [], {}
    for k in range(frames):
        if k % EVERY == 0:
            T, views[k] = person.step()
        poses.append(T)
    return Script(poses, views)


@dataclass
class Life:
    """When this agent learnt of one life of the edge, by `time.monotonic`."""

    welcomed: float
    corrected: float | None = None


class Walker(threading.Thread):
    """One agent in a thread of its own, 10 frames a second, until `finish`.

    maps: when a correction came, and of which map. late_s: how long after its time each frame was handled.
    """

    def __init__(self, hello: Hello, script: Script, address: str) -> None:
        super().__init__(name=hello.name, daemon=True)
        self.script, self.machine = script, AgentProtocol(hello, Config())
        self._T_last = np.eye(4)  # of the last candidate
        self.lives: list[Life] = []
        self.maps: list[tuple[float, str]] = []
        self.odometry: list[F64] = []
        self.late_s: list[float] = []
        self.said: list[str] = []
        self.error: BaseException | None = None
        self._run_id, self._address = hello.run_id, address
        self._finish = threading.Event()
        self._ended = False

    def finish(self) -> None:
        self._finish.set()

    def run(self) -> None:
        try:
            self._run()
        except BaseException as error:
            self.error = error

    def _run(self) -> None:
        link = connect(self._address, self._run_id)
        began, k, told = time.monotonic(), 0, False
        while not self._ended:
            due = began + k * FRAME_S
            wait = min(0.05, max(0.0, due - time.monotonic()))
            if (frames := link.receive(round(1e3 * wait))) is not None:
                self._handle(link, EdgeMessageReceived(frames))
            if link.poll_connected():
                self._handle(link, Connected())
            if not told and time.monotonic() >= due:
                if self._finish.is_set() or k == len(self.script.T_odom_body):
                    self._handle(link, ev.InputFinished())
                    told = True
                else:
                    self.late_s.append(time.monotonic() - due)
                    self._frame(link, k)
                    k += 1
            self._handle(link, ev.AgentTick())
        link.close()

    def _frame(self, link: AgentLink, k: int) -> None:
        T, view, now = self.script.T_odom_body[k], self.script.views.get(k), time.monotonic_ns()
        stamp = k * round(FRAME_S * 1e9)
        frame = ev.FrameTracked(k, stamp, now, now, TrackState.OK, T, view is not None, k == 0)
        self._handle(link, frame)
        if view is not None:
            T_last_body = se3.inverse(self._T_last) @ T
            self._T_last = T
            candidate = OdometryKeyframe(T, T_last_body, 4e-6 * np.eye(6), np.zeros(3), 0.0, view, k == 0)
            self._handle(link, ev.KeyframeMade(frame, candidate))

    def _handle(self, link: AgentLink, event: ev.AgentEvent) -> None:
        session = self.machine._connection.sessions.session
        for effect in self.machine.handle(event, time.monotonic_ns()):
            match effect:
                case SendToEdge():
                    link.send(effect.frames)
                case ev.LocalisedPose():
                    self.odometry.append(effect.T_odom_body)
                case PrintLine():
                    self.said.append(effect.text)
                case ev.CorrectionApplied():
                    self.maps.append((time.monotonic(), effect.map_id))
                    if self.lives and self.lives[-1].corrected is None:
                        self.lives[-1].corrected = time.monotonic()
                case FailRun():
                    raise effect.error
                case ev.CloseLink():
                    self._ended = True
        if self.machine._connection.sessions.session != session:
            self.lives.append(Life(time.monotonic()))


def crowd(names: tuple[str, ...], address: str, frames: int) -> list[Walker]:
    """Spread over the ring of one room."""
    place = walls(1)
    people = [Person(name, place, 0.5 * i, 11 * (i + 1)) for i, name in enumerate(names)]
    return [Walker(p.hello, script(p, frames), address) for p in people]
