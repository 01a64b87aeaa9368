"""The headset page in a browser: its modules against their references, flat, and in emulated headsets."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from helpers import emulated_wearer as worn
from helpers.browser import Browser, BrowserPage, browser
from helpers.headset_room import MAP, PAGE, HeadsetRoom, still
from helpers.headset_wearer import T_body_viewer, wearer

from share.colours import AGENT_COLOURS
from share.geometry import se3
from share.headset.alignment import PosePair, SpaceAlignment
from share.headset.prediction import predict_pose
from share.types import F64

pytestmark = pytest.mark.long
Pages = Iterator[Browser]

BEN = se3.from_rt(
    se3.so3_exp(np.array([0, 0, 2.0])) @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
    np.array([2.6, 0.9, 0.05]),
)
BOT = se3.from_rt(
    se3.so3_exp(np.array([0, 0, -0.6])) @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
    np.array([3.4, -1.2, -1.37]),
)


@pytest.fixture(scope="module")
def chromium() -> Pages:
    with browser() as one:
        yield one


@pytest.fixture
def room() -> Iterator[HeadsetRoom]:
    agents = {"ann": ("ar", worn.Walk()), "ben": ("ar", still(BEN)), "bot": ("robot", still(BOT))}
    with HeadsetRoom(agents) as one:
        one.mount = worn.T_body_viewer
        yield one


def columns(T: F64) -> list[float]:
    """A transform as the page has it."""
    return [float(value) for value in T.ravel(order="F")]


# ---------------------------------------------------------------- the modules, against their references


@pytest.fixture(scope="module")
def modules(chromium: Browser) -> Iterator[BrowserPage]:
    with HeadsetRoom({}) as one:
        yield chromium.page(one.url)


def run(page: BrowserPage, module: str, expression: str, **data: Any) -> Any:
    """Return an expression of a module's names `m` and of data."""
    names = ", ".join(data)
    script = f'import("/{module}.js").then((m) => (({{{names}}}) => ({expression}))({json.dumps(data)}))'
    return page.evaluate(script)


@pytest.mark.parametrize("size", [0.0, 1e-7, 1e-4, 0.3, 2.0, np.pi - 1e-6])
def test_transforms_are_those_of_se3(modules: BrowserPage, rng: np.random.Generator, size: float) -> None:
    axis = rng.normal(size=3)
    xi = np.concatenate([axis / np.linalg.norm(axis) * size, rng.normal(size=3)])
    A, B = se3.exp(xi), se3.exp(rng.normal(size=6))
    S = B[:3, :3] @ np.diag([1.0, 2, 3]) @ B[:3, :3].T
    S6 = np.kron(np.eye(2), S) + 0.1
    found = run(
        modules,
        "math",
        """({
            exp: [...m.exp(new Float64Array(16), xi)],
            log: m.log(A),
            product: [...m.multiply(new Float64Array(16), A, B)],
            inverse: [...m.inverse(new Float64Array(16), A)],
            adjoint: [...m.adjoint(A)],
            again: [...m.orthonormal(new Float64Array(16), A)],
            rows: m.toRows(m.fromRows(m.toRows(A))),
            solved: [...m.solve6(S6, rhs)],
            slerp: [...m.slerp(new Float64Array(4), qa, qb, 0.3)],
        })""",
        xi=xi.tolist(),
        A=columns(A),
        B=columns(B),
        S6=S6.ravel().tolist(),
        rhs=xi.tolist(),
        qa=se3.quat_from_matrix(A[:3, :3]).tolist(),
        qb=se3.quat_from_matrix(B[:3, :3]).tolist(),
    )
    between = A[:3, :3] @ se3.so3_exp(0.3 * se3.so3_log(A[:3, :3].T @ B[:3, :3]))
    expected = {
        "exp": columns(A),
        "product": columns(A @ B),
        "inverse": columns(se3.inverse(A)),
        "adjoint": se3.adjoint(A).ravel(),
        "again": columns(A),
        "rows": A.ravel(),
        "solved": np.linalg.solve(S6, xi),
    }
    for name, values in expected.items():
        assert np.allclose(found[name], values, atol=1e-9), name
    assert np.allclose(se3.exp(np.array(found["log"])), A, atol=1e-9)
    assert np.allclose(se3.matrix_from_quat(np.array(found["slerp"])), between, atol=1e-9)


