"""What is checked before a trial, on reports of the edge's own making."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from share.lab.study.floor import SPOT_ID, STUDY_NAME
from share.lab.study.readiness import LEAST_FREE_BYTES, RoomState, check_room
from share.wire.room_messages import ObjectKind, RoomObject

MAP = "ann-1/0"


def agent(kind: str, **changes: Any) -> dict[str, Any]:
    well = {"kind": kind, "state": "OK", "reason": "", "gone": False, "trouble": [], "map_id": MAP}
    return well | {"clock_error_ms": 0.4, "pose_ms": 9.0} | changes


def marker(number: int = 7, owner: str = "lead", map_id: str = MAP) -> dict[int, RoomObject]:
    return {number: RoomObject(1, 1, number, ObjectKind.MARKER, owner, map_id, np.eye(4))}


def room(**changes: Any) -> RoomState:
    robot = {"map_id": MAP, "pose": [1.0, 2.0, 0.0], "text": ""}
    report = {"agents": {"ann": agent("ar"), "bot": agent("robot")}, "robots": {"bot": robot}}
    report |= changes.pop("report", {})
    state = {
        "report": report,
        "trouble": "",
        "objects": marker(),
        "robot_age_s": 0.2,
        "free_bytes": 10**11,
    }
    return RoomState(**(state | changes))


def bad(state: RoomState) -> dict[str, str]:
    return {one.name: one.text for one in check_room(state) if not one.is_well}


def test_a_room_where_all_is_well() -> None:
    checks = check_room(room())
    assert [one.name for one in checks] == [
        *("disk", "edge", "agents", "clocks", "poses", "map", "robot", "marker")
    ]
    assert all(one.is_well for one in checks), [one.line for one in checks]


@pytest.mark.parametrize(
    ("report", "names", "says"),
    [
        ({"trouble": ["the disk is slow"]}, ["edge"], "the disk is slow"),
        ({"loading": "map"}, ["edge"], "wait"),
        ({"agents": {"bot": agent("robot")}}, ["agents"], "no headset: start its `share agent … --kind ar`"),
        ({"agents": {"ann": agent("ar")}}, ["agents"], "no robot"),
        (
            {"agents": {"ann": agent("ar", state="LOST", reason="lost for 3 s"), "bot": agent("robot")}},
            ["agents"],
            "ann LOST: lost for 3 s",
        ),
        (
            {
                "agents": {
                    "ann": agent("ar", trouble=["its clock is not synchronised: known to 40 ms"]),
                    "bot": agent("robot"),
                }
            },
            ["clocks"],
            "ann: its clock is not synchronised",
        ),
        (
            {"agents": {"ann": agent("ar", clock_error_ms=None), "bot": agent("robot")}},
            ["clocks"],
            "ann: not known yet",
        ),
        (
            {
                "agents": {
                    "ann": agent("ar", trouble=["poses are 55 ms old, limit 20 ms"]),
                    "bot": agent("robot"),
                }
            },
            ["poses"],
            "ann: poses are 55 ms old",
        ),
        ({"agents": {"ann": agent("ar", pose_ms=None), "bot": agent("robot")}}, ["poses"], "none yet"),
        (
            {"agents": {"ann": agent("ar"), "bot": agent("robot", map_id="bot-2/0")}},
            ["map"],
            "ann in ann-1/0, bot in bot-2/0",
        ),
        ({"agents": {"ann": agent("ar", map_id=None), "bot": agent("robot")}}, ["map"], "ann in none yet"),
        ({"robots": {}}, ["robot"], "start `share robot bridge"),
        (
            {"robots": {"bot": {"map_id": MAP, "pose": None, "text": "goals are not allowed"}}},
            ["robot"],
            "goals are not allowed",
        ),
        (
            {"robots": {"bot": {"map_id": None, "pose": None, "text": ""}}},
            ["robot"],
            "its place is not known",
        ),
        (
            {"robots": {"bot": {"map_id": "x/0", "pose": [0, 0, 0], "text": ""}}},
            ["marker"],
            "in ann-1/0, the robot in x/0",
        ),
    ],
)
def test_what_is_not_well_says_what_to_do(report: dict[str, Any], names: list[str], says: str) -> None:
    found = bad(room(report=report))
    assert list(found) == names and says in found[names[0]]


def test_the_rest_of_the_room() -> None:
    assert "make room" in bad(room(free_bytes=LEAST_FREE_BYTES - 1))["disk"]
    assert (
        "silent" in bad(room(robot_age_s=5.0))["robot"] and "silent" in bad(room(robot_age_s=None))["robot"]
    )
    assert "none: place one" in bad(room(objects={}))["marker"]
    assert "2, of lead, ann" in bad(room(objects=marker() | marker(8, "ann")))["marker"]
    assert not bad(room(objects=marker() | marker(SPOT_ID, STUDY_NAME)))  # the study's own


def test_an_edge_that_does_not_answer_is_all_that_is_said() -> None:
    state = RoomState(None, "connection refused", {}, None, 10**11)
    assert bad(state) == {"edge": "no answer: connection refused"}


def test_agents_that_have_left_are_not_missed() -> None:
    agents = {"ann": agent("ar"), "bot": agent("robot"), "old": agent("ar", gone=True, state="LOST")}
    assert not bad(room(report={"agents": agents}))
