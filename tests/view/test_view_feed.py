"""What an edge tells the live room, and that it never waits for it."""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Callable
from multiprocessing import Pipe

import numpy as np
from helpers import map_changes as mc
from helpers.hellos import hello_of

from share.mapping.corrections import MapEvent, map_assignment
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import RemoveKeyframes, RemoveLoops, SaveLoop, StoredMap
from share.protocol.edge_events import (
    AddKeyframe,
    AddRun,
    DropRun,
    EdgeEffect,
    MapperResult,
    SendToPeer,
    WriteEvent,
)
from share.protocol.peer import RestoredRun
from share.types import TrackState
from share.view import events as ev
from share.view.feed import END, MAX_QUEUED, ViewFeed
from share.view.sources import map_events
from share.wire.messages import PoseUpdate

KEY = mc.ANN


def told(tell: Callable[[ViewFeed], None]) -> list[ev.RoomEvent]:
    """All events that a feed has sent by its end."""
    here, there = Pipe()
    feed, out = ViewFeed(there), list[ev.RoomEvent]()
    tell(feed)
    feed.close()
    while (data := here.recv_bytes()) != END:
        out += pickle.loads(data)
    return out


def effects(*some: EdgeEffect) -> list[ev.RoomEvent]:
    return told(lambda feed: [feed.add_effect(one) for one in some] and None)  # type: ignore[func-returns-value]


def pose(stamp_ns: int) -> PoseUpdate:
    return PoseUpdate(stamp_ns, TrackState.OK, 3, np.eye(4), 5.5)


def test_runs_keyframes_and_decisions_are_told() -> None:
    keyframe = mc.keyframe(KEY, 0).keyframe
    write = WriteEvent({"t_s": 1.5, "event": "maps merged", "agent": "ann", "reason": "three loops"})
    hello = hello_of("ann", 1, T=mc.pose(3))
    run, shown, said, gone = effects(
        AddRun(KEY, hello), AddKeyframe(KEY, keyframe), SendToPeer(b"", []), write, DropRun(KEY)
    )
    assert effects(DropRun(KEY), AddKeyframe(KEY, keyframe))[1:] == []  # of an unknown run
    assert isinstance(run, ev.RunArrived) and (run.run, run.name) == (KEY, "ann")
    assert isinstance(shown, ev.KeyframeArrived) and shown.begins_segment
    assert shown.key == KeyframeKey(KEY, 0) and shown.jpeg == keyframe.image.jpeg.tobytes()
    assert said == ev.DecisionMade(1.5, "maps merged", "ann", "three loops")
    assert gone == ev.RunRemoved(KEY)


def test_points_are_those_that_are_near_and_certain_in_the_body() -> None:
    keyframe = mc.keyframe(KEY, 0, points=0).keyframe
    _, shown = effects(AddRun(KEY, hello_of("ann", 1, T=mc.pose(3))), AddKeyframe(KEY, keyframe))
    assert isinstance(shown, ev.KeyframeArrived)
    points = keyframe.image.points
    sigma_m = keyframe.image.rho_sigma * points[:, 2] ** 2
    points = points[(points[:, 2] < 10) & (sigma_m < 0.15)]
    T = mc.pose(3)
    np.testing.assert_allclose(shown.points, points @ T[:3, :3].T + T[:3, 3], atol=1e-5)


def test_what_the_mapper_decides_is_told() -> None:
    loop = mc.loop(1, 2)
    changes = (SaveLoop(loop), RemoveLoops(loop.a, loop.b), RemoveKeyframes((loop.a,)))
    map_events = (
        map_assignment(KEY, "ann-0001/0", mc.pose(2), 0),
        MapEvent(KEY, "loop refused", "few inliers"),
    )
    added, removed, keyframes, corrected = told(
        lambda feed: feed.add_result(MapperResult(map_events, changes))
    )
    assert added == ev.LoopAccepted(loop.a, loop.b) and removed == ev.LoopsRemoved(loop.a, loop.b)
    assert keyframes == ev.KeyframesRemoved((loop.a,))
    assert isinstance(corrected, ev.CorrectionArrived) and corrected.map_id == "ann-0001/0"
    np.testing.assert_array_equal(corrected.T_map_odom, mc.pose(2))


def test_a_pose_is_told_once() -> None:
    def tell(feed: ViewFeed) -> None:
        for stamp_ns in (1, 1, 2):
            feed.add_poses({KEY: pose(stamp_ns)})
            time.sleep(0.2)  # longer than what is collected in one message

    before_ns = time.monotonic_ns()
    first, second = told(tell)
    assert isinstance(first, ev.PoseArrived) and isinstance(second, ev.PoseArrived)
    assert (first.stamp_ns, second.stamp_ns) == (1, 2)
    assert before_ns < first.received_ns < second.received_ns < time.monotonic_ns()


