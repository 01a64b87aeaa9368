"""The edge that tracks its agents, each alone, from what they stream: policy `streamed`.

It has no map. An agent is welcomed once its tracker is ready, so that its first frames are not lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from share.geometry import rig_check
from share.geometry.camera import Camera, Rig
from share.protocol.edge import Edge
from share.protocol.edge_events import (
    Answered,
    BeginTracking,
    EndTracking,
    Event,
    Lost,
    Ready,
    Received,
    ToTracker,
    Track,
)
from share.protocol.peer import Peer
from share.protocol.streaming import Window
from share.types import Frame
from share.wire import messages as wire
from share.wire.messages import Tracked

# ---- An agent that the edge tracks: its frames, its tracker's answers, and lives of that tracker. A part
# of `share.protocol.edge`; trackers are processes of `share.runtime.tracking`.


@dataclass
class Afar:
    """is_ready: its tracker can track. streamed, tracked: frames that came, and that were answered."""

    key: str
    rig: Rig
    window: Window
    life: int = 0
    is_running: bool = False
    is_ready: bool = False
    streamed: int = 0
    tracked: int = 0
    _answered: bool = field(default=False)  # in this life

    def begin(self) -> Sequence[ToTracker]:
        """A tracker, if it has none."""
        if self.is_running:
            return ()
        self.is_running, self._answered = True, False
        return (BeginTracking(self.key, self.life, self.rig),)

    def end(self) -> Sequence[ToTracker]:
        """It is gone: none is needed."""
        was_running = self._stop()
        return (EndTracking(self.key),) if was_running else ()

    def frame(self, frame: Frame, now_ns: int) -> Sequence[ToTracker]:
        """What goes to the tracker. Raises ValueError if the frame is not of this rig."""
        self._check(frame)
        self.streamed += 1
        self.window.offer(frame, now_ns)
        return self._next(now_ns)

    def answered(self, answer: Tracked, now_ns: int) -> Sequence[ToTracker]:
        self.window.answered(answer.index)
        self.tracked += 1
        self._answered = True
        return self._next(now_ns)

    def lost(self) -> bool:
        """Its tracker has died. Whether another may do better: this one had answered."""
        self._stop()
        return self._answered

    def report(self) -> dict[str, int]:
        """For edge.json; dropped: for newer ones, or with a tracker that died."""
        dropped = self.window.dropped + self.window.unanswered
        return {"frames_streamed": self.streamed, "frames_tracked": self.tracked, "frames_dropped": dropped}

    def _next(self, now_ns: int) -> Sequence[ToTracker]:
        frame = self.window.next(now_ns) if self.is_running else None
        return () if frame is None else (Track(self.key, frame),)

    def _stop(self) -> bool:
        """Whether one was running."""
        was_running, self.is_running, self.is_ready = self.is_running, False, False
        self.window.clear()
        self.life += was_running
        return was_running

    def _check(self, frame: Frame) -> None:
        for name, image, camera in (
            ("image0", frame.image0, self.rig.cam0),
            ("image1", frame.image1, self.rig.cam1),
            ("depth", frame.depth, self.rig.depth),
        ):
            have, want = None if image is None else image.shape, _shape(camera)
            if have != want:
                raise ValueError(f"frame {frame.index}: {name} is {_words(have)}, its camera {_words(want)}")


def _shape(camera: Camera | None) -> tuple[int, ...] | None:
    return None if camera is None else (camera.height, camera.width)


def _words(shape: tuple[int, ...] | None) -> str:
    return "none" if shape is None else f"{shape[1]}x{shape[0]}"


@dataclass(frozen=True)
class Room:
    """How many agents can be tracked at a time, and of what that comes, for a person. bytes: of memory, for
    all their trackers; None: not known."""

    agents: int
    why: str
    bytes: int | None = None

    def objection(self, others: Sequence[Rig], rig: Rig) -> str | None:
        """Why one more cannot be tracked beside the others; the first always can."""
        if others and len(others) >= self.agents:
            most = f"{self.agents} streamed agent{'' if self.agents == 1 else 's'}"
            return f"this machine can track {most}: {self.why}; wait until one leaves"
        needs = sum(tracker_bytes(each) for each in (*others, rig))
        if others and self.bytes is not None and needs > self.bytes:
            size = f"{rig.cam0.width}x{rig.cam0.height}"
            return f"no memory to track images of {size} beside the others: {self.why}; wait until one leaves"
        return None


def tracker_bytes(rig: Rig) -> int:
    """Memory of a tracker's process: 112 MB at 640x480 after 5 s, 320 MB at 3800x2400."""
    return 100_000_000 + 32 * rig.cam0.width * rig.cam0.height


