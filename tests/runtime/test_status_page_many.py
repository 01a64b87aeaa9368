"""The status page of a room with many agents, as a browser shows it on a phone."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any

import pytest

from share.runtime.status_page import status_page

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium, which runs the page"),
    pytest.mark.long,
]
# a phone's width; its height is told by the title
FRAME = """<!doctype html><iframe src="/" style="width:390px;height:844px"></iframe><script>
setTimeout(() => {
  const page = document.querySelector("iframe").contentDocument;
  document.title = page.documentElement.scrollHeight;
  document.body.append(page.documentElement);
}, 1500);
</script>"""


def agent(number: int) -> dict[str, Any]:
    troubles = ["its clock is not synchronised: unknown"] if number in (11, 17) else []
    return {
        **{"run": f"agent{number}-1", "kind": "ar", "state": "INERTIAL_ONLY", "reason": None, "gone": False},
        **{"trouble": troubles, "pose_age_ms": 12.0, "pose_ms": 6.0, "qoe": 0.9, "qoe_target": 0.93},
        **{"delay_ms": 14.0, "keyframes": 12, "rate_hz": 2.0, "corrections": 3, "map_id": f"m{number}"},
        **{"bytes_up": 0, "bytes_down": 0, "loops": {"accepted": 1, "tried": 2}},
        "consistency": {"state": "unknown", "reason": ""},
    }


def place(number: int) -> dict[str, Any]:
    map_id, path = f"m{number}", [[0.0, 0.0], [1.0, 1.0]]
    parts = [{"map_id": map_id, "path": path}]
    return {"kind": "ar", "map_id": map_id, "position": path[-1], "heading": 0.0, "parts": parts}


def documents(count: int) -> dict[str, str]:
    order = sorted(range(count), key=str)  # as a dictionary by name may be
    agents = {f"agent{k}": agent(k) for k in order}
    snapshot = {
        **{"agents": agents, "maps": {f"m{k}": 12 for k in order}, "uptime_s": 5.0, "session": 1},
        **{"policy": "share", "version": "0.2.0", "waiting": 0},
        **({"unlisted_runs": 40, "unlisted_maps": 7, "unlisted_keyframes": 90} if count < 10 else {}),
    }
    plan = {"agents": {f"agent{k}": place(k) for k in order}}
    return {
        "/": status_page().decode(),
        "/frame": FRAME,
        "/snapshot.json": json.dumps(snapshot),
        "/plan.json": json.dumps(plan),
    }


@pytest.fixture
def shown(request: pytest.FixtureRequest) -> Iterator[str]:
    """The page's elements after a second and a half, for `request.param` agents."""
    pages = documents(request.param)

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            content = pages.get(self.path, "").encode()
            self.send_response(200 if content else 404)
            self.send_header(
                "Content-Type", "text/html" if self.path in ("/", "/frame") else "application/json"
            )
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: Any) -> None: ...

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    Thread(target=server.serve_forever, daemon=True).start()
    try:
        options = ("--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=4000", "--dump-dom")
        url = f"http://127.0.0.1:{server.server_port}/frame"
        done = subprocess.run([str(CHROMIUM), *options, url], capture_output=True, text=True, timeout=120)
        yield done.stdout
    finally:
        server.shutdown()
        server.server_close()


def height(page: str) -> int:
    found = re.search(r"<title>(\d+)</title>", page)
    assert found is not None, page[:500]
    return int(found[1])


@pytest.mark.parametrize("shown", [30], indirect=True)
def test_thirty_agents_fit_a_phone_the_troubled_first(shown: str) -> None:
    assert height(shown) < 3200
    table = shown[shown.index('id="agents"') : shown.index('id="hint"')]
    names = re.findall(r"</i>(agent\d+)</td>", table)
    assert names[:4] == ["agent11", "agent17", "agent0", "agent1"] and names[-1] == "agent29"
    assert names.index("agent2") < names.index("agent10")
    assert ">30, 2 in trouble<" in shown
    assert "<li>agent11, agent17: its clock is not synchronised: unknown</li>" in shown
    assert "27 more maps" in shown and "policy share · SHARE 0.2.0" in shown


@pytest.mark.parametrize("shown", [3], indirect=True)
def test_of_few_agents_all_is_shown(shown: str) -> None:
    table = shown[shown.index('id="agents"') : shown.index('id="hint"')]
    assert 'class="words"' in table and shown.count("<details open") == 7
    assert '<details id="plans" hidden=""><summary></summary>' in shown and "1 m a square: agent2<" in shown


@pytest.mark.parametrize("shown", [3], indirect=True)
def test_what_is_not_listed_is_counted(shown: str) -> None:
    assert ">40 earlier runs not listed<" in shown
    maps = shown[shown.index('id="maps"') : shown.index('id="robots"')]
    assert re.search(r">7 more</td><td[^>]*>90<", maps)
