"""`share edge --headset` as a process: it is killed, and its wearers come back without a code."""

from __future__ import annotations

import json
import re
import time
import urllib.request
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from helpers.children import Child, start_agent
from helpers.map_changes import small_map

from share.store.map_store import MapStore

pytestmark = [
    pytest.mark.skipif(find_spec("websockets") is None, reason="websockets is not installed"),
    pytest.mark.long,
]
if find_spec("websockets") is not None:
    from helpers.headset_client import WAIT_S, PageClient, soon


@pytest.fixture(autouse=True)
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))
    return tmp_path / "settings" / "share" / "headset"


def start(folder: Path, name: str, headset: str, *more: str) -> tuple[Child, str, str]:
    """An edge with a page; its address, and that of its status page."""
    edge = Child(
        folder / f"{name}.log",
        *("edge", "--bind", "tcp://127.0.0.1:0", "--http", "127.0.0.1:0", "--allow", "objects"),
        *("--headset", headset, "--out", str(folder / name), *more),
    )
    page = edge.wait_for(r"headset page at (http\S+)/", WAIT_S)[1]
    return edge, page, edge.wait_for(r"status at (http\S+)", WAIT_S)[1]


def fetched(url: str) -> str:
    with urllib.request.urlopen(url, timeout=WAIT_S) as answer:
        return str(answer.read().decode())


def test_an_edge_is_killed_and_its_wearer_goes_on(tmp_path: Path, settings: Path) -> None:
    with MapStore.open(tmp_path / "room.sqlite") as store:
        store.write(small_map(4))
        map_id = _map_of(store)
    at_map = ("--map", str(tmp_path / "room.sqlite"))
    edge, page, status = start(tmp_path, "first", "http://127.0.0.1:0", *at_map)
    code = edge.wait_for(r"the code for the next wearer is (\d{8})", WAIT_S)[1]
    shown = json.loads(fetched(f"{status}snapshot.json"))["headset"]
    assert (shown["code"], shown["address"], shown["wearers"]) == (code, f"{page}/", {})
    with PageClient(page) as ann:
        welcome = ann.hello(code=code, name="ann", agent="ann")
        assert welcome["may"] == {"objects": True, "commands": False}
        ann.keep_alive()
        ann.put(1, 5, 1.5, map_id=map_id)
        assert ann.wait("receipt") == {"type": "receipt", "request": 1, "reason": ""}
        ann.send(type="measured", mode="align", frames=140, over_20ms=7, p50_ms=12.5)
        assert soon(lambda: "share_edge_headset_frames{" in fetched(f"{status}metrics"))
        metrics = fetched(f"{status}metrics")
        labels = '{agent="ann",mode="align",wearer="ann"}'
        assert f"share_edge_headset_late_frames{labels} 7.0\n" in metrics
        assert re.search(r'share_edge_headset_lag_seconds\{.*quantile="0.5".*\} 0.0125\n', metrics)
        edge.kill()
        assert ann.is_closed()

    def again() -> Any:
        with suppress(AssertionError):  # the port may be held a moment longer
            return start(tmp_path, "second", page, *at_map)

    edge, page, status = soon(again)
    with PageClient(page) as ann:
        assert ann.hello(session=welcome["session"])["name"] == "ann"
        ann.keep_alive()
        seen = ann.wait("objects", lambda m: bool(m["objects"]))
        assert [(one["id"], one["owner"]) for one in seen["objects"]] == [(5, "ann")]
        assert edge.interrupt(WAIT_S) == 0
        assert ann.is_closed()
    assert "headset" not in json.loads((tmp_path / "second" / "edge.json").read_text())
    assert (settings / "headset.secret").stat().st_mode & 0o777 == 0o600


