"""The headset page on flat screens, as people use it."""

from __future__ import annotations

import time

import numpy as np
import pytest
from helpers import emulated_wearer as worn
from helpers.browser import Browser
from helpers.headset_room import MAP, HeadsetRoom

pytestmark = pytest.mark.long


def test_pairing_says_what_is_wrong_and_a_name_is_a_text(chromium: Browser, room: HeadsetRoom) -> None:
    page = chromium.page(room.url)
    worn.pair(page, "ann", code="00000000")
    page.wait("document.getElementById('reason').textContent.includes('code is wrong')")
    assert not page.app("app.room.agents.size + app.room.objects.size")  # nothing before pairing
    room.put(1, "cube", "<img src=x onerror=alert(1)>", np.eye(4))
    worn.pair(page, "<b>ann</b>")
    page.wait("app.connection.isConnected && app.room.objects.size === 1 && app.room.agents.size === 3")
    page.wait("document.querySelector('#state p')?.textContent === '<b>ann</b>'")
    assert page.app("document.querySelectorAll('#state b, img').length") == 0
    page.wait("app.frames > 0")
    assert page.problems == []


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


def test_a_part_that_does_not_come_is_said_and_loaded_again(chromium: Browser, room: HeadsetRoom) -> None:
    page = chromium.page(f"{room.url}page.css")
    page.call("Network.enable")
    page.call("Network.setBlockedURLs", urls=["*main.js*"])
    said = "(document.querySelector('#loading p')?.textContent ?? '')"
    page.open(room.url)
    page.wait_for(f"{said}.startsWith('A part of this page did not come') && {said}.includes('again in 9 s')")
    assert page.evaluate("sessionStorage.getItem('share-loads')") == "2"  # it has loaded itself twice
    page.call("Network.setBlockedURLs", urls=[])
    page.wait_for("document.getElementById('loading') === null")  # and once more
    page.wait_for(
        "!document.getElementById('start').hidden && sessionStorage.getItem('share-loads') === null"
    )
    page.call("Network.setBlockedURLs", urls=["*main.js*"])
    page.evaluate("sessionStorage.setItem('share-loads', 3)")
    page.open(room.url)
    page.wait_for(f"{said}.startsWith('A part of this page did not come') && !{said}.includes('again in')")
    page.call("Network.setBlockedURLs", urls=[])
    page.click("#loading a")  # nobody has to wait
    page.wait_for("!document.getElementById('start').hidden")


def test_a_browser_that_cannot_show_it_is_told_why(chromium: Browser, room: HeadsetRoom) -> None:
    page = chromium.page(f"{room.url}page.css")
    page.call(
        "Page.addScriptToEvaluateOnNewDocument", source="delete HTMLCanvasElement.prototype.getContext;"
    )
    page.open(room.url)
    page.wait_for(
        "document.querySelector('#loading p').textContent.startsWith('This page cannot run here: ')"
    )
    assert page.evaluate("sessionStorage.getItem('share-loads')") == "0"  # it is not loaded again and again


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
    page.wait("app.place.mapId !== null && app.wearer === 'eve'")
    enabled = (
        "[...document.querySelectorAll('#buttons button:enabled:not([hidden])')].map((b) => b.dataset.name)"
    )
    page.wait(f"String({enabled}) === 'points,stop'", 10)


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
    assert room.objects[77]["position"] == [1, 2, 3]
    assert len({one["command"] for one in room.of_type("cancel")}) == 1  # the first may have arrived
    page.open(room.url)  # loaded again: goes on with its session
    page.wait("app.connection.isConnected && app.wearer === 'ann' && app.room.objects.has(77)")
    room.hindrance = "the edge's list of keys cannot be used"
    room.drop()
    page.wait("app.connection.text.includes('list of keys')")
    assert page.app("app.connection.isPaired && document.getElementById('start').hidden")
    room.hindrance = ""
    page.wait("app.connection.isConnected && app.wearer === 'ann'", 20)  # by the session that it kept
    room._names.clear()  # the server knows it no longer
    room.drop()
    page.wait("!app.connection.isPaired && !document.getElementById('start').hidden")
    assert "pair again" in page.app("document.getElementById('reason').textContent")


def test_a_page_of_another_release_loads_itself_again_once(chromium: Browser, room: HeadsetRoom) -> None:
    page = chromium.page(room.url)
    worn.pair(page, "ann")
    page.wait("app.connection.isConnected")
    page.evaluate("(window.isOld = true, 0)")
    room.hindrance, room.is_outdated = "this page is of another release", True
    room.drop()
    page.wait_for("window.isOld === undefined && sessionStorage.getItem('share-outdated') === '1'")
    page.wait("app.connection.text.includes('another release')")  # it is no other one: it tries later
    page.evaluate("(window.isOld = true, 0)")
    room.hindrance = "it still is"
    page.wait("app.connection.text === 'it still is'", 20)
    assert page.app("window.isOld && app.connection.isPaired")
    room.hindrance = ""
    page.wait("app.connection.isConnected && app.wearer === 'ann'", 20)  # by the session that it kept
    assert page.evaluate("sessionStorage.getItem('share-outdated')") is None
