"""What goes wrong about a headset's page: objects stay where they are in the room, what is the case is said,
nothing is lost. With the edge's own server."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from helpers import emulated_wearer as worn
from helpers.browser import Browser, BrowserPage

pytest.importorskip("share.headset.headset_page")
from helpers.delayed_port import DelayedPort
from helpers.served_room import ServedRoom, served_room, wear

from share.lab.evaluate.emulated_network import NETWORK_PRESETS
from share.types import TrackState

pytestmark = pytest.mark.slow

STAYS_M = 0.04  # at 3 m, with a wearer who walks
CUBE = 7


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ServedRoom]:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    with served_room(tmp_path, ("ann",)) as one:
        yield one


@pytest.fixture
def network(served: ServedRoom) -> Iterator[DelayedPort]:
    host, _, port = served.page.endpoint.rpartition(":")
    with closing(DelayedPort((host, int(port)), NETWORK_PRESETS["wifi5"], 1)) as one:
        yield one


@pytest.fixture
def ann(chromium: Browser, served: ServedRoom, network: DelayedPort) -> BrowserPage:
    """She walks about, with a cube in the room."""
    page = wear(chromium, served, "ann", f"http://127.0.0.1:{network.port}/")
    put(page, CUBE)
    page.wait(f"app.room.objects.get({CUBE})?.isHeld === false")
    page.evaluate(worn.WATCH)
    worn.wait_frames(page, 10)
    return page


def put(page: BrowserPage, object_id: int) -> None:
    """Let go of a cube that is held 2.4 m from the map's origin."""
    page.app(
        f"((T) => {{ T[12] = 2; T[13] = 1; T[14] = -1;"
        f" app.room.move({object_id}, 'cube', 'ann', app.place.mapId, T).request ="
        f" app.connection.put({object_id}, 'cube', app.place.mapId, [2, 1, -1], [0, 0, 0, 1]); }})"
        "(Float64Array.from({ length: 16 }, (_, k) => Number(k % 5 === 0)))"
    )


def assert_it_stays(page: BrowserPage) -> None:
    away_m, step_m = worn.moved_m(page, CUBE)
    print(f"drawn up to {1e3 * away_m:.0f} mm away, {1e3 * step_m:.0f} mm from frame to frame")
    assert away_m < STAYS_M


def objects_of(served: ServedRoom) -> set[int]:
    return {one.object.object_id for one in served.edge.edge.room.kept_objects()}


def test_the_edge_is_killed_and_comes_back(ann: BrowserPage, served: ServedRoom) -> None:
    served.end_edge()
    ann.wait("!app.room.edge.isConnected", 60)
    worn.wait_until_said(ann, ann.app("app.room.edge.text"))
    put(ann, 8)
    time.sleep(1.0)
    assert ann.app("app.room.objects.get(8).isHeld")  # shown, and not acknowledged
    served.begin_edge()
    ann.wait("app.room.edge.isConnected && !app.room.objects.get(8).isHeld", 60)
    assert objects_of(served) == {CUBE, 8} and ann.app("[...app.room.objects.keys()]") == [CUBE, 8]
    assert_it_stays(ann)


def test_the_network_is_gone_for_five_seconds(
    ann: BrowserPage, served: ServedRoom, network: DelayedPort
) -> None:
    network.cut(True)
    worn.wait_until_said(ann, "trying again")
    put(ann, 8)
    time.sleep(5.0)
    assert ann.app("app.place.mapId") is not None  # it goes on by the headset's own tracking
    network.cut(False)
    ann.wait("app.connection.isConnected && !app.connection.isPending(8)", 60)
    assert objects_of(served) == {CUBE, 8}
    time.sleep(1.0)
    assert_it_stays(ann)


def test_nothing_is_heard_for_five_seconds(
    ann: BrowserPage, served: ServedRoom, network: DelayedPort
) -> None:
    """As where the Wi-Fi is out of reach: no connection ends, and what was sent may still arrive."""
    network.hold(True)
    put(ann, 8)
    worn.wait_until_said(ann, "trying again")
    time.sleep(1.5)  # 5 s in all
    assert ann.app("app.place.mapId") is not None
    network.hold(False)
    ann.wait("app.connection.isConnected && !app.connection.isPending(8)", 60)
    assert objects_of(served) == {CUBE, 8}
    time.sleep(1.0)
    assert_it_stays(ann)


def test_what_is_followed_is_held_while_no_pose_comes(ann: BrowserPage, served: ServedRoom) -> None:
    """The edge's poses end: what is drawn goes on by the headset's own tracking, and says so."""
    worn.push(ann, "mode")
    ann.wait("app.placement.isFollowing")
    served.states["ann"] = TrackState.LOST
    worn.wait_until_said(ann, "no new pose: drawn by the headset's tracking")
    worn.wait_until_said(ann, "follow: no new pose, held ±")
    time.sleep(1.0)  # it went with the head, and eases back
    before = ann.app(f"[...app.room.objects.get({CUBE}).shown.slice(12, 15)]")
    ann.evaluate("(watched = {}, 0)")
    time.sleep(3.0)
    assert worn.drawn_error(ann)[0] < STAYS_M
    assert_it_stays(ann)
    served.states["ann"] = TrackState.OK
    ann.wait("app.placement.isFollowing")
    assert ann.app(f"[...app.room.objects.get({CUBE}).shown.slice(12, 15)]") == before


def test_the_page_is_loaded_again(ann: BrowserPage, network: DelayedPort) -> None:
    worn.open_again(ann, f"http://127.0.0.1:{network.port}/")
    worn.walk_aligned(ann)
    assert ann.app("app.wearer") == "ann"
    position = ann.app(f"[...app.room.objects.get({CUBE}).T].slice(12, 15)")
    assert position == pytest.approx([2, 1, -1], abs=1e-4)
    ann.evaluate(worn.WATCH)
    worn.wait_frames(ann, 60)
    assert_it_stays(ann)


def test_the_clock_of_a_device_is_set_by_ten_seconds(ann: BrowserPage, served: ServedRoom) -> None:
    for error_s in (10.0, -10.0):
        served.clock_error_s = error_s
        time.sleep(3.0)
        assert ann.app("app.placement.poseAgeMs(performance.now())") < 1000
        assert_it_stays(ann)
        assert not ann.app("app.placement.isContradicted")


def test_the_clock_of_the_headset_is_put_back_by_ten_seconds(
    ann: BrowserPage, served: ServedRoom, network: DelayedPort
) -> None:
    """Between two loads of its page, whose numbers of requests begin with the clock."""
    ann.call(
        "Page.addScriptToEvaluateOnNewDocument",
        source="((now) => (Date.now = () => now() - 10000))(Date.now)",
    )
    worn.open_again(ann, f"http://127.0.0.1:{network.port}/")
    worn.walk_aligned(ann)
    ann.evaluate(worn.WATCH)
    put(ann, 8)
    ann.wait("!app.connection.isPending(8)")
    assert objects_of(served) == {CUBE, 8}
    worn.wait_frames(ann, 30)
    assert_it_stays(ann)


def test_the_device_of_a_wearer_is_lost(ann: BrowserPage, served: ServedRoom) -> None:
    served.states["ann"] = TrackState.LOST
    worn.wait_until_said(ann, "ann LOST")
    time.sleep(3.0)
    assert ann.app("app.place.mapId") is not None  # it goes on by the headset's own tracking
    served.states["ann"] = TrackState.OK
    worn.wait_until_said(ann, "ann OK")
    time.sleep(1.0)
    assert_it_stays(ann)