class TrackingEdge(Edge):
    """Beside the effects of `Edge`, but for those to the mapper and the keeper: BeginTracking, Track and
    EndTracking; it is told Ready, Answered and Lost. room: an agent beyond it is refused."""

    tracks: ClassVar[bool] = True

    def __init__(self, *arguments: Any, room: Room | None = None, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._room = room
        self._afar: dict[str, Afar] = {}  # by the key of the run

    def _react(self, event: Event, now_ns: int) -> None:
        match event:
            case Ready() | Answered() | Lost():
                afar = self._afar[event.key]
                if event.life == afar.life and afar.is_running:
                    self._hear(self._runs.by_key[event.key], afar, event, now_ns)
            case _:
                super()._react(event, now_ns)

    def _hear(self, peer_id: bytes, afar: Afar, event: Ready | Answered | Lost, now_ns: int) -> None:
        """Its tracker says so."""
        peer = self._runs[peer_id]
        match event:
            case Ready():
                afar.is_ready = True
                self._welcome(peer_id, peer, now_ns)
            case Answered():
                peer.status.posed(event.answer.state, now_ns)
                self._send(peer_id, event.answer)
                self._do(afar.answered(event.answer, now_ns))
            case Lost():
                may_do_better = afar.lost()
                self._record(now_ns, "tracking lost", peer, f"its process {event.how}; odometry begins anew")
                if may_do_better:
                    self._do(afar.begin())
                else:  # it says hello again after a while
                    self._send(peer_id, wire.Refused(f"the process that is to track it {event.how}"))

    def _told(self, peer_id: bytes, peer: Peer, message: wire.Message, now_ns: int) -> None:
        if isinstance(message, wire.Status):
            peer.status.told(message, now_ns)
            return
        if not isinstance(message, Frame):
            peer.counts["unexpected"] += 1
            return
        try:
            self._do(self._afar[peer.key].frame(message, now_ns))
        except ValueError as error:
            self._complain(peer, str(error), now_ns)

    def _objection(self, event: Received, hello: wire.Hello, now_ns: int) -> str | None:
        known = self._runs.get(event.peer)
        if known is not None:
            return super()._objection(event, hello, now_ns) or self._full(known.key, hello.rig)
        return (
            super()._objection(event, hello, now_ns)
            or rig_check.objection(hello.rig)
            or self._full(None, hello.rig)
        )

    def _full(self, key: str | None, rig: Rig) -> str | None:
        """Why no tracker can begin for this run, or for a new one, if none can."""
        running = [afar.rig for other, afar in self._afar.items() if afar.is_running and other != key]
        return None if self._room is None else self._room.objection(running, rig)

    def _enter(self, peer_id: bytes, peer: Peer) -> None:
        self._runs.add(peer_id, peer)
        window = Window(self._config.stream.window)
        self._afar[peer.key] = Afar(peer.key, peer.hello.rig, window)

    def _forget(self, peer: Peer, was_latest: bool) -> None:
        super()._forget(peer, was_latest)
        del self._afar[peer.key]

    def _welcome(self, peer_id: bytes, peer: Peer, now_ns: int) -> None:
        """Now, or as soon as its tracker is ready."""
        afar = self._afar[peer.key]
        self._do(afar.begin())
        if afar.is_ready:
            super()._welcome(peer_id, peer, now_ns)

    def _no_room(self, peer: Peer, now_ns: int) -> str | None:
        return super()._no_room(peer, now_ns) or self._full(peer.key, peer.hello.rig)

    def _come_back(self, peer: Peer, now_ns: int) -> None:
        super()._come_back(peer, now_ns)
        self._do(self._afar[peer.key].begin())

    def _gone(self, peer: Peer, what: str, reason: str, now_ns: int) -> None:
        super()._gone(peer, what, reason, now_ns)
        self._do(self._afar[peer.key].end())

    def _do(self, effects: Sequence[ToTracker]) -> None:
        self._effects.extend(effects)

    def _report_of(self, peer: Peer) -> dict[str, Any]:
        return super()._report_of(peer) | self._afar[peer.key].report()
