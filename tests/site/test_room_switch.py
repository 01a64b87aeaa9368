"""Agents that walk from room to room, in virtual time: real agents, state machines, mappers and solvers."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from helpers.edge_sim import MS, Person, Weather, walls
from helpers.site_sim import Site, T_map_world, Walker

from share.geometry import se3
from share.protocol import agent_events as ev
from share.protocol.common_events import Connected, PrintLine
from share.protocol.edge_events import AddKeyframe, PeerMessageReceived
from share.site import room_switch
from share.site.room_switch import RoomSwitch
from share.wire.codec import encode
from share.wire.messages import Bye, Ping

KITCHEN, LAB = walls(1), walls(2)
ONLY_IN_LAB = frozenset({("kitchen", "bob")})  # so that bob begins there


def two_rooms(frames: int = 40, per_room: int = 16, places=(KITCHEN, LAB), **changes) -> Site:
    """Bob walks round the lab; ann comes there from the kitchen."""
    bob, ann = Person("bob", LAB, 0.3, 22), Walker("ann", list(places), 0.0, 11, per_room)
    site = Site([ann, bob], ("kitchen", "lab"), **{"refused": ONLY_IN_LAB} | changes)
    site.walk(frames)
    site.run(1000)
    return site


@pytest.fixture(scope="module")
def walked() -> Site:
    return two_rooms()


def kept_keyframes(site: Site, name: str) -> dict[str, list[int]]:
    return {
        room: sorted(k.id for k in one.mapper.current_poses().keys if k.agent.startswith(f"{name}-"))
        for room, one in site.rooms.items()
    }


def changes_of(site: Site) -> list[tuple[str, str]]:
    return [(e["room"], e["reason"]) for e in site.events("room changed")]


def test_an_agent_goes_on_in_the_next_room(walked):
    assert changes_of(walked) == [
        ("kitchen", "goes on in room 'lab'"),
        ("lab", "comes from room 'kitchen'"),
    ]
    assert walked.room_of("ann") == walked.room_of("bob") == "lab"
    entered_s = walked.events("room changed")[1]["t_s"]
    assert 17 * 0.25 <= entered_s <= 17 * 0.25 + 0.1  # by its second keyframe there; a step takes 5 ms


def test_each_keyframe_is_in_one_room(walked):
    kept = kept_keyframes(walked, "ann")
    assert kept["kitchen"] == list(range(18))
    assert kept["lab"] == list(range(18, 40))
    report = walked.agents[walked.peer("ann")].report()
    assert report["unacknowledged"] == report["pending"] == 0
    assert report["sent"] == 40
    assert report["resent"] == 0


def test_many_strangers_do_not_take_an_agent_back_to_the_room_that_it_left(monkeypatch):
    """Both rooms know it, by as many keyframes: it was in both at once."""
    monkeypatch.setattr(room_switch, "_MAX_ROUTES", 2)
    site = two_rooms(frames=17)
    site.walk(1)
    while not site.switch.changes:
        site.run(1)
    ann = site.peer("ann")
    assert {room: one.knows(ann) for room, one in site.rooms.items()} == {"kitchen": 18, "lab": 18}
    for k in range(3):
        site.to_edge(PeerMessageReceived(bytes([k]) * 16, [bytes(f) for f in encode(Ping(1, 1))]))
    site.run(700)
    assert not site.rooms["kitchen"].is_present("ann")
    assert site.rooms["lab"].is_present("ann")


def test_the_agent_is_not_told(walked):
    lines = [line.text for line in walked.event(PrintLine, "ann")]
    assert lines == ["connected to the edge"]
    assert walked.agents[walked.peer("ann")].report()["edge_sessions"] == 1


def test_the_place_in_the_new_map_is_right_at_once(walked):
    ann, poses = walked.people[walked.peer("ann")], walked.poses("ann")
    bob_map = T_map_world(walked.people[walked.peer("bob")], walked.poses("bob")[-1], 39)
    first = next(i for i, pose in enumerate(poses) if (pose.map_id or "").startswith("bob-"))
    assert first == 18
    for frame in range(first, 40):
        assert poses[frame].map_id.startswith("bob-")  # never into a map of its own on the way
        T = se3.inverse(bob_map) @ T_map_world(ann, poses[frame], frame)
        assert np.linalg.norm(T[:3, 3]) < 0.15


def test_the_door_ties_both_maps(walked):
    """Ann began at the first place of the kitchen's frame; bob's map has bob's."""
    ann, bob = (walked.people[walked.peer(name)] for name in ("ann", "bob"))
    (kitchen, lab) = sorted(walked.switch.building.poses, key=lambda one: one.room)
    pose = walked.switch.building.poses[lab]
    assert pose.reference == kitchen
    T_kitchen_odom = np.eye(4)  # its map is the odom frame in which ann began
    T_lab_odom = walked.poses("ann")[-1].T_map_odom
    T = se3.inverse(T_kitchen_odom @ se3.inverse(T_lab_odom)) @ pose.T_building_map
    assert np.linalg.norm(T[:3, 3]) < 0.3  # odometry drifts meanwhile
    assert (kitchen.map_id.split("-")[0], lab.map_id.split("-")[0]) == (ann.name, bob.name)


def test_odometry_is_what_it_is_without_an_edge(walked):
    ann = walked.people[walked.peer("ann")]
    assert all(
        np.array_equal(p.T_odom_body, T) for p, T in zip(walked.poses("ann"), ann.T_odom_body, strict=True)
    )


