"""One agent has wrong odometry: the map of the others stays right to millimetres."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers.bad_people import Blind, Leaper, Miscalibrated, WrongClock
from helpers.edge_sim import Person, Town, walls

GOOD = ("ann", "bob")
FRAMES = 48
MOST_M = 0.007  # error of the good agents; 4 mm beside a stranger in another room
SURE = 4e-8 * np.eye(6)  # a hundredth of what it should be
APART = ("baseline 10 % off", "baseline 3 % off", "baseline 3 % off, too sure", "baseline 5 % less, too sure")

BAD = {
    "focal length 10 % off": (Miscalibrated, {"scale": (1.0, 1.0, 1.1)}),
    "baseline 10 % off": (Miscalibrated, {"scale": (1.1, 1.1, 1.1)}),
    "baseline 3 % off": (Miscalibrated, {"scale": (1.03, 1.03, 1.03)}),
    "baseline 3 % off, too sure": (Miscalibrated, {"scale": (1.03, 1.03, 1.03), "cov": SURE}),
    "baseline 5 % less, too sure": (Miscalibrated, {"scale": (0.95, 0.95, 0.95), "cov": SURE}),
    "extrinsics 5 deg off": (Miscalibrated, {"tilt": (0.0, np.radians(5.0), 0.0)}),
    "clock an hour off": (WrongClock, {}),
    "leaps": (Leaper, {}),
    "sees nothing": (Blind, {"see": 0}),
    "sees one point": (Blind, {"see": 1}),
    "covariance zero": (Person, {"cov": np.zeros((6, 6))}),
    "covariance huge": (Person, {"cov": 1e11 * np.eye(6)}),
    "covariance of rank one": (Person, {"cov": np.full((6, 6), 1e-3)}),
}


@cache
def walked(bad: str | None) -> Town:
    """None: the odometry of eve is right, in another room."""
    place = walls(1)
    people = [Person(name, place, 1.5 * i, 100 + 11 * (i + 1)) for i, name in enumerate(GOOD)]
    kind, more = (Person, {}) if bad is None else BAD[bad]
    people.append(kind("eve", place if bad else walls(2), 3.0, 133, **more))
    town = Town(people)
    town.walk(FRAMES)
    town.run(2000)
    return town


@pytest.mark.slow
@pytest.mark.parametrize("bad", BAD)
def test_a_wrong_agent_does_not_distort_the_map_of_others(bad):
    clean, town = walked(None), walked(bad)
    ratio = town.map_error(GOOD) / clean.map_error(GOOD)
    maps = town.edge.report()["agents"]
    joins = maps["eve"]["map_id"] == maps["ann"]["map_id"]
    loops = maps["eve"]["loops"]
    print(
        f"{bad}: eve {'joins' if joins else 'stays alone'}, {loops}, "
        f"others {1e3 * town.map_error(GOOD):.2f} mm, {ratio:.3f} of {1e3 * clean.map_error(GOOD):.2f}; "
        f"eve {100 * town.map_error(('eve',)):.2f} cm"
    )
    assert town.edge.report()["failed_steps"] == 0
    assert town.map_error(GOOD) <= MOST_M
    states = {name: agent["consistency"]["state"] for name, agent in maps.items()}
    assert all(states[name] != "quarantined" for name in GOOD)
    if bad in APART:
        assert states["eve"] == "quarantined"
        assert maps["eve"]["map_id"] != maps["ann"]["map_id"]
        assert any(r["event"] == "agent quarantined" and "calibration" in r["reason"] for r in town.records)