def test_a_page_that_shows_no_images_is_sent_none() -> None:
    here, there = Pipe()
    feed = ViewFeed(there, collect_s=0.01, has_images=False)
    feed.add_effect(AddRun(KEY, hello_of("ann", 1)))
    feed.add_effect(AddKeyframe(KEY, mc.keyframe(KEY, 0).keyframe))
    threading.Thread(target=feed.close, daemon=True).start()
    got: list[ev.RoomEvent] = []
    while (data := here.recv_bytes()) != END:
        got += pickle.loads(data)
    (shown,) = (one for one in got if isinstance(one, ev.KeyframeArrived))
    assert shown.jpeg == b"" and mc.keyframe(KEY, 0).keyframe.image.jpeg.size and len(shown.points)


def test_keyframes_of_a_run_that_comes_back_are_told() -> None:
    def tell(feed: ViewFeed) -> None:
        feed.begin_session(None, [RestoredRun(KEY, hello_of("ann", 1), None)])
        feed.add_effect(AddKeyframe(KEY, mc.keyframe(KEY, 3).keyframe))

    begun, shown = told(tell)
    assert begun == ev.SessionBegun(None) and isinstance(shown, ev.KeyframeArrived)


def test_of_refusals_the_newest_of_each_agent_is_told() -> None:
    refusals = [
        WriteEvent({"t_s": k, "event": "loop refused", "agent": name, "reason": f"{k} inliers"})
        for k in range(50)
        for name in ("ann", "bob")
    ]
    others = WriteEvent({"t_s": 1.0, "event": "correction", "agent": "ann", "reason": "solved"})
    said = [one for one in effects(*refusals, others) if isinstance(one, ev.DecisionMade)]
    assert {one.event for one in said} == {"loop refused"}
    assert {one.agent: one.reason for one in said} == {"ann": "49 inliers", "bob": "49 inliers"}


def test_a_report_is_cut_to_what_is_shown() -> None:
    agent = {"run": KEY, "state": "OK", "gone": False, "last_suspicion": "x" * 10_000, "qoe": 0.5}
    (report,) = told(lambda feed: feed.add_report({"agents": {"ann": agent}, "trouble": ["disk"]}))
    assert isinstance(report, ev.AgentsReported) and report.trouble == ("disk",)
    assert report.agents["ann"]["qoe"] == 0.5 and "last_suspicion" not in report.agents["ann"]


def test_a_viewer_that_stops_reading_holds_nothing_up() -> None:
    """The oldest are dropped; the edge's loop waits for nothing, and memory is bounded."""
    here, there = Pipe()
    feed = ViewFeed(there)
    began_s = time.monotonic()
    say = {"event": "maps merged", "agent": None}
    events = [WriteEvent({"t_s": k, **say, "reason": f"{k}".rjust(5000)}) for k in range(3000)]
    feed.add_effect(AddRun(KEY, hello_of("ann", 1)))
    for event in events:
        feed.add_effect(event)
        feed.add_poses({KEY: pose(1)})
    assert time.monotonic() - began_s < 1.0
    assert feed.left_out > 2000 and len(feed._queue) <= MAX_QUEUED
    threading.Thread(target=feed.close, daemon=True).start()
    got = []
    while (data := here.recv_bytes()) != END:
        got += pickle.loads(data)
    decisions = [one for one in got if isinstance(one, ev.DecisionMade)]
    assert decisions[-1].t_s == 2999 and len(decisions) + feed.left_out in (3000, 3001)
    assert any(isinstance(one, ev.RunArrived) for one in got)  # whatever else was dropped


def test_another_viewer_is_told_what_there_is() -> None:
    here, there = Pipe()
    feed = ViewFeed(there)
    feed.add_effect(AddRun(KEY, hello_of("ann", 1)))
    feed.add_effect(AddKeyframe(KEY, mc.keyframe(KEY, 0).keyframe))
    feed.add_poses({KEY: pose(1)})
    while not any(isinstance(one, ev.PoseArrived) for one in pickle.loads(here.recv_bytes())):
        pass
    here.close()
    feed.add_effect(AddKeyframe(KEY, mc.keyframe(KEY, 1).keyframe))  # while there is no viewer
    feed.add_event(ev.LoopAccepted(KeyframeKey(KEY, 0), KeyframeKey(KEY, 1)))
    time.sleep(0.1)
    here, there = Pipe()
    feed.reconnect(there)
    feed.close()
    got = []
    while (data := here.recv_bytes()) != END:
        got += pickle.loads(data)
    kinds = [type(one) for one in got]
    assert kinds[:5] == [ev.SessionBegun, ev.RunArrived, *[ev.KeyframeArrived] * 2, ev.LoopAccepted]
    assert kinds[-1] == ev.PoseArrived


def test_a_stored_map_is_told_with_its_poses_and_loops() -> None:
    kept = StoredMap(
        (mc.run(mc.ANN),),
        (f"{mc.ANN}/0",),
        tuple(mc.kept_keyframe(mc.ANN, k) for k in range(3)),
        loops=(mc.loop(0, 2),),
    )
    told = list(map_events(kept))
    kinds = [type(one) for one in told]
    assert kinds == [ev.RunArrived, *[ev.KeyframeArrived] * 3, ev.MapsSolved, ev.LoopAccepted]
    solved = told[4]
    assert isinstance(solved, ev.MapsSolved) and len(solved.poses.keys) == 3