def test_revisions_rise_through_both_rooms(walked):
    revisions = [c.revision for c in walked.event(ev.CorrectionApplied, "ann")]
    assert revisions == sorted(set(revisions))
    assert walked.agents[walked.peer("ann")].report()["corrections_stale"] == 0


def test_it_may_come_back():
    site = two_rooms(60, places=(KITCHEN, LAB, KITCHEN), per_room=18)
    assert [room for room, _ in changes_of(site)] == ["kitchen", "lab", "lab", "kitchen"]
    kept = kept_keyframes(site, "ann")
    assert sorted(kept["kitchen"] + kept["lab"]) == list(range(60))
    assert min(kept["lab"]) == 20
    assert max(kept["lab"]) < 58  # it looks where it has looked before from some 54 on
    assert site.events("internal error") == site.events("step failed") == []
    maps = [pose.map_id for pose in site.poses("ann")]
    assert maps[1] == maps[-1]  # the kitchen's


def test_what_is_acknowledged_is_on_a_disk():
    site = two_rooms(disk_ms=60.0)
    assert site.room_of("ann") == "lab"
    kept = kept_keyframes(site, "ann")
    assert sorted(kept["kitchen"] + kept["lab"]) == list(range(40))
    assert site.agents[site.peer("ann")].report()["unacknowledged"] == 0


def test_a_run_stays_while_its_keyframes_wait_for_the_disk():
    site = two_rooms(30, disk_ms=1e6)
    assert site.room_of("ann") == "kitchen"
    assert changes_of(site) == []
    assert site.agents[site.peer("ann")].report()["acknowledged"] == 0


def test_rooms_that_look_alike_hold_nobody():
    carl, dora = Person("carl", LAB, 0.3, 22), Person("dora", LAB, 0.3, 44)
    ann = Walker("ann", [KITCHEN, LAB], 0.0, 11, 16)
    alone = {"carl": "lab", "dora": "twin", "ann": "kitchen"}
    rooms = ("kitchen", "lab", "twin")
    refused = frozenset((room, name) for name in ("carl", "dora") for room in rooms if alone[name] != room)
    site = Site([ann, carl, dora], rooms, refused)
    site.walk(40)
    assert changes_of(site) == []


def test_a_room_that_one_may_not_enter_is_not_searched():
    site = two_rooms(refused=ONLY_IN_LAB | {("lab", "ann")})
    assert changes_of(site) == []
    assert site.room_of("ann") == "kitchen"


def test_a_bad_network_costs_no_keyframe():
    weather = Weather(5, loss=0.2, twice=0.1, delay_ms=(2.0, 60.0))
    site = two_rooms(60, weather=weather)
    site.run(4000)
    assert site.room_of("ann") == "lab"
    kept = kept_keyframes(site, "ann")
    assert Counter(kept["kitchen"] + kept["lab"]) == Counter(range(60))


def test_a_reconnection_finds_the_new_room(walked):
    site = two_rooms(24)
    assert site.room_of("ann") == "lab"
    peer = site.peer("ann")
    site.to_agent(peer, Connected())
    site.walk(8)
    assert site.room_of("ann") == "lab"
    assert [line.text for line in site.event(PrintLine, "ann")][-1] == "connected to the edge"
    assert site.agents[peer].report()["edge_sessions"] == 1


def test_a_switch_asks_nothing_of_a_run_that_has_left():
    site = two_rooms(12)
    peer = site.peer("ann")
    site.to_agent(peer, ev.InputFinished())
    site.run(2000)
    before = site.switch.changes
    site.switch.tick(site.now_ns + 10**12 * MS)
    assert site.switch.changes == before


def test_keyframes_of_a_silent_run_are_kept_for_a_minute_only():
    """Those are images of a room, whose map may have forgotten them."""
    site = two_rooms(12)
    (key,) = (run for run in site.switch._keyframes if run.startswith("ann-"))
    site.switch.tick(site.now_ns + 50_000 * MS)
    assert key in site.switch._keyframes
    assert key in site.switch._finder._runs
    site.switch.tick(site.now_ns + 61_000 * MS)
    assert not site.switch._keyframes
    assert not site.switch._finder._runs


def test_odometry_that_begins_anew_ends_what_was_found():
    site = two_rooms(17)
    (key,) = (run for run in site.switch._keyframes if run.startswith("ann-"))
    assert [one.room for one in site.switch._finder._runs[key].finds] == ["lab"]
    keyframe = site.keyframes("ann")[-1]
    for reference, finds in ((keyframe.id - 1, 1), (-1, 0)):
        site.switch.add_keyframe(AddKeyframe(key, replace(keyframe, reference=reference), False), site.now_ns)
        assert len(site.switch._finder._runs[key].finds) == finds


def test_a_name_that_no_room_lets_in_has_no_room():
    site = two_rooms(1)
    hello = encode(replace(site.people[site.peer("ann")].hello, name="eve", run_id=99))
    switch = RoomSwitch(site.rooms, lambda room, name: name != "eve")
    assert switch.room_of(b"12345678", hello) is None
    assert switch.room_of(b"12345678", [b"\xff"]) == "kitchen"  # which counts it as bad
    assert switch.room_of(b"12345678", encode(Bye())) == "kitchen"


def test_a_second_agent_of_a_name_meets_the_first_in_its_room():
    site = two_rooms()
    hello = encode(replace(site.people[site.peer("ann")].hello, run_id=99))
    assert site.switch.room_of(b"12345678", hello) == "lab"
