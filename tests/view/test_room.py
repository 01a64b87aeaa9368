"""What a live room draws of what it is told."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import SavePoses
from share.types import F64, AgentKind, TrackState
from share.view import drawing as dr
from share.view import events as ev
from share.view.agent_paths import KEYFRAMES_PER_CHUNK, PATH_POINTS_PER_CHUNK
from share.view.map_arrangement import MapArrangement
from share.view.room import DrawnRoom

POINTS = np.random.default_rng(1).uniform(1, 3, (20, 3)).astype(np.float32)


def at(x: float, y: float = 0.0) -> F64:
    T = np.eye(4)
    T[:2, 3] = x, y
    return T


def run(name: str, kind: AgentKind = AgentKind.AR) -> ev.RunArrived:
    return ev.RunArrived(f"{name}-1", name, kind, np.eye(4), (0.8, 0.6))


def keyframe(name: str, id_: int, x: float, begins: bool = False, jpeg: bytes = b"") -> ev.KeyframeArrived:
    return ev.KeyframeArrived(KeyframeKey(f"{name}-1", id_), begins, at(x), POINTS, jpeg)


def corrected(name: str, map_id: str, T: F64, segment_keyframe: int = 0) -> ev.CorrectionArrived:
    return ev.CorrectionArrived(f"{name}-1", map_id, T, segment_keyframe)


def pose(name: str, keyframe_id: int, x: float, state: TrackState = TrackState.OK) -> ev.PoseArrived:
    return ev.PoseArrived(f"{name}-1", state, keyframe_id, at(x), 5.0)


def solved(*entries: tuple[str, int, str, F64]) -> ev.MapsSolved:
    keys = tuple(KeyframeKey(f"{name}-1", id_) for name, id_, _, _ in entries)
    return ev.MapsSolved(
        SavePoses(keys, np.array([T for *_, T in entries]), tuple(map_id for _, _, map_id, _ in entries))
    )


def told(room: DrawnRoom, *events: ev.RoomEvent, now_s: float = 0.0) -> list[dr.Drawing]:
    for event in events:
        room.apply(event, now_s)
    return room.take_drawings(now_s)


def one_agent(name: str = "ann", map_id: str = "A", y: float = 0.0) -> list[ev.RoomEvent]:
    return [run(name), keyframe(name, 0, 0.0, begins=True), corrected(name, map_id, at(0.0, y))]


def of(drawings: Iterable[dr.Drawing], prefix: str) -> list[dr.Drawing]:
    return [one for one in drawings if getattr(one, "name", "").startswith(prefix)]


def names(drawings: Iterable[dr.Drawing]) -> set[str]:
    return {getattr(one, "name", type(one).__name__) for one in drawings}


def positions(drawing: dr.Drawing) -> F64:
    assert isinstance(drawing, dr.Lines)
    return drawing.segments + drawing.origin


# ---------------------------------------------------------------- keyframes and points


def test_a_keyframe_is_drawn_once_its_place_is_known() -> None:
    room = DrawnRoom()
    assert not of(told(room, run("ann"), keyframe("ann", 0, 1.0, begins=True)), "/points")
    drawings = told(room, corrected("ann", "A", at(10.0)))
    (points,) = of(drawings, "/points/0/0")
    assert isinstance(points, dr.Points)
    np.testing.assert_allclose(points.points + points.origin, POINTS + np.array([11.0, 0, 0]), atol=1e-5)
    assert len(of(drawings, "/keyframes/0/0")) == 1 and any(isinstance(one, dr.FloorGrid) for one in drawings)


def test_nothing_is_drawn_where_nothing_changed() -> None:
    room = DrawnRoom()
    told(room, *one_agent())
    assert told(room) == [] and room.waiting == 0
    assert told(room, solved(("ann", 0, "A", at(0.001)))) == []  # nobody sees a millimetre


def test_only_the_chunk_of_a_new_keyframe_is_drawn_again() -> None:
    room, count = DrawnRoom(), KEYFRAMES_PER_CHUNK + 2
    told(room, *one_agent(), *(keyframe("ann", k, 0.1 * k) for k in range(1, count)))
    assert names(of(told(room, keyframe("ann", count, 9.0)), "/points")) == {"/points/0/1"}


def test_a_solution_moves_what_has_moved() -> None:
    room = DrawnRoom()
    told(room, *one_agent(), *(keyframe("ann", k, 0.1 * k) for k in range(1, KEYFRAMES_PER_CHUNK + 1)))
    moved = told(room, solved(("ann", 0, "A", at(0.0)), ("ann", KEYFRAMES_PER_CHUNK, "A", at(5.0))))
    (points,) = of(moved, "/points")
    assert points.name == "/points/0/1" and points.origin[0] == 5.0  # type: ignore[union-attr]


def test_so_many_chunks_are_drawn_at_a_time() -> None:
    """A large map is no burst: the rest comes with the next pictures."""
    room, count = DrawnRoom(), 40 * KEYFRAMES_PER_CHUNK
    drawn = told(room, *one_agent(), *(keyframe("ann", k, 0.01 * k) for k in range(1, count)))
    assert 0 < len(of(drawn, "/points")) < 10 and room.waiting > 60
    seen = names(of(drawn, "/points"))
    while room.waiting:
        seen |= names(of(told(room), "/points"))
    assert len(seen) == 40


def test_removed_keyframes_are_gone_and_their_path_stays() -> None:
    room = DrawnRoom()
    told(room, *one_agent(), keyframe("ann", 1, 1.0))
    told(room, *(pose("ann", 1, 0.1 * k) for k in range(5)))
    before = positions(of(told(room, solved(("ann", 1, "A", at(1.5)))), "/paths")[0])
    room.apply(ev.KeyframesRemoved((KeyframeKey("ann-1", 1),)), 0.0)
    after = of(told(room), "/paths")
    np.testing.assert_allclose(positions(after[0]), before, atol=1e-6)
    told(room, ev.KeyframesRemoved((KeyframeKey("ann-1", 0),)))
    assert room.runs["ann-1"].keyframes == {}


# ---------------------------------------------------------------- agents


def test_an_agent_is_where_its_newest_pose_is() -> None:
    room = DrawnRoom()
    told(room, *one_agent(), keyframe("ann", 1, 1.0))
    (body,) = of(told(room, pose("ann", 1, 0.5)), "/agents")
    assert isinstance(body, dr.AgentBody) and body.is_current and body.label == "ann"
    np.testing.assert_allclose(body.T_room_body, at(1.5))
    assert of(told(room), "/agents") == []
    (body,) = of(told(room, corrected("ann", "A", at(0.0)), pose("ann", -1, 4.0)), "/agents")
    np.testing.assert_allclose(body.T_room_body, at(4.0))  # type: ignore[union-attr]


@pytest.mark.parametrize("entry", [{"state": "SILENT", "gone": False}, {"state": "OK", "gone": True}])
def test_an_agent_that_is_not_heard_is_shown_so(entry: dict[str, object]) -> None:
    room = DrawnRoom()
    told(room, *one_agent(), pose("ann", 0, 0.5))
    (body,) = of(told(room, ev.AgentsReported({"ann": {"run": "ann-1", **entry}})), "/agents")
    assert isinstance(body, dr.AgentBody) and not body.is_current


def test_its_newest_picture_is_shown_once() -> None:
    room = DrawnRoom()
    told(room, *one_agent())
    drawings = told(
        room, keyframe("ann", 1, 1.0, jpeg=b"one"), keyframe("ann", 2, 2.0, jpeg=b"two"), pose("ann", 2, 0.0)
    )
    assert [one.jpeg for one in drawings if isinstance(one, dr.Picture)] == [b"two"]
    assert not any(isinstance(one, dr.Picture) for one in told(room, pose("ann", 2, 0.1)))


def test_a_path_grows_by_chunks_that_are_joined() -> None:
    room = DrawnRoom()
    told(room, *one_agent())
    for k in range(PATH_POINTS_PER_CHUNK + 30):
        room.apply(pose("ann", 0, 0.05 * k), 0.0)
    first, second = (positions(one) for one in of(told(room), "/paths"))
    np.testing.assert_allclose(second[0, 0], first[-1, 1], atol=1e-5)
    assert names(of(told(room, pose("ann", 0, 99.0)), "/paths")) == {"/paths/0/1"}
    assert not of(told(room, pose("ann", 0, 99.001)), "/paths")  # it stands still


def test_a_path_is_bounded() -> None:
    room = DrawnRoom()
    told(room, *one_agent())
    for k in range(403 * PATH_POINTS_PER_CHUNK):
        room.apply(pose("ann", 0, 0.05 * k), 0.0)
    assert len(room.runs["ann-1"].path_chunks) <= 400


def test_agents_have_a_colour_each_which_a_new_run_keeps() -> None:
    room = DrawnRoom()
    again = ev.RunArrived("ann-2", "ann", AgentKind.AR, np.eye(4), (1.0, 1.0))
    told(room, run("ann"), run("bob"), again)
    ann, bob, ann_again = (room.colour(one) for one in room.runs.values())
    assert ann == ann_again != bob


# ---------------------------------------------------------------- maps


def two_maps() -> DrawnRoom:
    room = DrawnRoom()
    told(room, *one_agent("ann", "A"), *one_agent("bob", "B"), pose("ann", 0, 0.0), pose("bob", 0, 0.0))
    return room


def test_a_second_map_within_a_chunk_takes_no_place_away() -> None:
    """An agent that is lost begins another map; its first one stays where it was."""
    room = two_maps()
    told(room, keyframe("bob", 1, 1.0, begins=True), corrected("bob", "B2", at(0.0), 1))
    told(room, pose("bob", 1, 0.0))
    (points,) = of(told(room, corrected("ann", "A", at(0.0, 1.0))), "/points")  # only ann's moves
    assert isinstance(points, dr.Points) and points.name.startswith("/points/0/")
    offsets = [room._arrangement.offset(one)[:2].tolist() for one in ("A", "B", "B2")]
    assert offsets == [[0.0, 0.0], [0.0, 10.0], [10.0, 10.0]]
    place = room.agent_place("bob-1")
    assert place is not None and place[:2, 3].tolist() == [11.0, 10.0]


def test_many_maps_stand_in_a_square_each_at_a_place_of_its_own() -> None:
    places = MapArrangement()
    for k in range(30):
        places.put(KeyframeKey("ann-1", k), f"map {k}")
    offsets = np.array([places.offset(f"map {k}")[:2] for k in range(30)])
    assert len(np.unique(offsets, axis=0)) == 30
    assert np.ptp(offsets, axis=0).max() <= 50.0


def test_a_map_without_a_keyframe_gives_its_place_up() -> None:
    room = two_maps()
    drawings = told(room, ev.KeyframesRemoved((KeyframeKey("ann-1", 0),)))
    assert [room._arrangement.offset(one)[1] for one in ("B",)] == [0.0]
    assert any(isinstance(one, dr.Points) and one.name == "/points/1/0" for one in drawings)


@pytest.mark.slow
def test_an_event_of_a_long_session_costs_no_more(soon: None) -> None:
    """600 runs took 9 s, 4,000 keyframes with removals 104 s."""
    room = DrawnRoom()
    for k in range(600):
        told(room, *one_agent(f"a{k}", f"m{k}"), pose(f"a{k}", 0, 0.0))
    rng = np.random.default_rng(1)
    told(room, run("ann"))
    for k in range(2000):
        room.apply(keyframe("ann", k, 0.1 * k, k % 97 == 0), 0.0)
        if k % 13 == 0:
            room.apply(corrected("ann", f"A{k // 500}", at(0.01 * k), k - k % 97), 0.0)
        for j in range(4):
            room.apply(pose("ann", k, 0.1 * j), 0.0)
        if k % 3 == 0:
            room.apply(ev.KeyframesRemoved((KeyframeKey("ann-1", int(rng.integers(0, k + 1))),)), 0.0)
    room.apply(ev.RunRemoved("ann-1"), 0.0)
    for k in range(600):
        room.apply(ev.RunRemoved(f"a{k}-1"), 0.0)
    while room.waiting:
        room.take_drawings(1e4)
    assert not room.has_shown


def test_maps_that_are_not_joined_stand_beside_each_other() -> None:
    room = two_maps()
    ann, bob = room.agent_place("ann-1"), room.agent_place("bob-1")
    assert ann is not None and bob is not None
    assert np.linalg.norm(ann[:3, 3] - bob[:3, 3]) > 9


def test_a_merge_moves_one_map_into_the_other_and_is_announced() -> None:
    room = two_maps()
    drawings = told(
        room,
        corrected("bob", "A", at(2.0)),
        ev.DecisionMade(3.0, "maps merged", "bob", "B into A by 3 loops"),
        now_s=5.0,
    )
    bob = room.agent_place("bob-1")
    assert bob is not None
    np.testing.assert_allclose(bob, at(2.0))
    (points,) = of(drawings, "/points/1")
    assert points.origin[0] == 2.0  # type: ignore[union-attr]
    assert any(isinstance(one, dr.Announcement) and one.text == "B into A by 3 loops" for one in drawings)
    (text,) = of(drawings, "/texts")
    assert isinstance(text, dr.Text) and text.text == "maps merged: bob"
    assert dr.RemoveDrawing("/texts/merge") in told(room, now_s=20.0)


def floors(drawings: Iterable[dr.Drawing]) -> list[dr.FloorGrid]:
    return [one for one in drawings if isinstance(one, dr.FloorGrid)]


def test_the_floor_is_as_wide_as_the_maps() -> None:
    room = DrawnRoom()
    (first,) = floors(told(room, *one_agent("ann", "A")))
    assert not floors(told(room, keyframe("ann", 1, 0.0)))
    (wide,) = floors(told(room, *one_agent("bob", "B")))  # another map, beside it
    assert wide.high[1] > first.high[1] + 5
    (one_map,) = floors(told(room, corrected("bob", "A", at(0.5))))
    assert one_map.high[1] < wide.high[1] - 5


def test_the_last_map_stands_at_the_origin() -> None:
    room = two_maps()
    told(room, corrected("ann", "B", at(3.0)))
    ann = room.agent_place("ann-1")
    assert ann is not None
    np.testing.assert_allclose(ann, at(3.0))


def test_keyframes_of_a_new_segment_wait_for_its_place() -> None:
    room = DrawnRoom()
    told(room, *one_agent(), keyframe("ann", 1, 1.0))
    assert not of(told(room, keyframe("ann", 2, 50.0, begins=True)), "/points")
    told(room, corrected("ann", "A", at(7.0), segment_keyframe=1))  # a late one, of the segment before
    assert room.runs["ann-1"].keyframes[2].T_map_body is None
    told(room, corrected("ann", "C", at(0.0), segment_keyframe=2))
    assert room.runs["ann-1"].keyframes[2].map_id == "C" and room.runs["ann-1"].keyframes[1].map_id == "A"


# ---------------------------------------------------------------- loops and corrections


def test_a_loop_flashes_and_stays() -> None:
    room = two_maps()
    a, b = KeyframeKey("ann-1", 0), KeyframeKey("bob-1", 0)
    drawings = told(room, ev.LoopAccepted(a, b), now_s=1.0)
    assert len(of(drawings, "/loops/0")) == 1 and len(of(drawings, "/loops/new")) == 1
    assert names(told(room, now_s=3.0)) == {"/loops/new/1"}
    assert isinstance(of(told(room, ev.LoopsRemoved(b, a), now_s=3.0), "/loops/0")[0], dr.RemoveDrawing)


def test_loops_follow_their_keyframes_and_go_with_them() -> None:
    room = two_maps()
    told(room, ev.LoopAccepted(KeyframeKey("ann-1", 0), KeyframeKey("bob-1", 0)))
    (lines,) = of(told(room, solved(("bob", 0, "A", at(1.0)))), "/loops/0")
    np.testing.assert_allclose(np.abs(positions(lines)[0, 0] - positions(lines)[0, 1]), [1, 0, 0], atol=1e-6)
    (gone,) = of(told(room, ev.KeyframesRemoved((KeyframeKey("ann-1", 0),))), "/loops/0")
    assert isinstance(gone, dr.RemoveDrawing)


def test_a_correction_is_marked_where_it_is_seen() -> None:
    room = DrawnRoom()
    told(room, *one_agent(), pose("ann", -1, 1.0))
    assert not of(told(room, corrected("ann", "A", at(0.001)), now_s=1.0), "/corrections")
    (mark,) = of(told(room, corrected("ann", "A", at(0.5)), now_s=2.0), "/corrections")
    np.testing.assert_allclose(positions(mark)[0], [[1.001, 0, 0], [1.5, 0, 0]], atol=1e-6)
    assert room.corrections["ann-1"].moved_m == pytest.approx(0.499)
    assert of(told(room, now_s=9.0), "/corrections") == [dr.RemoveDrawing(mark.name)]  # type: ignore[union-attr]


# ---------------------------------------------------------------- beginnings and ends


def test_a_new_session_removes_what_was_drawn() -> None:
    room = DrawnRoom()
    told(room, *one_agent(), keyframe("ann", 1, 1.0), pose("ann", 1, 0.0), pose("ann", 1, 1.0))
    told(room)
    gone = told(room, ev.SessionBegun())
    assert {one.name for one in gone if isinstance(one, dr.RemoveDrawing)} >= {
        "/points/0/0",
        "/agents/0",
        "/paths/0/0",
    }
    again = told(room, *one_agent())
    assert names(of(again, "/points")) == {"/points/1/0"}


def test_a_forgotten_run_is_removed() -> None:
    room = two_maps()
    told(room)
    gone = told(room, ev.RunRemoved("bob-1"))
    assert {one.name for one in gone if isinstance(one, dr.RemoveDrawing)} >= {"/points/1/0", "/agents/1"}


@pytest.mark.parametrize(
    "event",
    [
        keyframe("nobody", 0, 0.0),
        pose("nobody", 0, 0.0),
        corrected("nobody", "A", at(0.0)),
        solved(("nobody", 0, "A", at(0.0))),
        ev.LoopAccepted(KeyframeKey("nobody", 0), KeyframeKey("ann-1", 77)),
        ev.LoopsRemoved(KeyframeKey("nobody", 0), KeyframeKey("ann-1", 77)),
        ev.KeyframesRemoved((KeyframeKey("nobody", 0), KeyframeKey("ann-1", 77))),
        ev.RunRemoved("nobody"),
        ev.DecisionMade(0.0, "maps merged", "nobody", "x"),
        pose("ann", 77, 0.0),
    ],
    ids=lambda event: type(event).__name__,
)
def test_what_was_dropped_before_does_no_harm(event: ev.RoomEvent) -> None:
    """The feed drops its oldest entries, so any event may concern something unknown."""
    room = DrawnRoom()
    told(room, *one_agent(), event, keyframe("ann", 1, 1.0))
    assert len(room.runs["ann-1"].keyframes) == 2


def test_what_happens_while_nobody_looks_is_drawn_later_and_what_was_shown_for_a_moment_is_not() -> None:
    room = two_maps()
    room.take_drawings(0.0)
    for k in range(200):
        room.apply(keyframe("ann", k + 1, 0.01 * k), float(k))
        room.apply(ev.LoopAccepted(KeyframeKey("ann-1", k + 1), KeyframeKey("bob-1", 0)), float(k))
        room.apply(ev.DecisionMade(float(k), "maps merged", "ann", "three loops"), float(k))
        room.forget_moments(float(k))
    assert room.waiting < 60  # chunks, and what the last seconds flashed
    drawings = list[dr.Drawing]()
    room.forget_moments(1e3)
    while room.waiting:
        drawings += room.take_drawings(1e3)
    assert {"/points/0/0", "/loops/0"} <= names(drawings)
    assert not of(drawings, "/loops/new") and dr.Announcement.__name__ not in names(drawings)


def test_of_merges_that_come_together_three_are_announced() -> None:
    """Thirty notices run off the page."""
    room = two_maps()
    merges = [ev.DecisionMade(1.0, "maps merged", "ann", f"merge {k}") for k in range(30)]
    assert sum(isinstance(one, dr.Announcement) for one in told(room, *merges, now_s=10.0)) == 3
    assert not any(isinstance(one, dr.Announcement) for one in told(room, merges[0], now_s=13.0))
    assert any(isinstance(one, dr.Announcement) for one in told(room, merges[0], now_s=16.5))
