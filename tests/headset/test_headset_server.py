"""The headset page over loopback: a process of its own beside an edge, pages that are sockets."""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.room_server import MAP, RoomServer

from share.errors import ShareError, TransportError, UsageError
from share.headset.certificate import default_folder
from share.headset.headset_page import HeadsetPage, local_address, page_address
from share.headset.outbox import MAX_UNSEEN
from share.headset.page_messages import PageMeasured
from share.headset.session_ledger import LEDGER_FILE
from share.headset.wearers import EdgeAccess
from share.mapping.loops import KeyframeKey
from share.net.keys import authorize, generate_pair, revoke
from share.net.transport import Address
from share.protocol.room_events import MessageWanted, RobotCommanded
from share.runtime.room_link import RoomLink
from share.types import AgentKind, TrackState
from share.view import events as ev
from share.wire.room_messages import Cancel, CommandState, Goto, ObjectKind, Permission, RobotPlace

pytestmark = [
    pytest.mark.skipif(find_spec("websockets") is None, reason="websockets is not installed"),
    pytest.mark.long,
]
if find_spec("websockets") is not None:
    from helpers.headset_client import PageClient, code, paired, soon
    from websockets.exceptions import InvalidStatus

ALL = frozenset(Permission)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A page's folder, and a folder of settings beside the user's."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "index.html").write_text("<!doctype html><title>x</title>")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(folder / "settings"))
        yield folder


@pytest.fixture(scope="module")
def edge() -> Iterator[RoomServer]:
    with RoomServer() as server:
        yield server


def serve(site: Path, address: str, endpoint: str = "127.0.0.1:0", **options: Any) -> HeadsetPage:
    """endpoint: of a page that has ended, which sessions are bound to."""
    access = options.pop("access", EdgeAccess(address, ALL))
    return HeadsetPage(f"http://{endpoint}", access, folder=site, **options)


@pytest.fixture(scope="module")
def served(site: Path, edge: RoomServer) -> Iterator[HeadsetPage]:
    with closing(serve(site, edge.address)) as page:
        assert code(page)
        yield page


@pytest.fixture
def fresh(site: Path, edge: RoomServer) -> Iterator[HeadsetPage]:
    """One whose limits nobody has used yet."""
    with closing(serve(site, edge.address)) as page:
        assert code(page)
        yield page


def test_two_wearers_see_one_object_and_its_owner(fresh: HeadsetPage, edge: RoomServer) -> None:
    with paired(fresh, "ann", "ann") as ann, paired(fresh, "bob") as bob:
        began = time.monotonic()
        ann.put(7, 5, 1.5)
        seen = bob.wait("objects", lambda m: bool(m["objects"]))
        late_s = time.monotonic() - began
        (one,) = seen["objects"]
        assert one == {
            "id": 5,
            "kind": "cube",
            "owner": "ann",
            "map_id": MAP,
            "position": [1.5, 0, 0],
            "quaternion": [0, 0, 0, 1],
        }
        assert ann.wait("receipt") == {"type": "receipt", "request": 7, "reason": ""}
        assert late_s < 30.0
        bob.put(1, 5, 2.0)  # whoever may place objects moves it; its owner stays
        moved = ann.wait("objects", lambda m: any(o["position"][0] == 2 for o in m["objects"]))
        assert moved["objects"][0]["owner"] == "ann"
        bob.send(type="remove", request=2, id=5)
        gone = ann.wait("objects", lambda m: bool(m["removed"]))
        assert gone["removed"] == [{"id": 5, "reason": "removed by 'bob'"}]
        ann.put(8, 6, 1e4)
        assert "more than 1000 m away" in ann.wait("receipt")["reason"]
        ann.put(9, 6, 1.0, quaternion=[0, 0, 0, 0])
        assert "its length is not 1" in ann.wait("receipt")["reason"]
        assert {one["name"] for one in edge.edge.room.report()["clients"]} >= {"ann", "bob"}


def test_without_keys_the_code_is_for_every_program_of_the_machine(served: HeadsetPage) -> None:
    assert served.shown_report(is_guarded=False)["code"] == code(served) != ""