@pytest.mark.parametrize("ahead_s", [-0.01, 0.0, 0.02, 0.1, 0.5])
def test_prediction_is_the_reference(modules: BrowserPage, rng: np.random.Generator, ahead_s: float) -> None:
    T, velocity, turning = se3.exp(rng.normal(size=6)), rng.normal(size=3), 2 * rng.normal(size=3)
    given = {"T": columns(T), "v": velocity.tolist(), "w": turning.tolist(), "ahead": ahead_s}
    found = run(modules, "prediction", "[...m.predictPose(new Float64Array(16), T, v, w, ahead)]", **given)
    assert np.allclose(found, columns(predict_pose(T, velocity, turning, ahead_s)), atol=1e-12)


def alignment_vectors(seed: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return pairs of a wearer, with all that can happen to them, and what becomes of each by the
    reference."""
    pairs, _ = wearer(seed)
    moved = se3.exp(np.array([0, 0.5, 0, 0.3, -0.2, 0]))  # recentred unnoticed
    jump = se3.exp(np.array([0, 0, 0, 0.3, 0, 0]))
    alignment, given, expected = SpaceAlignment(T_body_viewer), [], []
    for k, one in enumerate(pairs[:200]):
        local = moved @ one.T_local_viewer if k >= 120 else one.T_local_viewer
        body = one.T_map_body @ jump if k in (40, 41, 90) else one.T_map_body
        pair = PosePair(one.time_s, "other" if k >= 170 else "map", body, one.cov, local)
        alignment, outcome = alignment.after(pair)
        given.append(
            {
                "timeS": pair.time_s,
                "mapId": pair.map_id,
                "T_map_body": columns(body),
                "cov": pair.cov.ravel().tolist(),
                "T_local_viewer": columns(local),
            }
        )
        assert alignment.T_map_local is not None and alignment.cov is not None
        expected.append(
            {
                "outcome": str(outcome.value),
                "T": columns(alignment.T_map_local),
                "cov": alignment.cov.ravel().tolist(),
                "at": alignment.cov_at(local).ravel().tolist(),
            }
        )
    assert {one["outcome"] for one in expected} == {"started", "used", "refused", "restarted"}
    return given, expected


@pytest.mark.parametrize("seed", [3, 4])
def test_alignment_is_the_reference(modules: BrowserPage, seed: int) -> None:
    given, expected = alignment_vectors(seed)
    found = run(
        modules,
        "alignment",
        """(() => {
            let alignment = new m.SpaceAlignment(Float64Array.from(mount)), outcome;
            return pairs.map((pair) => {
                const [T_map_body, cov] = [pair.T_map_body, pair.cov].map((one) => Float64Array.from(one));
                const T_local_viewer = Float64Array.from(pair.T_local_viewer);
                [alignment, outcome] = alignment.after({ ...pair, T_map_body, cov, T_local_viewer });
                const at = [...alignment.covAt(T_local_viewer)];
                return { outcome, T: [...alignment.T_map_local], cov: [...alignment.cov], at };
            });
        })()""",
        mount=columns(T_body_viewer),
        pairs=given,
    )
    assert [one["outcome"] for one in found] == [one["outcome"] for one in expected]
    for name, scale in (("T", 1.0), ("cov", 1e-4), ("at", 1e-4)):
        values, wanted = (np.array([row[name] for row in rows]) for rows in (found, expected))
        assert np.abs(values - wanted).max() < 1e-8 * scale, name


def test_history_interpolates(modules: BrowserPage, rng: np.random.Generator) -> None:
    T = se3.exp(np.cumsum(rng.normal(size=(300, 6)) * 0.05, axis=0))  # more than are kept
    times = 1000 + 11.0 * np.arange(300)
    times[290:] += 500  # a gap
    asked = [1000 + 11 * 200 + 3.3, times[295] + 1.0, times[289] + 100, times[299] + 1, times[5]]
    found = run(
        modules,
        "viewer-history",
        """(() => {
            const history = new m.ViewerHistory();
            poses.forEach((T, k) => history.add(times[k], Float64Array.from(T)));
            return asked.map((time) => { const T = history.at(time); return T && [...T]; });
        })()""",
        poses=[columns(one) for one in T],
        times=times.tolist(),
        asked=asked,
    )
    for k, share, pose in ((200, 0.3, found[0]), (295, 1 / 11, found[1])):
        R = T[k, :3, :3] @ se3.so3_exp(share * se3.so3_log(T[k, :3, :3].T @ T[k + 1, :3, :3]))
        t = T[k, :3, 3] + share * (T[k + 1, :3, 3] - T[k, :3, 3])
        assert np.allclose(pose, columns(se3.from_rt(R, t)), atol=1e-9)
    assert found[2:] == [None, None, None]


def test_of_clock_samples_the_least_round_trip_counts(modules: BrowserPage) -> None:
    found = run(
        modules,
        "clock",
        """(() => {
            const clock = new m.ServerClock();
            const before = clock.toPage(0);
            clock.add(100, 5150, 140);
            clock.add(200, 5202, 204);  // 4 ms there and back: 5000 ahead
            clock.add(300, 5390, 400);
            return [before, clock.toPage(6000), clock.roundTripMs];
        })()""",
    )
    assert found == [None, 1000, 4]


def test_percentiles(modules: BrowserPage) -> None:
    values = [float(k) for k in range(1, 101)]
    script = (
        "(() => { const l = new m.Latency(); v.forEach((x) => l.add(x)); return [l.take(), l.take()]; })()"
    )
    summary = {"frames": 100, "over_20ms": 80, "p50_ms": 50, "p95_ms": 95, "p99_ms": 99}
    assert run(modules, "latency", script, v=values) == [summary, None]


def test_a_jump_eases_at_the_wearer_and_is_said(modules: BrowserPage) -> None:
    """Maps are joined, and the first pair in the new one contradicts by 20 cm what was drawn."""
    T_new_old = se3.exp(np.array([0, 0, 0.4, 3.0, -2, 0.1]))
    error = se3.from_rt(np.eye(3), np.array([0.2, 0.0, 0]))
    found = run(
        modules,
        "placement",
        """(() => {
            const told = [], placement = new m.Placement((text) => told.push(text));
            placement.setMount(Float64Array.from(mount), 0);
            const cov = Float64Array.from({ length: 36 }, (_, k) => (k % 7 === 0 ? 1e-6 : 0));
            const pose = (timeMs, mapId, T) =>
                placement.addPose({ timeMs, mapId, T_map_body: Float64Array.from(T), cov });
            const V = Float64Array.from(viewer), x = [];
            const frame = (timeMs) => {
                placement.update(timeMs, V);
                x.push([timeMs, placement.mapId, [...placement.T_map_local]]);
            };
            frame(0); pose(5, "a", body); frame(11);
            placement.joined("a", "b", Float64Array.from(join)); frame(22);
            for (let k = 3; k < 200; k++) { pose(11 * k - 5, "b", wrong); frame(11 * k); }
            return [told, x];
        })()""",
        mount=columns(worn.T_body_viewer),
        viewer=columns(worn.viewer_pose(0, False)),
        body=columns(np.eye(4)),
        join=columns(T_new_old),
        wrong=columns(error @ T_new_old),
    )
    told, frames = found
    V = worn.viewer_pose(0, False)
    drawn = np.array([(np.reshape(T, (4, 4), order="F") @ V)[:3, 3] for _, _, T in frames])
    assert frames[0][1] is None and [one[1] for one in frames[1:3]] == ["a", "b"]
    start = (se3.from_rt(np.eye(3), np.zeros(3)) @ worn.T_body_viewer)[:3, 3]
    before, after = ((T @ np.append(start, 1))[:3] for T in (T_new_old, error @ T_new_old))
    assert np.allclose(drawn[2], before, atol=1e-6)  # the join alone moves nothing
    steps = np.linalg.norm(np.diff(drawn[2:], axis=0), axis=1)
    assert np.allclose(drawn[-1], after, atol=1e-3) and steps.max() < 0.2 * 1.6 * 11 / 500
    assert any("20.0 cm" in text and "0.5 s" in text for text in told)


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
    const one = (id, kind, map_id, position) => ({ id, kind, owner: "ben", map_id, position, quaternion: [0, 0, 0, 1] });
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
        const pose = { agent: "bob", kind: "ar", state: "OK", map_id: "a", t_ms: 5, position: [1, 2, 3], quaternion: [0, 0, 0, 1] };
        const none = { ...pose, map_id: null, position: null, quaternion: null, velocity: null };
        const seen = () => [...room.agents.values()].map(({ label, mapId, isPosed, T }) => [label, mapId, isPosed, T[13]]);
        const tell = (pose) => { room.apply({ type: "poses", poses: [pose] }, 0); return seen(); };
        return [{ ...none, state: "INITIALISING" }, pose, { ...none, state: "LOST" }, { ...none, state: "GONE" }].map(tell);
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


def test_no_text_becomes_html() -> None:
    for file in PAGE.glob("*"):
        text = file.read_text()
        assert not re.search(
            r"innerHTML|outerHTML|insertAdjacent|document\.write|\beval\b|new Function", text
        )
        assert not re.search(r"https?://(?!\$)", text) or file.suffix == ".svg"
    assert not re.search(r"\son\w+=|style=|<script>", (PAGE / "index.html").read_text())


# ---------------------------------------------------------------- flat


def test_pairing_says_what_is_wrong_and_a_name_is_a_text(chromium: Browser, room: HeadsetRoom) -> None:
    page = chromium.page(room.url)
    worn.pair(page, "ann", code="000000")
    page.wait("document.getElementById('reason').textContent.includes('code is wrong')")
    assert not page.app("app.room.agents.size + app.room.objects.size")  # nothing before pairing
    room.put(1, "cube", "<img src=x onerror=alert(1)>", np.eye(4))
    worn.pair(page, "<b>ann</b>")
    page.wait("app.connection.isConnected && app.room.objects.size === 1 && app.room.agents.size === 3")
    page.wait("document.querySelector('#state p')?.textContent === '<b>ann</b>'")
    assert page.app("document.querySelectorAll('#state b, img').length") == 0
    assert page.app("app.frames") > 0 and page.problems == []


def test_flat_pages_share_what_a_mouse_places(chromium: Browser, room: HeadsetRoom) -> None:
    ann, ben = (chromium.page(room.url, *size) for size in ((960, 540), (390, 844)))
    for page, name in ((ann, "ann"), (ben, "ben")):
        worn.pair(page, name)
        page.wait("app.place.mapId !== null && app.room.agents.size === 3")
    ann.click("[data-name=marker]")
    drag = [(640 + 12 * k, 330 + 3 * k) for k in range(8)]
    ann.mouse("mouseMoved", *drag[0])
    ann.mouse("mousePressed", *drag[0])
    placed = ann.wait("[...app.room.objects.values()].map((one) => [one.id, one.T[12], one.T[13]])[0]")
    for point in drag[1:]:
        ann.mouse("mouseMoved", *point)
        time.sleep(0.04)
    ann.mouse("mouseReleased", *drag[-1])
    final = ann.app("[...app.room.objects.values()].map((one) => [one.id, one.T[12], one.T[13]])[0]")
    assert np.hypot(*(np.subtract(final, placed)[1:])) > 0.2
    ben.wait(f"Math.abs((app.room.objects.get({final[0]})?.T[12] ?? 1e9) - {final[1]}) < 1e-6")
    assert ben.app(f"app.room.objects.get({final[0]}).owner") == "ann"
    ann.wait(f"app.room.objects.get({final[0]}).isHeld === false")
    ann.click("[data-name=there]")
    ann.wait("app.room.words('bot').includes('to go')")
    (goto,) = room.of_type("goto")
    assert np.allclose([goto["x"], goto["y"]], final[1:]) and goto["map_id"] == MAP
    ben.click("[data-name=stop]")
    ann.wait("app.room.words('bot') === 'stopped'")
    ann.click("[data-name=remove]")
    ann.mouse("mousePressed", *drag[-1])
    ann.mouse("mouseReleased", *drag[-1])
    ben.wait("app.room.objects.size === 0")
    ann.click("[data-name=points]")
    ann.wait("app.room.points.count === 6000")
    assert ann.problems == ben.problems == []


def test_what_is_refused_goes_back_and_is_said(chromium: Browser, room: HeadsetRoom) -> None:
    page = chromium.page(room.url)
    worn.pair(page, "ann")
    page.wait("app.place.mapId !== null && app.room.agents.size === 3")
    room.refusal = "ann has 16 objects already"
    page.click("[data-name=cube]")
    for kind in ("mousePressed", "mouseReleased"):
        page.mouse(kind, 700, 350)
    page.wait("document.getElementById('state').textContent.includes('16 objects already')")
    assert page.app("app.room.objects.size") == 0 and len(room.objects) == 0


def test_without_rights_only_stop_is_left(chromium: Browser, room: HeadsetRoom) -> None:
    room.may = {"objects": False, "commands": False}
    page = chromium.page(room.url)
    worn.pair(page, "eve")
    page.wait("app.place.mapId !== null && document.querySelector('[data-name=cube]').disabled")
    enabled = (
        "[...document.querySelectorAll('#buttons button:enabled:not([hidden])')].map((b) => b.dataset.name)"
    )
    assert page.app(enabled) == ["points", "stop"]


def test_a_lost_server_comes_back_and_nothing_is_lost(chromium: Browser, room: HeadsetRoom) -> None:
    page = chromium.page(room.url)
    worn.pair(page, "ann")
    page.wait("app.place.mapId !== null")
    answer, room._handle = room._handle, lambda *_: None  # deaf
    page.app("app.connection.put(77, 'cube', app.place.mapId, [1, 2, 3], [0, 0, 0, 1])")
    page.app("app.connection.cancel(null)")
    room.drop()
    room._handle = answer
    page.wait("app.connection.text.includes('trying again')")
    page.wait("app.connection.isConnected && !app.connection.isPending(77)")
    assert room.objects[77]["position"] == [1, 2, 3] and len(room.of_type("cancel")) == 1
    page.open(room.url)  # loaded again: goes on with its session
    page.wait("app.connection.isConnected && app.wearer === 'ann' && app.room.objects.has(77)")
    room._names.clear()  # the server knows it no longer
    room.drop()
    page.wait("!app.connection.isPaired && !document.getElementById('start').hidden")
    assert "pair again" in page.app("document.getElementById('reason').textContent")


# ---------------------------------------------------------------- in emulated headsets


def test_two_wearers_share_a_marker(chromium: Browser, room: HeadsetRoom) -> None:
    room.agents["ben"] = "ar", room.agents["ann"][1]
    ann, ben = (worn.wear(chromium, room.url, name) for name in ("ann", "ben"))
    for page in (ann, ben):
        page.wait("app.place.mapId !== null && app.alignmentMm !== null")
        assert worn.drawn_error(page)[0] < 0.002
        page.app(worn.SEEN)
    worn.drag_marker(ann, 3.0)
    target = worn.T_map_local @ [*ann.evaluate("aims.at"), 1]
    (marker,) = room.objects.values()
    assert marker["owner"] == "ann" and np.allclose(marker["position"], target[:3], atol=0.01)
    ben.wait(f"Math.abs([...app.room.objects.values()][0].T[12] - {marker['position'][0]}) < 1e-6")
    late = worn.lateness_ms(ann, ben)
    print(f"drawn by the other after {np.percentile(late, [50, 95]).round(1)} ms, {len(late)} places")
    assert len(late) > 40 and np.median(late) < 60
    assert ann.problems == ben.problems == []


def test_the_room_stays_where_it_is(chromium: Browser, room: HeadsetRoom) -> None:
    """While the wearer walks; the space is recentred in mid-drag; by its own tracking and by SHARE's."""
    walk = room.agents["ann"][1]
    page = worn.wear(chromium, room.url, "ann")
    walk.walks = True
    page.evaluate("walks = true")
    time.sleep(2.5)
    errors = [worn.drawn_error(page) for _ in range(20)]
    print(f"align: {1e3 * np.median(errors, 0)[0]:.1f} mm, {np.degrees(np.median(errors, 0)[1]):.2f} deg")
    assert np.median(errors, axis=0)[0] < 0.01 and np.degrees(np.median(errors, axis=0)[1]) < 0.2
    walk.walks = False
    page.evaluate("walks = false")
    page.app("app.interaction.arm('marker')")
    worn.press(page, True)
    before = page.wait("[...app.room.objects.values()].map((one) => [...one.T])[0]")
    page.evaluate("(space = { yaw: 1.0, x: 0.4, z: -0.3 }, headset.recenter())")
    page.wait("app.placement.mapId === null || app.commands.notice.text.includes('recentred')")
    page.wait("app.placement.mapId !== null")
    worn.wait_frames(page, 10)
    space = se3.from_rt(se3.so3_exp(np.array([0, 1.0, 0])), np.array([0.4, 0, -0.3]))
    assert worn.drawn_error(page, se3.inverse(space))[0] < 0.005
    after = page.app("[...app.room.objects.values()].map((one) => [...one.T])[0]")
    worn.press(page, False)
    assert np.abs(np.subtract(before, after)).max() < 0.02 and page.app("app.interaction.armed") is None
    worn.push(page, "mode")
    page.wait("app.placement.mode === 'follow'")
    walk.walks = True
    page.evaluate("walks = true")
    time.sleep(1.5)
    errors = [worn.drawn_error(page, se3.inverse(space)) for _ in range(20)]
    print(f"follow: {1e3 * np.median(errors, 0)[0]:.1f} mm, {np.degrees(np.median(errors, 0)[1]):.2f} deg")
    assert np.median(errors, axis=0)[0] < 0.03
    page.wait("app.latency.summary !== null")
    modes = {one["mode"]: one for one in room.of_type("measured")}
    assert modes["align"]["frames"] > 20 and 5 < modes["align"]["p50_ms"] < 100
    assert modes["align"]["p50_ms"] <= modes["align"]["p95_ms"] <= modes["align"]["p99_ms"]
    assert modes["align"]["alignment_mm"] < 20 and page.problems == []


def test_hands_place_a_cube_and_the_panel_commands(chromium: Browser, room: HeadsetRoom) -> None:
    page = worn.wear(chromium, room.url, "ann")
    page.wait("app.place.mapId !== null")
    worn.push(page, "here")
    goto = room.of_type("goto")[0]
    head = (worn.T_map_local @ worn.viewer_pose(0, False))[:2, 3]
    assert np.linalg.norm(head - [goto["x"], goto["y"]]) == pytest.approx(0.8, abs=0.01)
    page.evaluate("headset.primaryInputMode = 'hand'")
    worn.wait_frames(page, 5)
    page.app("app.interaction.arm('cube')")
    worn.press(page, True, hand=True)
    worn.press(page, False, hand=True)
    page.wait("app.room.objects.size === 1")
    (cube,) = room.objects.values()
    hand = (worn.T_map_local @ [*page.evaluate("aims.from"), 1])[:3]
    assert cube["kind"] == "cube" and np.linalg.norm(np.subtract(cube["position"], hand)) < 0.3
    page.evaluate("headset.primaryInputMode = 'controller'")
    worn.wait_frames(page, 5)
    page.evaluate("headset.controllers.right.updateButtonValue('b-button', 1)")
    page.wait("app.room.words('bot') === 'stopped'")
    worn.push(page, "leave")
    page.wait("!app.isInHeadset")
    worn.wait_frames(page, 3)
    assert page.problems == []


def test_a_wrong_mount_is_said(chromium: Browser, room: HeadsetRoom) -> None:
    wrong = worn.T_body_viewer @ se3.exp(np.array([np.radians(6), 0, np.radians(6), 0, 0, 0]))
    walk = worn.Walk(wrong)
    walk.walks, room.agents["ann"] = True, ("ar", walk)
    page = worn.wear(chromium, room.url, "ann")
    page.evaluate("walks = true")
    page.wait("app.placement.isContradicted", 15)


def test_script_time_and_memory_of_a_frame(chromium: Browser, room: HeadsetRoom) -> None:
    page = worn.wear(chromium, room.url, "ann")
    for k in range(16):
        room.put(100 + k, "cube", "ann", se3.from_rt(np.eye(3), np.array([1 + 0.3 * k, 1.0, -1])))
    page.wait("app.room.objects.size === 16 && app.place.mapId !== null")
    page.wait("app.script.summary !== null && app.script.summary.frames > 60")
    summary = page.app("app.script.summary")
    print(f"script {summary['p50_ms']:.2f} ms a frame, 95 % {summary['p95_ms']:.2f} ms")
    assert summary["p50_ms"] <= 2.0


@pytest.mark.slow
def test_memory_does_not_grow(chromium: Browser, room: HeadsetRoom) -> None:
    """In two minutes of walking and dragging; after collection."""
    walk = room.agents["ann"][1]
    page = worn.wear(chromium, room.url, "ann")
    walk.walks = True
    page.evaluate("walks = true")
    page.app("app.interaction.arm('marker')")
    worn.press(page, True)
    page.evaluate(
        "(began = performance.now(), drags = () => {"
        " const s = Math.sin((performance.now() - began) / 1000);"
        " aims = { ...aims, at: [0.6 - s, 0, -1.4 - 0.5 * s] }; }, 0)"
    )
    heap = []
    for _ in range(9):
        time.sleep(15)
        heap.append(page.evaluate("(gc(), performance.memory.usedJSHeapSize)") / 1e6)
    print(f"heap {np.round(heap, 2)} MB after each 15 s")
    assert all(late - heap[1] < 1.0 for _, late in pairwise(heap[1:]))
