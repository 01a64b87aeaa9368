"""What the headset page does while its module is not there, in virtual time. Needs node."""

from __future__ import annotations

import json
import shutil
import subprocess
from typing import Any

import pytest

from share.headset.page_requests import FOLDER

_SCENE = """
const { source, statuses, startsAtMs, failsAtMs, endMs, count } = JSON.parse(require("fs").readFileSync(0));
const timers = [], store = new Map([["share-loads", count]]), listeners = {};
const told = [], asked = [], reloads = [];
let nowMs = 0;
const loading = {
    isConnected: true, setAttribute() {},
    querySelector: () => ({ set textContent(text) { told.push([nowMs, text]); } }),
};
class HTMLScriptElement {}
const world = {
    document: { getElementById: () => loading }, HTMLScriptElement, AbortSignal,
    sessionStorage: {
        getItem: (key) => store.get(key) ?? null,
        setItem: (key, value) => store.set(key, value),
        removeItem: (key) => store.delete(key),
    },
    addEventListener: (kind, listener) => (listeners[kind] = listener),
    setTimeout: (run, ms) => timers.push({ run, atMs: nowMs + ms }),
    location: { href: "/", reload: () => reloads.push(nowMs) },
    fetch: async () => {
        asked.push(nowMs);
        const status = statuses[Math.min(asked.length, statuses.length) - 1];
        if (status === 0) throw new TypeError("Failed to fetch");
        return { ok: status === 200 };
    },
};
if (startsAtMs !== null) world.setTimeout(() => (loading.isConnected = false), startsAtMs);
new Function(...Object.keys(world), source)(...Object.values(world));
const fail = () => listeners.error({ target: new HTMLScriptElement() });
if (failsAtMs !== null) world.setTimeout(fail, failsAtMs);
(async () => {
    while (reloads.length === 0) {
        timers.sort((a, b) => a.atMs - b.atMs);
        if (!(timers[0]?.atMs <= endMs)) break;
        const { run, atMs } = timers.shift();
        nowMs = atMs;
        await run();
    }
    console.log(JSON.stringify({ told, asked, reloads, count: store.get("share-loads") ?? null }));
})();
"""


def loaded(statuses: tuple[int, ...] = (200,), **scene: Any) -> dict[str, Any]:
    """Return what the page said, when it asked for itself (ms) and loaded itself again. statuses: of the
    answers, one after another, the last again and again; 0: none. Times in ms: starts_at of its module,
    fails_at of a part, end. count: of loads that have failed."""
    if (node := shutil.which("node")) is None:
        pytest.skip("node is not installed")
    given = {"startsAtMs": None, "failsAtMs": None, "endMs": 200_000, "count": 0, "statuses": statuses}
    given |= {"source": (FOLDER / "loading.js").read_text(), **scene}
    said = subprocess.run(
        [node, "-e", _SCENE], input=json.dumps(given), capture_output=True, text=True, timeout=60
    )
    assert said.returncode == 0, said.stderr
    found: dict[str, Any] = json.loads(said.stdout)
    return found


def test_a_page_that_has_started_meanwhile_is_not_loaded_again() -> None:
    late = loaded(startsAtMs=30_500)  # after the patience with it, before the load that was announced
    assert late["told"][0][0] == 30_000 and late["reloads"] == []
    assert loaded(startsAtMs=29_000)["told"] == []
    assert loaded()["reloads"] == [31_000]


@pytest.mark.parametrize("status", [0, 500, 404])
def test_where_nothing_is_served_it_waits_and_the_words_stay(status: int) -> None:
    gone = loaded((status,), failsAtMs=0)
    assert gone["reloads"] == [] and gone["asked"][:4] == [1000, 4000, 13_000, 22_000]
    assert set(map(int.__sub__, gone["asked"][3:], gone["asked"][2:])) == {9000}
    assert gone["told"][1][1] == "The edge does not answer, or serves no page. Loading again in 3 s."
    back = loaded((status, status, status, status, 200), failsAtMs=0)
    assert back["reloads"] == [31_000] and back["count"] == 1


def test_a_page_that_fails_again_and_again_waits_for_a_person() -> None:
    for count, reloads in enumerate(([1000], [3000], [9000], [])):
        found = loaded(failsAtMs=0, count=count)
        assert found["reloads"] == reloads and found["count"] == (count + 1) % 4