def test_the_page_learns_the_servers_clock(fresh: HeadsetPage) -> None:
    with paired(fresh, "ann") as ann:
        before_ms = time.monotonic_ns() / 1e6
        ann.send(type="ping", n=3, sent_ms=12.5)
        pong = ann.wait("pong", lambda m: m["n"] == 3)
        assert (pong["n"], pong["sent_ms"]) == (3, 12.5)
        assert before_ms <= pong["t_ms"] <= time.monotonic_ns() / 1e6


def test_nothing_is_said_before_a_code(fresh: HeadsetPage) -> None:
    with PageClient(fresh.endpoint) as stranger:
        with pytest.raises(TimeoutError):
            stranger.hear(0.5)
        stranger.send(type="ping", n=1, sent_ms=0)
        assert stranger.hear() == {
            "type": "refused",
            "reason": "a page begins with hello",
            "is_over": False,
            "is_outdated": False,
        }
        assert stranger.is_closed()
    used = code(fresh)
    paired(fresh, "ann").close()
    for wrong in ({"code": used, "name": "bob"}, {"session": "A" * 64}):  # replayed; forged
        with PageClient(fresh.endpoint) as stranger:
            answer = stranger.hello(**wrong)
            assert answer["type"] == "refused" and set(answer) == {"type", "reason", "is_over", "is_outdated"}
            assert answer["is_over"] == ("session" in wrong)
            assert stranger.is_closed() and len(stranger.seen) == 1
    assert code(fresh) != used


def test_a_page_of_another_release_is_told_to_load_itself_again(fresh: HeadsetPage) -> None:
    with PageClient(fresh.endpoint) as old:
        old.send(type="hello", schema=2, session="x", further=[1])
        answer = old.hear()
        assert answer["is_outdated"] and not answer["is_over"]
        assert answer["reason"].startswith("this page is of another release than the edge: load it again")
        assert old.is_closed()


def test_a_code_is_not_used_up_by_a_name_that_is_none(fresh: HeadsetPage) -> None:
    right = code(fresh)
    for name in ("<img src=x onerror=alert(1)>", "a\u202eb"):
        with PageClient(fresh.endpoint) as one:
            assert "name: U+" in one.hello(code=right, name=name)["reason"]
    with PageClient(fresh.endpoint) as one:
        assert one.hello(code=right, name="ann", agent=None)["type"] == "welcome"


@pytest.mark.parametrize("origin", [None, "http://evil.example", "null"])
def test_another_origin_opens_no_socket(served: HeadsetPage, origin: str | None) -> None:
    with pytest.raises(InvalidStatus) as refused, PageClient(served.endpoint, origin=origin):
        pass
    assert refused.value.response.status_code == 403


def get(endpoint: str, path: str, **headers: str) -> tuple[int, http.client.HTTPMessage, bytes]:
    connection = http.client.HTTPConnection(endpoint, timeout=10)
    with closing(connection):
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()


def test_files_come_with_a_strict_policy(served: HeadsetPage) -> None:
    status, headers, body = get(served.endpoint, "/")
    assert status == 200 and body.startswith(b"<!doctype html>")
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    policy = headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self'")
    assert headers["X-Content-Type-Options"] == "nosniff" and headers["X-Frame-Options"] == "DENY"
    assert get(served.endpoint, "/../settings/share/headset/headset.secret")[0] == 404
    assert get(served.endpoint, "/", Host="evil.example")[0] == 403
    assert get(served.endpoint, "/", Host="[fe80::1%x;script-src *]")[0] == 403
    assert get(served.endpoint, "/", Host="[fe80::1%eth0]")[0] == 200
    assert get(served.endpoint, "/room")[0] == 404


