"""The live room as a browser meets it: a process of its own, behind a guard. Needs viser."""

from __future__ import annotations

import http.client
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from share.errors import ShareError, TransportError, UsageError
from share.mapping.loops import KeyframeKey
from share.types import AgentKind, TrackState
from share.view import events as ev
from share.view import page_process, viewer
from share.view.viewer import LiveRoom

needs_viser = pytest.mark.skipif(find_spec("viser") is None, reason="viser is not installed")
MAX_BROWSERS = 16
TOKEN = "a-token-of-24-characters"


def test_a_missing_viser_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"--view: the live room needs viser: pip install 'viser>=1.1,<1.2'"):
        LiveRoom("0", None, "test")


@pytest.fixture
def room() -> Iterator[LiveRoom]:
    with closing(LiveRoom("0", None, "test")) as out:
        yield out


def get(endpoint: str, path: str = "/", **headers: str) -> tuple[int, http.client.HTTPMessage, bytes]:
    connection = http.client.HTTPConnection(endpoint, timeout=30)
    try:
        connection.request("GET", path, headers={k.replace("_", "-"): v for k, v in headers.items()})
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


def messages(data: bytes) -> list[dict[str, Any]]:
    """What viser sends, without its arrays."""
    import zstandard

    size = int.from_bytes(data[8:16], "little")
    inner = zstandard.ZstdDecompressor().decompress(
        data[16 : 16 + size], max_output_size=int.from_bytes(data[:8], "little")
    )
    return list(msgspec.msgpack.decode(inner)["messages"])


def browser(endpoint: str, **options: Any) -> Any:
    import viser
    from websockets.sync.client import connect

    protocol: Any = [f"viser-v{viser.__version__}"]
    return connect(f"ws://{endpoint}/", subprotocols=protocol, max_size=None, open_timeout=30, **options)


def seen(connection: Any, name: str, within_s: float = 20.0) -> bool:
    """Whether a thing of this name is drawn."""
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        try:
            data = connection.recv(timeout=1.0)
        except TimeoutError:
            continue
        if any(one.get("name") == name for one in messages(data)):
            return True
    return False


def show_agent(room: LiveRoom) -> None:
    points = np.random.default_rng(1).uniform(1, 3, (20, 3)).astype(np.float32)
    key = KeyframeKey("ann-1", 0)
    for event in (
        ev.RunArrived("ann-1", "ann", AgentKind.ROBOT, np.eye(4), (0.8, 0.6)),
        ev.KeyframeArrived(key, True, np.eye(4), points, b"no image"),
        ev.CorrectionArrived("ann-1", "A", np.eye(4), 0),
        ev.PoseArrived("ann-1", TrackState.OK, 0, np.eye(4), 5.0),
        ev.DecisionMade(1.0, "maps merged", "ann", "<b>three loops</b>"),
    ):
        room.feed.add_event(event)


@needs_viser
@pytest.mark.long
def test_a_browser_sees_what_is_told_and_nobody_else_does(room: LiveRoom) -> None:
    status, headers, page = get(room.endpoint)
    assert status == 200 and b"<html" in page and headers["X-Frame-Options"] == "DENY"
    assert get(room.endpoint, Host="evil.example")[0] == 403
    assert get(room.endpoint, Origin="http://evil.example")[0] == 403
    assert get(room.endpoint, "/../../../etc/passwd")[0] == 404
    show_agent(room)
    with browser(room.endpoint) as connection:
        assert seen(connection, "/points/0/0")
    with browser(room.endpoint) as later:  # who comes later sees all of it too
        assert seen(later, "/agents/0/upright/robot")
    from websockets.exceptions import InvalidStatus

    with pytest.raises(InvalidStatus) as refused, browser(room.endpoint, origin="http://evil.example"):
        pass
    assert refused.value.response.status_code == 403


