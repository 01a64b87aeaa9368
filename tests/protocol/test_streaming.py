"""Frames up, poses down, in virtual time: a real agent and a real edge with simulated trackers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from helpers.hellos import NOISE, hello_of, rig_of

from share.config import Config, EdgeConfig, StreamConfig
from share.errors import UsageError
from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.protocol import agent_events as ev
from share.protocol import edge_events as ed
from share.protocol.agent import AgentProtocol
from share.protocol.common_events import EdgeMessageReceived, FailRun, PrintLine, SendToEdge, Tick
from share.protocol.edge import EdgeProtocol
from share.protocol.remote_tracking import TrackingCapacity, TrackingEdge
from share.protocol.streaming import FrameStreamer, StreamingAgent
from share.types import F64, Frame, ImuBatch, TrackState
from share.wire import messages as m
from share.wire.codec import decode, encode

MS = 1_000_000
CONFIG = Config(edge=EdgeConfig(policy="streamed"), stream=StreamConfig(window=3))
HELLO = replace(hello_of("ann", 7), streams_frames=True)
PEER = m.peer_id(7)


def pose(index: int) -> F64:
    return se3.from_rt(np.eye(3), np.array([0.1 * index, 0.0, 0.0]))


def frame(index: int, height: int = 480) -> Frame:
    imu = ImuBatch(np.array([index]), np.zeros((1, 3)), np.zeros((1, 3)))
    return Frame(33 * MS * index, index, np.zeros((height, 640), np.uint8), imu=imu)


@dataclass
class Wire:
    """An agent and its edge. Messages take 1 ms, tracking `track_ms` a frame, its start `start_ms`."""

    track_ms: float = 10.0
    start_ms: float = 100.0
    now_ms: float = 0.0
    takes: bool = True  # the link
    cut: bool = False
    agent: AgentProtocol = field(default_factory=lambda: StreamingAgent(HELLO, CONFIG))
    edge: EdgeProtocol = field(default_factory=lambda: TrackingEdge(CONFIG, 1))
    effects: list[ev.AgentEffect] = field(default_factory=list)
    told: list[dict] = field(default_factory=list)
    trackers: list[ed.StartTracker | ed.StopTracker] = field(default_factory=list)
    tracked: list[Frame] = field(default_factory=list)
    _due: list[tuple[float, Callable[[], None]]] = field(default_factory=list)
    _busy_ms: float = 0.0
    _life: int = 0

    def run(self, until_ms: float) -> None:
        while self.now_ms < until_ms:
            due = sorted([d for d in self._due if d[0] <= self.now_ms], key=lambda d: d[0])
            self._due = [d for d in self._due if d[0] > self.now_ms]
            for _, what in due:
                what()
            if self.now_ms % 50 == 0:
                self.to_agent(ev.AgentTick())
                self.to_edge(Tick())
            self.now_ms += 1

    def to_agent(self, event: ev.AgentEvent) -> None:
        for effect in self.agent.handle(event, round(self.now_ms * MS)):
            self.effects.append(effect)
            if isinstance(effect, ev.SendFrameToEdge) and not self.takes:
                self.to_agent(ev.SendFailed(effect))
            elif isinstance(effect, SendToEdge | ev.SendFrameToEdge) and not self.cut:
                copy = [bytes(part) for part in effect.frames]
                self.later(1, lambda copy=copy: self.to_edge(ed.PeerMessageReceived(PEER, copy)))

    def to_edge(self, event: ed.EdgeEvent) -> None:
        for effect in self.edge.handle(event, round(self.now_ms * MS)):
            match effect:
                case ed.SendToPeer() if not self.cut:
                    copy = [bytes(part) for part in effect.frames]
                    self.later(1, lambda copy=copy: self.to_agent(EdgeMessageReceived(copy)))
                case ed.WriteEvent():
                    self.told.append(effect.fields)
                case ed.StartTracker():
                    self.trackers.append(effect)
                    self._life = effect.generation
                    ready = ed.TrackerReady(effect.key, effect.generation)
                    self.later(self.start_ms, lambda ready=ready: self.to_edge(ready))
                case ed.StopTracker():
                    self.trackers.append(effect)
                case ed.TrackFrame():
                    self._track(effect)

    def _track(self, what: ed.TrackFrame) -> None:
        self.tracked.append(what.frame)
        self._busy_ms = max(self._busy_ms, self.now_ms) + self.track_ms
        answer = m.RemoteTrackingResult(
            what.frame.index, what.frame.stamp_ns, TrackState.OK, pose(what.frame.index)
        )
        done = ed.TrackerAnswered(what.key, self._life, answer)
        self.later(self._busy_ms - self.now_ms, lambda: self.to_edge(done))

    def later(self, ms: float, what: Callable[[], None]) -> None:
        self._due.append((self.now_ms + ms, what))

    def play(self, count: int, every_ms: float = 33, first: int = 0) -> None:
        for k in range(first, first + count):
            event = ev.FrameArrived(frame(k), 0)
            self.later(
                1 + every_ms * (k - first),
                lambda e=event: self.to_agent(replace(e, arrived_ns=round(self.now_ms * MS))),
            )

    def of(self, kind: type) -> list:
        return [effect for effect in self.effects if isinstance(effect, kind)]

    @property
    def said(self) -> list[str]:
        return [effect.text for effect in self.of(PrintLine)]


def joined(**more: float) -> Wire:
    wire = Wire(**more)  # type: ignore[arg-type]
    wire.run(300)
    assert wire.said == ["connected to the edge"]
    return wire


def test_the_welcome_waits_for_the_tracker() -> None:
    wire = Wire(start_ms=1200)
    wire.run(1150)
    assert not wire.agent.is_connected
    assert len(wire.trackers) == 1  # however often it said hello
    wire.run(1300)
    assert wire.agent.is_connected


def test_every_frame_comes_back_with_its_pose() -> None:
    wire = joined()
    wire.play(20)
    wire.run(1200)
    poses = wire.of(ev.LocalisedPose)
    assert [p.index for p in poses] == list(range(20))
    assert all(np.array_equal(p.T_odom_body, pose(p.index)) and p.T_map_odom is None for p in poses)
    assert [d.track_ms for d in wire.of(ev.FrameDone)] == [12.0] * 20
    assert [f.index for f in wire.tracked] == list(range(20))
    report = wire.agent.report()
    assert (report["arrived"], report["streamed"], report["answered"], report["poses"]) == (20, 20, 20, 0)
    told = wire.edge.report({})["agents"]["ann"]
    assert (told["frames_streamed"], told["frames_tracked"], told["frames_dropped"]) == (20, 20, 0)
    assert told["state"] == "OK"


def test_a_slow_edge_gets_the_newest_frame() -> None:
    wire = joined(track_ms=100)
    wire.play(90)
    wire.run(3800)
    report = wire.agent.report()
    assert report["arrived"] == 90
    assert 25 <= report["answered"] <= 40
    assert report["answered"] + report["drop_frame"] == 90
    latest = [d.track_ms for d in wire.of(ev.FrameDone)]
    assert max(latest) <= 400  # of a window of three, and never growing
    heard = np.concatenate([f.imu.stamps_ns for f in wire.tracked])
    assert heard.tolist() == list(range(90))


def test_a_frame_that_the_link_refuses_is_counted_and_its_imu_samples_are_kept() -> None:
    wire = joined()
    wire.takes = False
    wire.play(3)
    wire.run(450)
    wire.takes = True
    wire.play(2, first=3)
    wire.run(600)
    report = wire.agent.report()
    assert (report["drop_link"], report["streamed"], report["answered"]) == (3, 2, 2)
    assert 2 * 640 * 480 < report["bytes_up"] < 2.1 * 640 * 480
    assert wire.tracked[0].imu.stamps_ns.tolist() == [0, 1, 2, 3]


def test_without_an_edge_the_run_continues_and_prints_a_line() -> None:
    wire = joined()
    wire.play(5)
    wire.run(500)
    wire.cut = True
    wire.play(300, first=5)
    wire.run(4500)
    assert wire.said[1:] == ["the edge is silent; no tracking without the edge"]
    wire.cut = False
    wire.run(12_000)
    report = wire.agent.report()
    assert wire.said[2:] == ["reconnected to the edge"]
    assert report["arrived"] == 305
    assert report["answered"] + report["drop_frame"] + report["drop_link"] + report["unanswered"] == 305
    assert report["answered"] > 100
    assert [type(t).__name__ for t in wire.trackers] == ["StartTracker", "StopTracker", "StartTracker"]


def test_a_restarted_edge_starts_a_new_segment() -> None:
    wire = joined()
    wire.play(5)
    wire.run(500)
    wire.edge = TrackingEdge(CONFIG, 2)
    wire.run(1500)
    wire.play(3, first=5)
    wire.run(1800)
    assert wire.said[1:] == ["the edge has restarted; tracking starts again"]
    assert [a.frame.new_segment for a in wire.of(ev.FrameTrackedRemotely)] == [False] * 5 + [
        True,
        False,
        False,
    ]


def test_a_dead_tracker_loses_its_frames_and_is_restarted() -> None:
    wire = joined(track_ms=500)
    wire.play(3, every_ms=10)
    wire.run(900)
    assert len(wire.of(ev.FrameDone)) == 1
    wire.to_edge(ed.TrackerLost(wire.trackers[0].key, 0, "was ended by SIGKILL"))
    assert wire.trackers[-1].generation == 1
    assert [t["reason"] for t in wire.told if t["event"] == "tracking lost"] == [
        "its process was ended by SIGKILL; odometry starts again"
    ]
    wire.run(2500)
    assert len(wire.of(ev.FrameDone)) == 1  # what the dead one would have answered counts for nothing
    wire.play(1, first=3)
    wire.run(4000)
    report = wire.agent.report()
    assert (report["answered"], report["unanswered"]) == (2, 2)
    assert wire.edge.report({})["agents"]["ann"]["frames_dropped"] == 2


def test_an_agent_whose_tracker_cannot_start_is_refused() -> None:
    wire = Wire(start_ms=1e6)
    wire.run(100)
    wire.to_edge(ed.TrackerLost(wire.trackers[0].key, 0, "ended with exit code 1"))
    wire.run(200)
    (fail,) = wire.of(FailRun)
    assert isinstance(fail.error, UsageError)
    assert "its tracking process ended with exit code 1" in str(fail.error)
    assert len(wire.trackers) == 1


def test_the_bye_waits_for_the_last_pose_and_stops_the_tracker() -> None:
    wire = joined(track_ms=100)
    wire.play(4, every_ms=5)
    wire.later(30, lambda: wire.to_agent(ev.InputFinished()))
    wire.run(1500)
    assert len(wire.of(ev.FrameDone)) == 4
    assert wire.of(ev.CloseLink)
    assert isinstance(wire.trackers[-1], ed.StopTracker)
    assert wire.told[-1]["event"] == "left"


@pytest.mark.parametrize(
    ("edge", "streams", "said"),
    [
        (EdgeProtocol(Config(), 1), True, "this edge does not track agents: start it with --policy streamed"),
        (
            TrackingEdge(CONFIG, 1),
            False,
            "this edge tracks its agents (policy streamed): start the agent",
        ),
    ],
)
def test_an_agent_of_the_other_mode_is_refused(edge: EdgeProtocol, streams: bool, said: str) -> None:
    wire = Wire(
        edge=edge,
        agent=(StreamingAgent if streams else AgentProtocol)(replace(HELLO, streams_frames=streams), CONFIG),
    )
    wire.run(200)
    (fail,) = wire.of(FailRun)
    assert said in str(fail.error)
    assert not wire.trackers


def test_a_frame_of_another_size_is_a_bad_message() -> None:
    wire = joined()
    wire.to_agent(ev.FrameArrived(frame(0, height=479), 0))
    wire.run(400)
    assert [t["reason"] for t in wire.told if t["event"] == "bad message"] == [
        "frame 0: image0 is 640x479, the rig says 640x480"
    ]
    assert not wire.tracked


def test_unexpected_messages_change_nothing() -> None:
    """An evaluation of a streaming agent, a frame of an unjoined peer, a remote pose for a tracking agent."""
    wire = joined()
    wire.to_edge(ed.PeerMessageReceived(PEER, encoded(m.Evaluation(0, 1.0, None))))
    wire.to_edge(ed.PeerMessageReceived(m.peer_id(9), encoded(frame(0))))
    report = wire.edge.report({})
    assert report["agents"]["ann"]["unexpected"] == report["unjoined"]["unexpected"] == 1
    alone = AgentProtocol(hello_of("bob", 8), Config())
    effects = alone.handle(
        EdgeMessageReceived(encoded(m.RemoteTrackingResult(0, 0, TrackState.LOST, None))), 0
    )
    assert [e.text for e in effects if isinstance(e, PrintLine)] == [
        "the edge sent a RemoteTrackingResult, which this agent does not expect"
    ]


def encoded(message: m.Message) -> list[bytes]:
    return [bytes(part) for part in encode(message)]


# ------------------------------------------------------------------ how many


def greeted(edge: EdgeProtocol, number: int, now_ms: int = 0) -> tuple[list[m.Message], list[ed.EdgeEffect]]:
    """The answer to the hello of agent `number`, and all effects."""
    hello = replace(hello_of(f"agent{number}", 100 + number), streams_frames=True)
    effects = edge.handle(ed.PeerMessageReceived(m.peer_id(100 + number), encode(hello)), now_ms * MS)
    down = [decode([bytes(f) for f in e.frames]) for e in effects if isinstance(e, ed.SendToPeer)]
    return down, effects


def test_tracked_agents_are_limited_by_cores_and_memory():
    edge = TrackingEdge(CONFIG, 1, capacity=TrackingCapacity(4, "2 cores, 3.1 GB free"))
    begun = [e for k in range(12) for e in greeted(edge, k)[1] if isinstance(e, ed.StartTracker)]
    assert len(begun) == 4
    why = "this machine can track 4 streamed agents: 2 cores, 3.1 GB free; wait until one leaves"
    assert greeted(edge, 5)[0] == [m.Refused(why)]
    assert greeted(edge, 0)[0] == []  # one that is tracked is no other
    edge.handle(ed.PeerMessageReceived(m.peer_id(101), encode(m.Bye())), 0)
    assert [type(e) for e in greeted(edge, 5)[1]].count(ed.StartTracker) == 1
    down, effects = greeted(edge, 1)  # back, but its place is taken
    assert set(down) == {m.Refused(why)}
    assert not [e for e in effects if isinstance(e, ed.StartTracker)]


def test_a_rig_that_no_tracker_can_use_is_refused_at_hello():
    edge, rig = TrackingEdge(CONFIG, 1), rig_of()
    folding = replace(rig.cam0, distortion=(-30.0, 0.0, 0.0, 0.0))
    refused = [
        (replace(rig, cam0=folding), "cam0: its distortion folds"),
        (replace(rig, imu=None), "one camera alone gives no scale"),
        (replace(rig, T_body_cam0=se3.from_rt(np.eye(3), np.array([0, 0, 400.0]))), "400 m from the IMU"),
    ]
    for k, (rig, says) in enumerate(refused):
        hello = replace(hello_of(f"agent{k}", 100 + k), streams_frames=True, rig=rig)
        effects = edge.handle(ed.PeerMessageReceived(m.peer_id(100 + k), encode(hello)), 0)
        assert not [e for e in effects if isinstance(e, ed.StartTracker)]
        [told] = [decode([bytes(f) for f in e.frames]) for e in effects if isinstance(e, ed.SendToPeer)]
        assert isinstance(told, m.Refused) and says in told.reason


def test_large_images_need_more_memory():
    """A tracker of 3800x2400 takes 392 MB, one of 640x480 110 MB."""
    edge = TrackingEdge(CONFIG, 1, capacity=TrackingCapacity(8, "4 cores, 1.0 GB free", 1_000_000_000))
    large = Rig(Camera(3800, 2400, 3000.0, 3000.0, 1900.0, 1200.0), np.eye(4), imu=NOISE)
    begun, refused = 0, []
    for k in range(12):
        hello = replace(hello_of(f"agent{k}", 100 + k), streams_frames=True, rig=large)
        effects = edge.handle(ed.PeerMessageReceived(m.peer_id(100 + k), encode(hello)), 0)
        begun += sum(isinstance(e, ed.StartTracker) for e in effects)
        refused += [decode([bytes(f) for f in e.frames]) for e in effects if isinstance(e, ed.SendToPeer)]
    why = "not enough memory to track another 3800x2400 stream"
    why = f"{why}: 4 cores, 1.0 GB free; wait until one leaves"
    assert begun == 2 and refused == [m.Refused(why)] * 10
    assert [type(e) for e in greeted(edge, 50)[1]].count(ed.StartTracker) == 1  # a small one has room


def test_a_new_segment_in_a_late_answer_starts_with_the_next_pose() -> None:
    """A restarted tracker first answers frames that have expired."""
    streaming = FrameStreamer(CONFIG.stream)
    for k in range(2):
        streaming.add_frame(ev.FrameArrived(frame(k), 0), is_connected=True)
        streaming.next_frame(2000 * MS * k)  # by then nobody waits for the first
    late = m.RemoteTrackingResult(0, 0, TrackState.OK, pose(0), new_segment=True)
    assert streaming.take_result(late, 2000 * MS) is None
    answer = streaming.take_result(m.RemoteTrackingResult(1, 33 * MS, TrackState.OK, pose(1)), 2001 * MS)
    assert answer is not None
    assert answer.new_segment