def test_a_session_comes_back_and_the_newest_page_has_it(fresh: HeadsetPage) -> None:
    with PageClient(fresh.endpoint) as first:
        used = code(fresh)
        welcome = first.hello(code=used, name="ann", agent="ann")
        first.wait("edge", lambda m: m["is_connected"])
        first.put(1, 11, 1.0)
        first.wait("receipt")
        with PageClient(fresh.endpoint) as other:
            answer = other.hello(code=code(fresh, used), name="ann")
            assert "'ann' is connected already" in answer["reason"]
        with PageClient(fresh.endpoint) as second:
            again = second.hello(session=welcome["session"])
            assert (again["type"], again["name"], again["agent"]) == ("welcome", "ann", "ann")
            assert second.wait("objects")["all"]
            refusal = first.wait("refused")
            assert refusal["reason"] == "another page goes on as 'ann'" and first.is_closed()
            second.put(2, 11, 2.0)
            assert second.wait("receipt")["reason"] == ""
    assert soon(lambda: not fresh.report()["wearers"]["ann"]["is_connected"])
    with PageClient(fresh.endpoint) as another:  # another headset pairs as ann, who is away
        assert another.hello(code=code(fresh), name="ann")["type"] == "welcome"
        with PageClient(fresh.endpoint) as old:
            assert "another headset has paired" in old.hello(session=welcome["session"])["reason"]


class Bridge(threading.Thread):
    """Robot `tb`, which drives to whatever it is sent, until told otherwise."""

    def __init__(self, address: str) -> None:
        super().__init__()
        self._link = RoomLink(address, "tb", drives_robot=True)
        self.goals: list[tuple[float, Goto]] = []  # with when
        self._is_ended, self.stops = False, 0

    def __enter__(self) -> Bridge:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_ended = True
        self.join()
        self._link.close()

    def is_told(self, within_s: float) -> bool:
        """Whether it was told to drive so lately."""
        return bool(self.goals) and time.monotonic() - self.goals[-1][0] < within_s

    def run(self) -> None:
        while not self._is_ended:
            for effect in self._link.step(50):
                if isinstance(effect, RobotCommanded):
                    self._obey(effect.command)
            self._link.handle(MessageWanted(RobotPlace(None, MAP, 0.5, 1.0, 0.25, "ready")))

    def _obey(self, command: Goto | Cancel) -> None:
        if is_stop := isinstance(command, Cancel):
            self.goals.clear()
            self.stops += 1
        else:
            self.goals.append((time.monotonic(), command))
        text = "stopped" if is_stop else "drives"
        state = CommandState(command.command, None, command.commander, text, is_stop, is_stop)
        self._link.handle(MessageWanted(state))


def test_a_robot_comes_and_stops_and_all_are_told(fresh: HeadsetPage, edge: RoomServer) -> None:
    with Bridge(edge.address) as tb, paired(fresh, "ann") as ann, paired(fresh, "bob") as bob:
        place = {"robot": "tb", "map_id": MAP, "x": 0.5, "y": 1.0, "yaw": 0.25, "text": "ready"}
        assert ann.wait("robots")["robots"] == [place]
        ann.send(type="goto", command=9, robot=None, map_id=None, x=1.5, y=2, yaw=None)
        state = ann.wait("command")
        assert (state["command"], state["robot"], state["text"]) == (9, "tb", "drives")
        assert not state["is_final"]
        seen = bob.wait("command")
        assert (seen["command"], seen["commander"], seen["robot"]) == (None, "ann", "tb")
        assert soon(lambda: len(tb.goals) >= 4)  # the server repeats it
        assert {(goal.x, goal.y, goal.commander) for _, goal in tb.goals} == {(1.5, 2.0, "ann")}
        bob.send(type="cancel", command=1, robot=None)  # anybody may stop it
        stopped = bob.wait("command", lambda m: m["command"] == 1)
        assert stopped["is_final"] and stopped["text"] == "stopped"
        bob.send(type="cancel", command=1, robot=None)  # the same one again
        assert bob.wait("command") == stopped
        ann.send(type="goto", command=20, robot="tb", map_id=None, x=1e5, y=2, yaw=None)
        assert "more than 1000 m away" in ann.wait("command", lambda m: m["command"] == 20)["text"]
        for k in range(30):
            ann.send(type="goto", command=100 + k, robot="tb", map_id=None, x=1, y=2, yaw=None)
        refused = ann.wait("command", lambda m: "too many" in m["text"])
        assert refused["text"] == "refused: too many commands at once" and refused["is_final"]
        ann.send(type="cancel", command=201, robot="tb")
        assert ann.wait("command", lambda m: m["command"] == 201)["text"] == "stopped"


