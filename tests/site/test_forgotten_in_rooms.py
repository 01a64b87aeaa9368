"""Pictures that were deleted in one room of a site come back in none, wherever their agent goes on."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.edge_sim import Person, walls
from helpers.site_sim import Site, Walker

from share.protocol import edge_events as ed
from share.store.forgetting import Forgetting
from share.store.map_store import MapStore

LONG = pytest.mark.long
KITCHEN, LAB = walls(1), walls(2)
ROOMS = "kitchen", "lab"
REFUSED = frozenset({("kitchen", "bob"), ("lab", "eve")})  # so that they stay where they are


def after_a_change(folder: Path) -> Site:
    """Ann has walked from the kitchen to the lab, where bob is, and next she walks back."""
    bob, ann = Person("bob", LAB, 0.3, 22), Walker("ann", [KITCHEN, LAB, KITCHEN], 0.0, 11, 16)
    site = Site([ann, bob], ROOMS, REFUSED, folder=folder)
    site.walk(30)
    site.run(1000)
    assert stored(site) == {"kitchen": set(range(18)), "lab": set(range(18, 30))}
    return site


def stored(site: Site, name: str = "ann") -> dict[str, set[int]]:
    """Ids of an agent's keyframes in each room's file."""
    kept = {room: MapStore.read(site.map_file(room)).load() for room in ROOMS}
    return {
        room: {k.keyframe_key.id for k in kept[room].keyframes if k.run_key.startswith(f"{name}-")}
        for room in ROOMS
    }


def restarted(site: Site, *forgetting: str) -> None:
    """The site ends, ann is forgotten in these rooms, and it starts again."""
    site.stop()
    for room in forgetting:
        with MapStore.open(site.map_file(room)) as store:
            Forgetting(store, ["ann"], None).carry_out()
    site.start(200)


@pytest.mark.parametrize(
    "forgetting", [("lab",), pytest.param(("kitchen",), marks=LONG), pytest.param(ROOMS, marks=LONG)]
)
def test_what_was_forgotten_in_a_room_comes_back_in_none(tmp_path: Path, forgetting: tuple[str, ...]) -> None:
    site = after_a_change(tmp_path)
    restarted(site, *forgetting)
    site.walk(2)
    assert site.room_of("ann") == "lab"  # the last that she was in
    site.walk(6)
    site.run(1000)
    kept = stored(site)
    assert {k for k in kept["kitchen"] if k < 30} == (set() if "kitchen" in forgetting else set(range(18)))
    assert {k for k in kept["lab"] if k < 30} == (set() if "lab" in forgetting else set(range(18, 30)))
    assert {k for room in ROOMS for k in kept[room] if k >= 30} == set(range(30, 38))
    assert site.agents[site.peer("ann")].report()["unacknowledged"] == 0
    assert site.events("internal error") == site.events("step failed") == []
    assert stored(site, "bob") == {"kitchen": set(), "lab": set(range(38))}


@pytest.mark.long
def test_a_run_comes_back_to_a_room_that_has_forgotten_it(tmp_path: Path) -> None:
    """It brings new keyframes only."""
    site = after_a_change(tmp_path)
    restarted(site, "kitchen")
    site.arrive(Person("eve", KITCHEN, 3.2, 33))  # ann looks where she has looked
    site.walk(16)
    site.run(1000)
    assert site.room_of("ann") == site.room_of("eve") == "kitchen"
    assert min(stored(site)["kitchen"]) > 30
    with MapStore.read(site.map_file("kitchen")) as store:
        kept = store.load()
    assert {run[:3]: n for run, n in kept.next_ids.items()} == {"ann": 46, "eve": 16}
    assert kept.forgotten == {}


def test_an_agent_that_was_forgotten_while_away_keeps_its_session(tmp_path: Path) -> None:
    """It came from another room, by whose session it knows the site."""
    site = after_a_change(tmp_path)
    lab, peer = site.rooms["lab"], site.peer("ann")
    agent = site.agents.pop(peer)  # out of reach
    site.run(4000)
    keys = [k.keyframe_key for k in lab.store.load().keyframes if k.run_key.startswith("ann-")]
    atlas, run = lab.mapper.atlas, keys[0].agent
    atlas.forget_keyframes([n for n in atlas.graph.poses if atlas.key(n).agent == run])
    emptied = ed.MapperResult((), (), (keys[-1],))
    site.execute(lab, lab.machine.handle(emptied, site.now_ns))
    site.run(100)
    assert lab.machine.run(run) is None
    site.agents[peer] = agent
    site.run(2000)
    site.walk(2)
    assert site.room_of("ann") == "lab"
    assert agent.report()["edge_sessions"] == 1
    assert stored(site) == {"kitchen": set(range(18)), "lab": {30, 31}}
