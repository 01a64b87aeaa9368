"""What the headset page knows of the room, and what hands do in it; what it repeats of elsewhere."""

from __future__ import annotations

import json
import re
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from helpers.browser import BrowserPage
from helpers.headset_room import PAGE

from share.colours import AGENT_COLOURS

pytestmark = pytest.mark.long

ROOM = """
    const { Room } = await import("/room.js"), { Interaction } = await import("/interaction.js");
    const room = new Room(), sent = [];
    const connection = {
        put: (id, kind, mapId, position, quaternion) => sent.push({ id, kind, mapId, position, quaternion }),
        remove: (id) => sent.push({ removed: id }),
    };
    const place = { mapId: "a", floorZ: -1.5, T_map_local: null };
    const hand = new Interaction(room, connection, place);
    hand.may = true;
    const objects = (...objects) => room.apply({ type: "objects", objects, removed: [] }, 0);
    const upright = { owner: "ben", quaternion: [0, 0, 0, 1] };
    const one = (id, kind, map_id, position) => ({ id, kind, map_id, position, ...upright });
    const ray = (origin, direction, T_map_pointer = null) => ({ origin, direction, T_map_pointer });
    const at = (id) => { room.update(now); return [...room.objects.get(id).shown.slice(12, 15)]; };
    let now = 0;
"""


def run_room(page: BrowserPage, script: str) -> Any:
    """Return what a script returns of a room without a browser's page."""
    return page.evaluate(f"(async () => {{ {ROOM} {script} }})()")


def test_a_marker_is_dragged_along_the_floor_and_a_cube_with_the_hand(modules: BrowserPage) -> None:
    found = run_room(
        modules,
        """
        const down = ray([0, 0, 0], [0.6, 0, -0.8]);
        hand.arm("marker");
        hand.press(down, 0);
        const id = sent[0].id;
        const placed = at(id);
        down.direction = [0, 0.6, -0.8];
        hand.move(down, 10);  // too soon to be told
        const told = sent.length;
        hand.move(down, 40);
        hand.release(down, 41);
        const dragged = [told, sent.length, at(id), sent.at(-1).position];
        objects(one(7, "cube", "a", [2, 0, 0]));
        const T = Float64Array.from([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
        const grip = ray([0, 0, 0], [1, 0, 0], T);
        hand.press(grip, 100);
        T.set([0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1, 1]);  // a quarter turn to the left, 1 m up
        hand.move(grip, 140);
        objects(one(7, "cube", "a", [9, 9, 9]));  // of another hand, meanwhile
        const held = [at(7), sent.at(-1).quaternion];
        hand.release(grip, 150);
        room.objects.get(7).request = 5;
        room.apply({ type: "receipt", request: 5, reason: "no" }, 0);
        return [placed, dragged, held, at(7), hand.armed];
        """,
    )
    placed, (told, sent, dragged, put), (held, turned), back, armed = found
    assert np.allclose(placed, [1.125, 0, -1.5]) and np.allclose(dragged, [0, 1.125, -1.5])
    assert (told, sent) == (1, 3) and np.allclose(put, dragged) and armed is None
    assert np.allclose(held, [0, 2, 1]) and np.allclose(turned, [0, 0, np.sqrt(0.5), np.sqrt(0.5)])
    assert np.allclose(back, [9, 9, 9])  # refused: the edge's


def test_objects_stay_in_the_room_at_a_join_and_ease_to_what_the_edge_says(modules: BrowserPage) -> None:
    found = run_room(
        modules,
        """
        objects(one(1, "cube", "a", [1, 0, 0]), one(2, "cube", "c", [5, 5, 5]));
        const join = [0, -1, 0, 10, 1, 0, 0, 20, 0, 0, 1, 0, 0, 0, 0, 1];  // rows
        room.apply({ type: "map_changed", old: "a", new: "b", T_new_old: join }, 0);
        const moved = [at(1), room.objects.get(1).mapId, at(2), room.objects.get(2).mapId];
        objects(one(1, "cube", "b", [10, 21.2, 0]));  // 20 cm of drift
        const eased = [0, 100, 250, 400, 500].map((ms) => { now = ms; return at(1)[1]; });
        room.apply({ type: "objects", all: true, objects: [one(2, "cube", "c", [5, 5, 5])] }, 0);
        return [moved, eased, [...room.objects.keys()]];
        """,
    )
    (moved, map_id, other, other_id), eased, kept = found
    assert np.allclose(moved, [10, 21, 0]) and map_id == "b"
    assert np.allclose(other, [5, 5, 5]) and other_id == "c" and kept == [2]
    assert np.allclose([eased[0], eased[-1]], [21.0, 21.2], atol=1e-5)
    assert all(0 < later - before < 0.1 for before, later in pairwise(eased))


def test_an_agent_that_is_lost_stays_where_it_was(modules: BrowserPage) -> None:
    found = run_room(
        modules,
        """
        const where = { map_id: "a", position: [1, 2, 3], quaternion: [0, 0, 0, 1] };
        const pose = { agent: "bob", kind: "ar", state: "OK", t_ms: 5, ...where };
        const none = { ...pose, map_id: null, position: null, quaternion: null, velocity: null };
        const facts = ({ label, mapId, isPosed, T }) => [label, mapId, isPosed, T[13]];
        const seen = () => [...room.agents.values()].map(facts);
        const tell = (pose) => { room.apply({ type: "poses", poses: [pose] }, 0); return seen(); };
        const without = (state) => ({ ...none, state });
        return [without("INITIALISING"), pose, without("LOST"), without("GONE")].map(tell);
        """,
    )
    initialising, ok, lost, gone = found
    assert initialising == [["bob · INITIALISING", None, False, 0]] and ok == [["bob", "a", True, 2]]
    assert lost == [["bob · LOST", "a", False, 2]] and gone == []


def test_what_the_page_repeats_of_elsewhere() -> None:
    conventions = json.loads((PAGE.parents[2] / "examples" / "conventions.json").read_text())["webxr"]
    text = (PAGE / "conventions.js").read_text()
    for name, rows in re.findall(r"const (WORLD|BODY) = (\[.+\]);", text):
        assert json.loads(rows) == conventions[name.lower()]
    colours = re.search(r"AGENT_COLOURS = \[(.*?)\]\.map", (PAGE / "room.js").read_text(), re.S)
    assert colours is not None
    assert json.loads(f"[{colours[1].strip().rstrip(',')}]") == [list(one) for one in AGENT_COLOURS]


def test_the_page_is_in_packages_and_bundles() -> None:
    root = PAGE.parents[2]
    shipped = {file for pattern in ("*.html", "*.css", "*.js") for file in PAGE.glob(pattern)}
    assert shipped == set(PAGE.iterdir()) and len(shipped) > 20
    data = (root / "setup.cfg").read_text()
    assert all(f"\n    headset/page/{pattern}\n" in data for pattern in ("*.html", "*.css", "*.js"))
    assert '"headset" / "page" / "*"), "share/headset/page")' in (root / "tools/share.spec").read_text()


def test_no_text_becomes_html() -> None:
    for file in PAGE.glob("*"):
        text = file.read_text()
        assert not re.search(
            r"innerHTML|outerHTML|insertAdjacent|document\.write|\beval\b|new Function", text
        )
        assert not re.search(r"https?://(?!\$)", text) or file.suffix == ".svg"
    assert not re.search(r"\son\w+=|style=|<script>", (PAGE / "index.html").read_text())