@pytest.mark.slow
def test_a_page_that_is_silent_is_let_go_and_its_robot_stops(fresh: HeadsetPage, edge: RoomServer) -> None:
    with Bridge(edge.address) as tb, paired(fresh, "ann", keeps_alive=False) as ann:
        began = time.monotonic()
        ann.send(type="goto", command=1, robot=None, map_id=None, x=1.5, y=2, yaw=None)
        assert soon(lambda: tb.is_told(within_s=2.0))
        assert ann.is_closed() and time.monotonic() - began > 4.0
        assert soon(lambda: tb.stops == 1, within_s=5.0)  # it is told so, and nothing after that
        with PageClient(fresh.endpoint) as again:  # its session is good all the same
            assert again.hello(session=ann.seen[0]["session"])["type"] == "welcome"
            state = again.wait("command", lambda m: m["command"] == 1)
            assert state["is_final"] and "was away" in state["text"]
        assert not tb.goals
        assert soon(lambda: "ann" not in fresh.report()["wearers"])


@pytest.mark.slow
def test_a_tab_that_is_closed_stops_its_robot_at_once_a_gap_does_not(
    fresh: HeadsetPage, edge: RoomServer
) -> None:
    with Bridge(edge.address) as tb:
        ann = paired(fresh, "ann")
        session = ann.seen[0]["session"]
        ann.send(type="goto", command=1, robot=None, map_id=None, x=1.5, y=2, yaw=None)
        assert soon(lambda: tb.is_told(within_s=2.0))
        ann.socket.socket.shutdown(socket.SHUT_RDWR)  # as where the network has gone
        ann.close()
        time.sleep(3.0)
        assert tb.is_told(within_s=2.0) and not tb.stops
        with PageClient(fresh.endpoint) as again:
            assert again.hello(session=session)["type"] == "welcome"
        assert soon(lambda: tb.stops == 1, within_s=3.0) and not tb.goals


def raw_page(endpoint: str, **hello: Any) -> socket.socket:
    """A page that says hello, and then neither reads nor answers a close."""
    host, port = endpoint.split(":")
    raw = socket.create_connection((host, int(port)), 10)
    names = f"Host: {endpoint}\r\nOrigin: http://{endpoint}\r\nUpgrade: websocket\r\nConnection: Upgrade"
    key = "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13"
    raw.sendall(f"GET /room HTTP/1.1\r\n{names}\r\n{key}\r\n\r\n".encode())
    data = json.dumps({"type": "hello", "schema": 1, **hello}).encode()
    head = bytes([0x81]) + (bytes([0x80 | len(data)]) if len(data) < 126 else bytes([0xFE, 0, len(data)]))
    raw.sendall(head + bytes(4) + data)  # masked with zeros
    return raw


