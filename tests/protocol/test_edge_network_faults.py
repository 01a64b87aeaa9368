"""Real agents, edge and mapper over networks that lose, duplicate, reorder and delay, in virtual time."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers.edge_sim import Person, Town, Weather, walls

NAMES = ("ann", "bob", "cy")
FRAMES = 44
BAD = {"twice": 0.1, "at_once": 0.25, "delay_ms": (0.0, 500.0)}


@cache
def walked(seed: int, loss: float, **network) -> Town:
    """Agents walk most of the ring, and then stand until everything has arrived and is solved."""
    place = walls(seed)
    people = [Person(name, place, 1.5 * i, 100 * seed + 11 * (i + 1)) for i, name in enumerate(NAMES)]
    town = Town(people, weather=Weather(seed, loss, **network))
    town.walk(FRAMES)
    for _ in range(60):
        town.run(1000)
        if not any(agent.report()["pending"] for agent in town.agents.values()):
            break
    town.run(1000)
    return town


def check_nothing_lost(town: Town) -> None:
    keys = town.edge.mapper.current_poses().keys
    assert len(keys) == len(set(keys)) == FRAMES * len(NAMES)
    for agent in town.agents.values():
        report = agent.report()
        assert (report["pending"], report["keyframes"], report["acknowledged"]) == (0, FRAMES, FRAMES)
        assert report["edge_sessions"] == 1
    assert not [r for r in town.records if r["event"] in ("bad message", "step failed", "odometry suspect")]
    added = {name: a["keyframes"] for name, a in town.edge.report()["agents"].items()}
    assert added == dict.fromkeys(NAMES, FRAMES)


def check_loss(seeds: range, losses: tuple[float, ...]) -> list[float]:
    """Ratio of the map's error to that over a perfect network, for the worst of `losses`."""
    ratios = []
    for seed in seeds:
        clean = walked(seed, 0.0)
        check_nothing_lost(clean)
        for loss in losses:
            town = walked(seed, loss, **BAD)
            check_nothing_lost(town)
            ratio = town.map_error(NAMES) / clean.map_error(NAMES)
            resent = sum(agent.report()["resent"] for agent in town.agents.values())
            errors = f"{1e3 * town.map_error(NAMES):.2f} mm of {1e3 * clean.map_error(NAMES):.2f}"
            print(f"seed {seed}, loss {loss:.0%}: {errors}, {ratio:.3f}; {resent} sent again")
        ratios.append(ratio)
    return ratios


@pytest.mark.slow
def test_a_loss_of_a_fifth_costs_no_keyframe_and_no_accuracy():
    assert max(check_loss(range(1, 2), (0.2,))) <= 1.1


@pytest.mark.slow
def test_all_networks_and_several_rooms():
    ratios = check_loss(range(2, 10), (0.0, 0.05, 0.2))
    print(f"at 20 % loss: median {np.median(ratios):.3f}, worst {max(ratios):.3f}")
    assert np.median(ratios) <= 1.1


@pytest.mark.long
def test_two_agents_with_a_fifth_of_the_messages_lost():
    place = walls(1)
    town = Town(
        [Person("ann", place, 0.0, 111), Person("bob", place, 0.3, 122)], weather=Weather(1, 0.2, **BAD)
    )
    town.walk(16)
    town.run(30_000)
    assert [agent.report()["pending"] for agent in town.agents.values()] == [0, 0]
    keys = town.edge.mapper.current_poses().keys
    assert len(keys) == len(set(keys)) == 32
