from __future__ import annotations

import numpy as np

from share.cli.edge_output import run_summary
from share.site.building import BuildingPose, RoomMap
from share.site.report import site_plan, site_report


def room(agents: dict, **fields) -> dict:
    lines = {name: [] for name in ("refused", "trouble", "degraded", "agent_trouble")}
    about = {"session": 1, "policy": "share", "version": "0", "config": {}, "clients": [], "unjoined": {}}
    return {**about, **lines, "agents": agents, "maps": {}} | fields


def agent(gone: bool, last_received_s: float | None = 0.1, keyframes: int = 1) -> dict:
    return {"gone": gone, "last_received_s": last_received_s, "keyframes": keyframes}


def test_an_agent_is_reported_by_the_room_where_it_is():
    here = {"ann": agent(False, keyframes=9), "bob": agent(True, 5.0)}
    before = {"ann": agent(True, 2.0), "bob": agent(True, 60.0), "cy": agent(True, None)}
    for reports in ({"lab": room(here), "hall": room(before)}, {"hall": room(before), "lab": room(here)}):
        report = site_report(reports, {})
        assert {name: one["room"] for name, one in report["agents"].items()} == {
            "ann": "lab",
            "bob": "lab",
            "cy": "hall",
        }
        assert report["rooms"]["lab"]["agents"] == 1
        assert report["rooms"]["hall"]["agents"] == 0


def test_counts_that_are_zero_in_all_rooms_are_counts_too():
    """Without them the site ended with a KeyError, once its maps had loops and no merge."""
    counts = {"loops": {"tried": 3, "accepted": 0}, "merges": {"requested": 0, "skipped": 0, "done": 0}}
    report = site_report({"lab": room({}, **counts), "hall": room({}, **counts), "cellar": room({})}, {})
    assert report["loops"] == {"tried": 6, "accepted": 0}
    assert run_summary(report) == "loops: 6 tried, 0 accepted; 0 merges"


def test_lines_name_their_room_and_counts_are_added():
    report = site_report(
        {
            "lab": room({}, trouble=["no disk"], maps={"a/0": 3}, waiting=2, loops={"tried": 4}),
            "hall": room({}, maps={"b/0": 5}, waiting=1, loops={"tried": 1}, loading="loading the map: 9"),
        },
        {RoomMap("lab", "a/0"): BuildingPose(RoomMap("hall", "b/0"), np.eye(4))},
    )
    assert report["trouble"] == ["room 'lab': no disk"]
    assert report["maps"] == {"a/0": 3, "b/0": 5}
    assert report["waiting"] == 3
    assert report["loops"] == {"tried": 5}
    assert report["rooms"]["hall"]["keyframes"] == 5
    assert report["rooms"]["lab"]["place"]["in_map_of"] == "hall"
    assert "place" not in report["rooms"]["hall"]
    assert report["loading"] == "hall: loading the map: 9"


def test_the_plan_has_the_paths_of_all_rooms_and_one_place():
    def path(map_id: str, x: float) -> dict:
        return {"map_id": map_id, "position": [x, 0.0], "parts": [{"map_id": map_id, "path": []}]}

    plans = {"hall": {"agents": {"ann": path("a/0", 1.0)}}, "lab": {"agents": {"ann": path("b/0", 2.0)}}}
    for where, x in (("hall", 1.0), ("lab", 2.0)):
        shown = site_plan(plans, {"ann": {"room": where}})["agents"]["ann"]
        assert shown["position"] == [x, 0.0]
        assert [part["map_id"] for part in shown["parts"]] == ["a/0", "b/0"]


def test_a_room_counts_the_maps_that_it_does_not_list():
    unlisted = {"unlisted_runs": 7, "unlisted_maps": 3, "unlisted_keyframes": 20}
    report = site_report(
        {"lab": room({}, maps={"a/0": 3}, **unlisted), "hall": room({}, unlisted_runs=1)}, {}
    )
    lab, hall = report["rooms"]["lab"], report["rooms"]["hall"]
    assert (lab["maps"], lab["keyframes"], lab["unlisted_runs"]) == (4, 23, 7)
    assert (hall["maps"], hall["keyframes"]) == (0, 0)
    assert [report[name] for name in unlisted] == [8, 3, 20]