def test_wearers_see_agents_that_track_in_their_map(tmp_path: Path, plain_session: Path) -> None:
    T = [[0.0, -1, 0, 0.01], [1, 0, 0, -0.08], [0, 0, 1, 0.05], [0, 0, 0, 1]]
    (tmp_path / "headset.yaml").write_text(f"T_body_viewer: {T}\ntimeshift_device_headset: 0.002\n")
    mount = ("--mount", f"ann={tmp_path}")
    edge, page, status = start(tmp_path, "edge", "http://127.0.0.1:0", *mount)
    address = edge.wait_for(r"listening on (tcp://\S+?),")[1]

    used = [""]

    def wearer(name: str) -> tuple[PageClient, dict[str, Any]]:
        def shown() -> Any:
            code = json.loads(fetched(f"{status}snapshot.json"))["headset"]["code"]
            return code != used[-1] and code

        code, client = soon(shown), PageClient(page)
        used.append(code)
        welcome = client.hello(code=code, name=name, agent=name)
        client.keep_alive()
        return client, welcome

    edge.wait_for("the code for the next wearer", WAIT_S)
    ann, welcome = wearer("ann")
    assert welcome["T_body_viewer"] == [x for row in T for x in row] and welcome["mount_timeshift_ms"] == 2.0
    bob, welcome = wearer("bob")
    assert welcome["T_body_viewer"] is None
    began_ms = time.monotonic_ns() / 1e6
    agents: list[Child] = []
    of_bob: list[dict[str, Any]] = []

    def is_over(message: dict[str, Any]) -> bool:
        """Whether some of bob's poses have come with a map and how it moves, or it has left."""
        found = [one for one in message["poses"] if one["agent"] == "bob"]
        of_bob.extend(one for one in found if one["map_id"] and one["velocity"])
        return len(of_bob) >= 3 or any(one["state"] == "GONE" for one in found)

    try:
        for attempt in range(4):  # on a busy machine three seconds may be over before there is a map
            for name, recording in (("ann", "ar1"), ("bob", "ar2")):
                folder = tmp_path / f"attempt{attempt}"
                folder.mkdir(exist_ok=True)
                agents.append(start_agent(folder, name, plain_session / recording, address))
            ann.wait("poses", is_over)
            if of_bob:
                break
        for one in of_bob:
            assert began_ms < one["t_ms"] < time.monotonic_ns() / 1e6 and one["state"] in ("OK", "WEAK")
            assert max(map(abs, one["velocity"])) < 3 and max(map(abs, one["angular_velocity"])) < 4
        ann.send(type="points", map_id=of_bob[-1]["map_id"])
        assert ann.wait("points")["count"] > 0
        bob.put(1, 5, 1.0, map_id=of_bob[-1]["map_id"])
        assert bob.wait("receipt")["reason"] == ""
        seen = ann.wait("objects", lambda m: bool(m["objects"]))
        assert seen["objects"][0]["owner"] == "bob"
    finally:
        for client in (ann, bob):
            client.close()
        for agent in agents:
            agent.kill()
        edge.kill()


def _map_of(store: MapStore) -> str:
    from share.store.loading import decode_map

    poses = decode_map(store.rows()).poses
    assert poses is not None
    return poses.map_ids[0]


@pytest.mark.skipif(find_spec("cryptography") is None, reason="cryptography is not installed")
def test_a_page_is_encrypted_by_a_certificate_whose_fingerprint_is_said(tmp_path: Path) -> None:
    import hashlib
    import ssl

    edge, page, _ = start(tmp_path, "edge", "127.0.0.1:0")
    said = edge.wait_for(r"its certificate has the SHA-256 ([0-9A-F:]+)", WAIT_S)[1]
    host, port = page.removeprefix("https://").split(":")
    found = ssl.PEM_cert_to_DER_cert(ssl.get_server_certificate((host, int(port)), timeout=WAIT_S))
    assert said.replace(":", "").lower() == hashlib.sha256(found).hexdigest()
    code = edge.wait_for(r"the code for the next wearer is (\d{8})", WAIT_S)[1]
    trusting = ssl.create_default_context(cadata=ssl.DER_cert_to_PEM_cert(found))
    with PageClient(page, ssl=trusting) as ann:
        assert ann.hello(code=code, name="ann")["type"] == "welcome"
    assert edge.interrupt(WAIT_S) == 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--mount", "ann=x"], "--headset-cert, --headset-key, --mount: they are for --headset; give it too"),
        (["--headset", "x"], "'x' is not an address to serve at; expected HOST:PORT"),
        (["--headset", "http://0.0.0.0:1"], "a browser gives WebXR to an encrypted page only"),
        (["--headset", "http://127.0.0.1:0", "--mount", "ann"], "--mount ann: expected NAME=FILE"),
        (["--headset", "http://127.0.0.1:0", "--policy", "streamed"], "policy streamed builds no map"),
        (["--headset", "127.0.0.1:0", "--headset-key", "x"], "give both, or leave both out"),
    ],
)
def test_what_cannot_be_is_one_line(share: Any, options: list[str], said: str) -> None:
    began = time.monotonic()
    done = share("edge", "--bind", "tcp://127.0.0.1:0", *options)
    assert done.code == 2 and said in re.sub(r"\s+", " ", done.err) and time.monotonic() - began < 60
    assert len([line for line in done.err.splitlines() if line.startswith("share:")]) == 1