def test_a_page_that_comes_back_is_heard_though_the_old_one_is_dead(
    fresh: HeadsetPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(raw_page(fresh.endpoint, code=code(fresh), name="ann")) as old:
        said = b""
        while b'"session":"' not in said:
            said += old.recv(4096)
        session = said.partition(b'"session":"')[2].partition(b'"')[0].decode()
        with PageClient(fresh.endpoint) as again:
            assert again.hello(session=session)["type"] == "welcome"
            began = time.monotonic()
            again.send(type="ping", n=1, sent_ms=0)
            again.wait("pong")
            assert time.monotonic() - began < 0.9  # it took the second that the old one has to close


def test_who_is_taken_off_the_list_has_to_go_and_may_come_back(
    site: Path, edge: RoomServer, tmp_path: Path
) -> None:
    keys = tmp_path / "keys"
    public = [generate_pair(keys / name, name).public for name in ("edge", "ann", "bob")]
    folder = keys / "edge"

    def give(objects: bool) -> None:
        authorize(folder, "ann", public[1], permissions={Permission.OBJECTS: objects})

    give(objects=True)
    authorize(folder, "bob", public[2])
    access = EdgeAccess(edge.address, ALL, folder, public[0], bytes(32))
    told: list[str] = []
    with closing(serve(site, edge.address, access=access, notify=told.append)) as page:
        assert code(page) == page.shown_report(is_guarded=True)["code"]
        assert code(page) not in str(page.shown_report(is_guarded=False))
        with PageClient(page.endpoint) as ann:
            welcome = ann.hello(code=code(page), name="ann")
            assert welcome["may"] == {"objects": True, "commands": False}
            ann.keep_alive()
            revoke(folder, "ann")
            ann.put(5, 1, 1.0)
            assert "no agent 'ann'" in ann.wait("receipt", lambda m: m["request"] == 5)["reason"]
            refused = ann.wait("refused")
            assert "share keys authorize ann ann.public" in refused["reason"] and not refused["is_over"]
            assert ann.is_closed()
        assert soon(lambda: any("'ann' has to go" in line for line in told))
        give(objects=False)
        with PageClient(page.endpoint) as ann:
            assert ann.hello(session=welcome["session"])["may"]["objects"] is False
            ann.keep_alive()
            give(objects=True)
            assert ann.is_closed()  # it comes back by itself, and is told
        with PageClient(page.endpoint) as ann:
            assert ann.hello(session=welcome["session"])["may"]["objects"] is True
            ann.keep_alive()
            (folder / "authorized").write_bytes(b"\0garbage")
            time.sleep(1.5)
            with PageClient(page.endpoint) as other:
                said = other.hello(session=welcome["session"])
                assert "the edge's list of keys cannot be used" in said["reason"] and not said["is_over"]
            ann.send(type="ping", n=1, sent_ms=0)
            ann.wait("pong", lambda m: m["n"] == 1)  # who is here stays
            (folder / "authorized").unlink()
            assert "no agent 'ann'" in ann.wait("refused")["reason"]  # though it asks for nothing


def test_what_is_malformed_or_too_large_ends_only_its_sender(fresh: HeadsetPage) -> None:
    with paired(fresh, "bob") as bob:
        ann = paired(fresh, "ann")
        session = ann.seen[0]["session"]
        for bad in (
            '{"type":"put"}',
            "x" * 15_000,
            "x" * 17_000,
            b"\xff\x00",
            json.dumps({"type": "hello", "schema": 1, "session": session}),
            '{"type":"goto","command":1,"x":NaN,"y":0}',
        ):
            ann.socket.send(bad)
            assert ann.is_closed(), bad[:20]
            ann = PageClient(fresh.endpoint)
            assert ann.hello(session=session)["type"] == "welcome"
        ann.close()
        bob.send(type="ping", n=1, sent_ms=0)
        assert bob.wait("pong", lambda m: m["n"] == 1)


def test_a_page_that_floods_ends_alone(fresh: HeadsetPage) -> None:
    with paired(fresh, "bob") as bob, paired(fresh, "ann") as ann:
        with suppress(Exception):
            for k in range(5000):
                ann.send(type="ping", n=k, sent_ms=0)
        assert ann.is_closed()
        bob.send(type="ping", n=1, sent_ms=0)
        assert bob.wait("pong", lambda m: m["n"] == 1)


@pytest.mark.slow
def test_a_hundred_connections_keep_no_wearer_out(fresh: HeadsetPage) -> None:
    host, port = fresh.endpoint.split(":")
    with paired(fresh, "ann") as ann:
        silent = [socket.create_connection((host, int(port)), 10) for _ in range(150)]
        pages = []
        try:
            for _ in range(20):
                with suppress(InvalidStatus):
                    pages.append(PageClient(fresh.endpoint))
            assert len(pages) == 16
            ann.send(type="ping", n=1, sent_ms=0)
            assert ann.wait("pong", lambda m: m["n"] == 1)
            for one in pages:  # whoever says nothing has its place for five seconds
                assert one.is_closed()
                ann.send(type="ping", n=2, sent_ms=0)
            with paired(fresh, "bob") as bob:
                bob.put(1, 21, 1.0)
                assert bob.wait("receipt")["reason"] == ""
        finally:
            for one in silent:
                one.close()


def test_poses_are_relayed_the_newest_at_sixty_hertz(fresh: HeadsetPage) -> None:
    feed = fresh.feed
    key = KeyframeKey("tb-1", 0)
    feed.add_event(ev.RunArrived("tb-1", "tb", AgentKind.ROBOT, np.eye(4), (0.8, 0.6)))
    feed.add_event(ev.KeyframeArrived(key, True, np.eye(4), np.ones((4, 3), np.float32), b"no image"))
    feed.add_event(ev.CorrectionArrived("tb-1", MAP, np.eye(4), 0))
    with paired(fresh, "ann", "ann") as ann:
        T, began = np.eye(4), time.monotonic()
        for k in range(200):
            T[0, 3] = 0.01 * k
            now_ns = time.monotonic_ns()
            feed.add_event(ev.PoseArrived("tb-1", TrackState.OK, 0, T.copy(), 2.0, now_ns - 10**12, now_ns))
            time.sleep(0.005)
        last = ann.wait("poses", lambda m: m["poses"][0]["position"] == [1.99, 0, 0])["poses"][0]
        came = [m for m in ann.seen if m["type"] == "poses"]
        assert len(came) <= 1 + 61 * (time.monotonic() - began)
        assert len(came) <= 2 * MAX_UNSEEN  # it read nothing for the first second
        assert (last["agent"], last["kind"], last["state"], last["map_id"]) == ("tb", "robot", "OK", MAP)
        assert last["t_ms"] == pytest.approx(now_ns / 1e6 - 2.0, abs=1.0)
        assert 0 < last["velocity"][0] <= 2.0
        assert any("path" in m["poses"][0] for m in came)
        ann.send(type="points", map_id=MAP)
        points = ann.wait("points")
        assert (points["count"], points["part"], points["parts"]) == (4, 0, 1)
        ann.send(type="ping", n=1, sent_ms=0)
        feed.add_event(ev.CorrectionArrived("tb-1", "other", np.eye(4), 0))  # not ann's agent
        feed.add_event(ev.RunArrived("ann-1", "ann", AgentKind.AR, np.eye(4), (0.8, 0.6)))
        feed.add_event(ev.CorrectionArrived("ann-1", "old", np.eye(4), 0))
        feed.add_event(ev.CorrectionArrived("ann-1", MAP, T, 0))
        moved = ann.wait("map_changed")
        assert (moved["old"], moved["new"], moved["T_new_old"][3]) == ("old", MAP, 1.99)


def test_what_pages_measure_is_in_the_report_and_in_a_table(
    site: Path, edge: RoomServer, tmp_path: Path
) -> None:
    measured = {"mode": "follow", "frames": 144, "over_20ms": 30, "p50_ms": 18.5, "p95_ms": 31.0}
    measured |= {"p99_ms": 40.25, "alignment_mm": None, "drift_mm_s": 0.5}
    with closing(serve(site, edge.address, out=tmp_path)) as page, paired(page, "ann", "ann") as ann:
        for _ in range(20):  # more than one in a second is left out
            ann.send(type="measured", **measured)
        assert soon(lambda: page.report()["wearers"]["ann"]["frames"] == 144)
        told = page.report()["wearers"]["ann"]
        assert told == {"agent": "ann", "is_connected": True, "is_connected_to_edge": True, **measured}
        head, *rows = (tmp_path / "headset.csv").read_text().splitlines()
        assert head == ",".join(["t_s", "wearer", "agent", *PageMeasured.__struct_fields__])
        assert 1 <= len(rows) <= 5 and rows[0].endswith(",ann,ann,follow,144,30,18.5,31.0,40.25,,0.5")


def test_a_server_that_is_killed_comes_back_and_knows_its_wearers(
    site: Path, edge: RoomServer, tmp_path: Path
) -> None:
    told: list[str] = []
    with closing(serve(site, edge.address, out=tmp_path, notify=told.append)) as page:
        ann = paired(page, "ann", "ann")
        session = ann.seen[0]["session"]
        ann.send(type="measured", mode="align", frames=1, over_20ms=0)
        assert soon(lambda: page.report()["wearers"]["ann"]["frames"])
        os.kill(page.pid or 0, signal.SIGKILL)
        assert ann.is_closed()
        assert soon(lambda: any("starts again in 1 s" in line for line in told))

        def back() -> Any:
            with suppress(OSError):
                return PageClient(page.endpoint)

        with soon(back) as again:
            assert again.hello(session=session)["name"] == "ann"
            again.wait("edge", lambda m: m["is_connected"])
            again.send(type="measured", mode="align", frames=2, over_20ms=0)
            table = tmp_path / "headset.csv"
            assert soon(lambda: len(table.read_text().splitlines()) == 3)  # nothing of before is lost
    assert told[0].startswith("headset page: the code for the next wearer is ")
    assert "headset page: 'ann' has paired, with the device of 'ann'" in told


def paired_twice(site: Path, edge: RoomServer) -> tuple[str, str, str]:
    """Return the address of a server that has ended, and ann's older and newer session there."""
    with closing(serve(site, edge.address)) as page:
        with paired(page, "ann") as first:
            old = first.seen[0]["session"]
        assert soon(lambda: not page.report()["wearers"].get("ann", {"is_connected": False})["is_connected"])
        with paired(page, "ann") as second:
            return page.endpoint, old, second.seen[0]["session"]


def test_a_session_that_is_over_stays_so_after_a_start(site: Path, edge: RoomServer) -> None:
    endpoint, old, new = paired_twice(site, edge)
    with closing(serve(site, edge.address, endpoint)) as page:
        code(page)
        for session, answer in ((old, "refused"), (new, "welcome"), (old, "refused")):
            with PageClient(page.endpoint) as one:
                said = one.hello(session=session)
                assert said["type"] == answer
                assert answer == "welcome" or (said["is_over"] and "another headset" in said["reason"])


def test_who_removes_what_sessions_are_signed_with_has_all_pair_anew(
    site: Path, edge: RoomServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the edge advises where the ledger is damaged: also while it runs, from the page's next start on."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    told: list[str] = []
    with closing(serve(site, edge.address, notify=told.append)) as page:
        sessions = []
        for _ in range(2):
            with paired(page, "ann") as ann:
                sessions.append(ann.seen[0]["session"])
            assert soon(lambda: not page.report()["wearers"].get("ann", {"is_connected": 0})["is_connected"])
        (default_folder() / LEDGER_FILE).write_text("[{")
        with paired(page, "bob"):
            pass
        assert any("as it is, the page cannot start again" in line for line in told)
        os.kill(page.pid or 0, signal.SIGKILL)
        assert soon(lambda: any("has ended (LedgerDamagedError: " in line for line in told))
        for name in (LEDGER_FILE, "headset.secret"):
            (default_folder() / name).unlink()

        def back() -> Any:
            with suppress(OSError):
                return PageClient(page.endpoint)

        for session in sessions:
            with soon(back) as again:
                said = again.hello(session=session)
                assert said["is_over"] and "not known here" in said["reason"]


def test_two_edges_of_a_machine_have_sessions_of_their_own(site: Path, edge: RoomServer) -> None:
    with closing(serve(site, edge.address)) as one, closing(serve(site, edge.address)) as other:
        sessions = []
        for page in (one, other):
            with paired(page, "ann" if page is one else "bob") as ann:
                sessions.append(ann.seen[0]["session"])
        for page, session, answer in (
            (one, sessions[0], "welcome"),
            (other, sessions[0], "refused"),
            (other, sessions[1], "welcome"),
            (one, sessions[1], "refused"),
        ):
            with PageClient(page.endpoint) as again:
                said = again.hello(session=session)
                assert said["type"] == answer
                assert answer == "welcome" or (said["is_over"] and "not known here" in said["reason"])


def test_a_page_whose_place_a_newer_session_takes_is_told(site: Path, edge: RoomServer) -> None:
    """What the server knew of sessions is lost, so the older page was let in; its STOP reached nobody."""
    endpoint, old, new = paired_twice(site, edge)
    for file in default_folder().glob(LEDGER_FILE):
        file.unlink()
    with closing(serve(site, edge.address, endpoint)) as page, PageClient(page.endpoint) as older:
        assert older.hello(session=old)["type"] == "welcome"
        with PageClient(page.endpoint) as newer:
            assert newer.hello(session=new)["type"] == "welcome"
            said = older.wait("refused")
            assert said["is_over"] and "another headset has paired as 'ann' since" in said["reason"]


def test_an_edge_that_goes_and_comes_is_told_and_all_heals(site: Path) -> None:
    first = RoomServer()
    with first:
        page = serve(site, first.address)
        ann = paired(page, "ann")
        ann.put(1, 31, 1.0)
        assert ann.wait("receipt")["reason"] == ""
        kept = first.edge.room.kept_objects()
    with closing(page), ann:
        assert not ann.wait("edge")["is_connected"]  # the page goes on
        ann.put(2, 31, 2.0)
        with RoomServer(address=first.address, session=8, objects=kept) as second:
            assert ann.wait("edge")["is_connected"]
            assert ann.wait("receipt") == {"type": "receipt", "request": 2, "reason": ""}
            (one,) = second.edge.room.kept_objects()
            assert one.object.T_map_object[0, 3] == 2.0 and one.object.owner == "ann"
            assert one.object.kind is ObjectKind.CUBE


@pytest.mark.slow
def test_a_page_that_does_not_read_holds_up_nobody(fresh: HeadsetPage) -> None:
    feed = fresh.feed
    for k in range(200):
        feed.add_event(ev.RunArrived(f"a{k}-1", f"a{k}", AgentKind.AR, np.eye(4), (0.8, 0.6)))
        feed.add_event(ev.CorrectionArrived(f"a{k}-1", MAP, np.eye(4), 0))
    with paired(fresh, "bob") as bob:
        host, port = fresh.endpoint.split(":")
        with closing(socket.socket()) as raw:
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            raw.connect((host, int(port)))
            deaf = PageClient(fresh.endpoint, sock=raw, max_queue=1)
            assert deaf.hello(code=code(fresh), name="ann")["type"] == "welcome"
            assert soon(lambda: fresh.report()["wearers"].get("ann", {}).get("is_connected"))
            began, is_gone, stamp = time.monotonic(), False, 0
            while time.monotonic() - began < 60 and not is_gone:
                for k in range(200):
                    stamp += 1
                    pose = ev.PoseArrived(f"a{k}-1", TrackState.OK, -1, np.eye(4), 0.0, stamp, stamp)
                    feed.add_event(pose)
                with suppress(Exception):
                    deaf.send(type="ping", n=1, sent_ms=0)
                bob.send(type="ping", n=stamp, sent_ms=0)
                asked = time.monotonic()
                bob.wait("pong", lambda m, n=stamp: m["n"] == n)
                assert time.monotonic() - asked < 5.0
                is_gone = not fresh.report()["wearers"].get("ann", {"is_connected": False})["is_connected"]
                time.sleep(0.02)
            assert is_gone


def test_an_address_is_that_of_this_machine_unless_it_says_more() -> None:
    assert page_address("8443") == (Address("127.0.0.1", 8443), True)
    assert page_address("0.0.0.0:8443") == (Address("0.0.0.0", 8443), True)
    assert page_address("https://[::1]:8443/") == (Address("::1", 8443), True)
    assert page_address("http://localhost:8443") == (Address("127.0.0.1", 8443), False)
    assert local_address("tcp://0.0.0.0:5555") == "tcp://127.0.0.1:5555"
    assert local_address("tcp://[::]:5555") == "tcp://[::1]:5555"
    assert local_address("tcp://192.168.1.5:5555") == "tcp://192.168.1.5:5555"


def test_an_address_that_cannot_be_is_one_line(site: Path, served: HeadsetPage, tmp_path: Path) -> None:
    access = EdgeAccess("tcp://127.0.0.1:5555", ALL)
    for address, said in (
        (f"http://{served.endpoint}", "the port is in use"),
        ("http://192.168.1.5:8443", "--headset http://192.168.1.5:8443: a browser gives WebXR"),
        ("ftp://127.0.0.1:1", "expected HOST:PORT, or http://127.0.0.1:PORT"),
        ("nowhere", "'nowhere' is not an address to serve at"),
    ):
        with pytest.raises((UsageError, TransportError), match=said):
            HeadsetPage(address, access, folder=site)
    with pytest.raises(UsageError, match="give both, or leave both out"):
        HeadsetPage("127.0.0.1:0", access, folder=site, key=tmp_path / "x")
    with pytest.raises(UsageError, match="http:// is not encrypted"):
        HeadsetPage("http://127.0.0.1:0", access, key=tmp_path / "x", certificate=tmp_path / "y")
    for mount, said in (
        ("ann", "expected NAME=FILE"),
        (f"ann={tmp_path / 'none.yaml'}", "no such file"),
        ("a<b=x", "name: U\\+003C"),
    ):
        with pytest.raises(ShareError, match=said):
            HeadsetPage("http://127.0.0.1:0", access, folder=site, mounts=[mount])