@needs_viser
@pytest.mark.long
def test_other_machines_need_the_token() -> None:
    with pytest.raises(UsageError, match="--http-token"):
        LiveRoom("0.0.0.0:0", None, "test")
    with closing(LiveRoom("0.0.0.0:0", TOKEN, "test")) as room:
        endpoint = room.endpoint.replace("0.0.0.0", "127.0.0.1")
        assert get(endpoint)[0] == 401
        status, headers, _ = get(endpoint, f"/?token={TOKEN}")
        cookie = headers["Set-Cookie"].partition(";")[0]
        assert (status, headers["Location"]) == (303, "/")
        assert get(endpoint, Cookie=cookie)[0] == 200
        from websockets.exceptions import InvalidStatus

        with pytest.raises(InvalidStatus), browser(endpoint):
            pass
        with browser(endpoint, additional_headers={"Cookie": cookie}) as connection:
            show_agent(room)
            assert seen(connection, "/points/0/0")


@needs_viser
@pytest.mark.long
def test_a_port_in_use_is_reported_before_a_process_starts(room: LiveRoom) -> None:
    with pytest.raises(TransportError, match="the port is in use"):
        LiveRoom(room.endpoint, None, "test")


def soon(is_true: Callable[[], bool], within_s: float = 20.0) -> bool:
    deadline = time.monotonic() + within_s
    while not (found := is_true()) and time.monotonic() < deadline:
        time.sleep(0.02)
    return found


def show_and_look(room: LiveRoom) -> int:
    """Show an agent, wait until a browser has it, and return the process id of the viewer."""
    show_agent(room)
    with browser(room.endpoint) as connection:
        assert seen(connection, "/points/0/0")
    assert room.pid is not None
    return room.pid


@needs_viser
@pytest.mark.long
def test_a_killed_viewer_is_reaped_told_and_started_again() -> None:
    told: list[str] = []
    with closing(LiveRoom("0", None, "test", told.append)) as room:
        pid = show_and_look(room)
        os.kill(pid, signal.SIGKILL)
        assert soon(lambda: not room.is_alive)
        assert soon(lambda: not Path(f"/proc/{pid}").exists())  # no zombie
        assert soon(lambda: room.is_alive)
        assert told == ["the live room has ended (exit code -9) and starts again in 1 s"]
        with browser(room.endpoint) as connection:  # what was told before is there again
            assert seen(connection, "/points/0/0")


@needs_viser
@pytest.mark.long
def test_a_viewer_that_grows_too_large_is_started_again(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    with closing(LiveRoom("0", None, "test", told.append)):
        monkeypatch.setattr(page_process, "MAX_BYTES", 2**20)
        assert soon(lambda: bool(told))
        assert told[0] == "the live room has ended (it took more than 1 MB of memory) and starts again in 1 s"


@pytest.mark.slow
@needs_viser
@pytest.mark.long
def test_a_viewer_that_hangs_is_killed_told_and_started_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever feeds it never waits, though the pipe is full."""
    told: list[str] = []
    with closing(LiveRoom("0", None, "test", told.append)) as room:
        pid = show_and_look(room)
        os.kill(pid, signal.SIGSTOP)
        for stamp_ns in range(20_000):
            room.feed.add_event(ev.PoseArrived("ann-1", TrackState.OK, 0, np.eye(4), float(stamp_ns)))
        assert room.pid == pid and not told  # all that, before anybody has noticed
        monkeypatch.setattr(page_process, "MAX_SILENT_LOOKS", 3)
        os.kill(pid, signal.SIGCONT)
        assert not soon(lambda: bool(told), within_s=5.0)  # a heartbeat comes
        os.kill(pid, signal.SIGSTOP)
        assert soon(lambda: not room.is_alive)
        assert soon(lambda: room.is_alive) and room.pid != pid
        assert told == ["the live room has ended (it did not answer for 3 s) and starts again in 1 s"]
        with browser(room.endpoint) as connection:
            assert seen(connection, "/points/0/0")


@needs_viser
@pytest.mark.long
def test_a_thread_that_serves_no_browser_stops_the_heartbeat() -> None:
    from share.net.http_guard import HttpGuard, listen
    from share.net.transport import Address
    from share.view.window import Window

    listener, bound = listen(Address("127.0.0.1", 0))
    with closing(listener):
        window = Window(listener, HttpGuard(bound), "test")
        try:
            loop = window._server._event_loop
            assert soon(window.has_served)
            began, hangs = threading.Event(), threading.Event()
            loop.call_soon_threadsafe(lambda: (began.set(), hangs.wait()))
            assert began.wait(20.0)  # what was asked before has been answered
            window.has_served()
            assert not soon(window.has_served, within_s=0.5)
            hangs.set()
            assert soon(window.has_served)
        finally:
            window.stop()


def camera(**changed: Any) -> bytes:
    message = {"type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [1.0, 2.0, 3.0], "fov": 1.0}
    message |= {"near": 0.01, "far": 1e3, "image_height": 500, "image_width": 800}
    message |= {"look_at": [0.0, 0.0, 0.0], "up_direction": [0.0, 0.0, 1.0]}
    return msgspec.msgpack.encode(message | changed)


def dropdown(connection: Any) -> str:
    """The identity of the choice of cameras, as soon as it is offered."""
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        for one in messages(connection.recv(timeout=20)):
            if one["type"] == "GuiDropdownMessage":
                return str(one["uuid"])
    raise AssertionError("no dropdown")


@needs_viser
@pytest.mark.long
def test_what_one_browser_sends_ends_the_room_for_nobody(room: LiveRoom) -> None:
    """A camera of two numbers while it follows an agent; an upload of nothing; one without an end."""
    show_agent(room)
    room.feed.add_report({"agents": {"ann": {"run": "ann-1", "kind": "robot", "state": "OK", "gone": False}}})
    pid = room.pid
    with browser(room.endpoint) as bad:
        bad.send(camera())
        uuid = dropdown(bad)
        choice = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": "follow ann"}}
        bad.send(msgspec.msgpack.encode(choice))
        bad.send(camera(position=[1.0, 2.0]))
        upload = {"source_component_uuid": uuid, "transfer_uuid": "y", "filename": "f", "mime_type": "t"}
        start = {"type": "FileTransferStartUpload", **upload, "part_count": 0, "size_bytes": 0}
        bad.send(msgspec.msgpack.encode(start))
        for k in range(30):
            pose = np.eye(4)
            pose[0, 3] = 0.1 * k
            room.feed.add_event(ev.PoseArrived("ann-1", TrackState.OK, 0, pose, 5.0))
            time.sleep(0.02)
        with browser(room.endpoint) as good:
            assert seen(good, "/points/0/0")
        from websockets.exceptions import ConnectionClosed

        with suppress(ConnectionClosed, OSError):
            for _ in range(100):
                bad.send(b"x" * 10**6)
        with pytest.raises((ConnectionClosed, OSError)):
            bad.send(b"x")
    with browser(room.endpoint) as good:
        assert seen(good, "/points/0/0")
    assert room.pid == pid


@needs_viser
@pytest.mark.long
def test_browsers_count_from_the_handshake_on(room: LiveRoom) -> None:
    from websockets.exceptions import InvalidStatus

    with ExitStack() as stack:
        for _ in range(MAX_BROWSERS):
            stack.enter_context(browser(room.endpoint))  # says nothing
        with pytest.raises(InvalidStatus) as refused, browser(room.endpoint):
            pass
        assert refused.value.response.status_code == 503
        assert get(room.endpoint)[0] == 200


@needs_viser
def test_what_browsers_are_sent_is_queued_in_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """viser wakes who waits for it by an event of asyncio: another thread would meet its list of waiters
    while it changes, and end the room for everybody."""
    from viser.infra._async_message_buffer import AsyncMessageBuffer

    from share.net.http_guard import HttpGuard, listen
    from share.net.transport import Address
    from share.view import drawing as dr
    from share.view.loop_views import LoopViews
    from share.view.window import Window

    listener, bound = listen(Address("127.0.0.1", 0))
    window, threads, push = Window(listener, HttpGuard(bound), "test"), set[str](), AsyncMessageBuffer.push

    def note(buffer: Any, message: Any) -> None:
        threads.add(threading.current_thread().name)
        push(buffer, message)

    try:
        asked = list[str]()
        window._server.get_event_loop().call_soon_threadsafe(
            lambda: asked.append(threading.current_thread().name)
        )
        assert soon(lambda: bool(asked))
        monkeypatch.setattr(AsyncMessageBuffer, "push", note)
        with browser(str(bound).removeprefix("tcp://")) as one:
            one.send(camera())
            uuid, box = dropdown(one), np.eye(4)
            window.draw(
                [
                    dr.FloorGrid(0.0, (0.0, 0.0), (1.0, 1.0)),
                    dr.Marks("/marks", np.zeros((2, 3)), (1, 2, 3)),
                    dr.AgentBody("/agents/0", "ann", AgentKind.AR, box, box, (0.8, 0.6), (1, 2, 3), True),
                    dr.Announcement("maps merged", "x"),
                ]
            )
            window.show_panel("<b>ann</b>", ["ann"])
            for value in ("from above", "follow ann"):
                choice = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}
                one.send(msgspec.msgpack.encode(choice))
                (looking,) = window._cameras.values()
                assert soon(lambda value=value, looking=looking: looking._choice.value == value)  # type: ignore[misc]
            window.follow(lambda name: np.eye(4))
            window.show_views(next(iter(window._cameras)), LoopViews(("a", "b"), (b"", b"")))
        assert soon(lambda: not window._cameras)
    finally:
        window.stop()
    assert threads == set(asked)


@needs_viser
@pytest.mark.parametrize("failing", ["offer", "follow"])
def test_a_failing_browser_is_disconnected_alone(failing: str) -> None:
    from share.net.http_guard import HttpGuard, listen
    from share.net.transport import Address
    from share.view.window import Window

    def fail(*given: Any) -> None:
        raise ValueError("operands could not be broadcast together")

    class Camera:
        def __init__(self) -> None:
            self.calls = 0

        def note(self, *given: Any) -> None:
            self.calls += 1

        offer = follow = note

    listener, bound = listen(Address("127.0.0.1", 0))
    window, bad, good = Window(listener, HttpGuard(bound), "test"), Camera(), Camera()
    setattr(bad, failing, fail)
    window._cameras = {1: bad, 2: good}  # type: ignore[dict-item]
    try:
        window.show_panel("", ["ann"])
        window.follow(lambda name: None)
        assert list(window._cameras) == [2] and good.calls == 2
    finally:
        window.stop()


@needs_viser
def test_a_viser_that_the_guard_does_not_reach_serves_nothing() -> None:
    from share.net.http_guard import HttpGuard, listen
    from share.net.transport import Address
    from share.view.guarded_server import guarded_serving

    listener, bound = listen(Address("127.0.0.1", 0))
    with (
        closing(listener),
        pytest.raises(ShareError, match="version of viser"),
        guarded_serving(listener, HttpGuard(bound)),
    ):
        pass  # another version that serves in another way


@needs_viser
@pytest.mark.long
def test_a_browser_cannot_have_a_tunnel_to_the_internet_opened() -> None:
    """viser's page has a button for that, which is hidden; a program could press it all the same."""
    from viser import ViserServer, _messages

    from share.net.http_guard import HttpGuard, listen
    from share.net.transport import Address
    from share.view.window import Window

    asked_for = {_messages.ShareUrlRequest, _messages.ShareUrlDisconnect}
    listener, bound = listen(Address("127.0.0.1", 0))
    plain, guarded = ViserServer("127.0.0.1", 0, verbose=False), Window(listener, HttpGuard(bound), "test")
    try:
        assert plain._websock_server._incoming_handlers.keys() >= asked_for
        assert not guarded._server._websock_server._incoming_handlers.keys() & asked_for
    finally:
        plain.stop()
        guarded.stop()


@needs_viser
@pytest.mark.long
def test_a_browser_that_stops_reading_holds_up_neither_room_nor_others(room: LiveRoom) -> None:
    import socket

    import viser

    host, _, port = room.endpoint.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=30) as stuck:
        stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stuck.sendall(
            f"GET / HTTP/1.1\r\nHost: {room.endpoint}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
            f"Sec-WebSocket-Protocol: viser-v{viser.__version__}\r\n\r\n".encode()
        )
        show_agent(room)
        points = np.random.default_rng(2).uniform(1, 3, (4000, 3)).astype(np.float32)
        for k in range(1, 200):
            key = KeyframeKey("ann-1", k)
            room.feed.add_event(ev.KeyframeArrived(key, False, np.eye(4), points))
            time.sleep(0.01)
        with browser(room.endpoint) as connection:
            assert seen(connection, "/points/0/6")
        assert room.feed.left_out == 0


def test_events_are_plain_values_of_our_own() -> None:
    """They go through a pipe between our own processes."""
    event = ev.DecisionMade(1.0, "maps merged", None, "x")
    assert pickle.loads(pickle.dumps(event)) == event
