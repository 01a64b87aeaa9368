"""Poses by WebSocket: everyone gets the newest, nobody holds the agent up."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import select
import socket
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from share.errors import ShareError
from share.runtime.pose import Pose
from share.runtime.pose_feed import MAX_READERS, OWN_READERS, PoseWebSocket, open_pose_sinks
from share.types import TrackState

client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")
exceptions = pytest.importorskip("websockets.exceptions")
bounded_websocket = pytest.importorskip("share.net.bounded_websocket")
ORIGIN = "https://app.example"


@pytest.fixture
def served() -> Iterator[object]:
    (sink,) = open_pose_sinks(["ws://127.0.0.1:0"], "ann", [ORIGIN])
    yield sink
    sink.close()


def pose(stamp_ns: int) -> Pose:
    return Pose(stamp_ns, TrackState.OK, np.eye(4), age_ms=1.0)


def connected(sink, **options):
    before = len(sink._readers)
    connection = client.connect(f"ws://{sink.host}", proxy=None, **options)
    end = time.monotonic() + 5
    while len(sink._readers) == before and time.monotonic() < end:  # its thread has begun
        time.sleep(0.005)
    return connection


def test_each_reader_gets_each_pose(served):
    with connected(served) as one, connected(served) as two:
        for stamp_ns in (100, 200):
            served.publish(pose(stamp_ns))
            got = [json.loads(reader.recv(timeout=5)) for reader in (one, two)]
            assert [message["stamp_ns"] for message in got] == [stamp_ns] * 2
            assert got[0]["schema"] == 3 and got[0]["odom"]["position"] == [0.0, 0.0, 0.0]
        served.publish_state(300, TrackState.LOST)
        assert json.loads(one.recv(timeout=5))["state"] == "LOST"


def small_socket(sink) -> socket.socket:
    """A connected socket that holds 4 kB, and so does the server's end of it."""
    sink._listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    made = socket.socket()
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    made.connect((sink.host.name, sink.host.port))
    return made


def test_a_reader_that_does_not_read_costs_nothing(served):
    """Its socket is full after some messages; publishing goes on, and the newest comes last."""
    with connected(served, sock=small_socket(served), max_queue=1, close_timeout=0.1):
        (silent,) = (one.transport.get_extra_info("socket") for one in served._readers)
        end, stamp_ns = time.monotonic() + 20, 0
        while select.select([], [silent], [], 0.1)[1]:  # until there is no room in it any more
            assert time.monotonic() < end
            served.publish(pose(stamp_ns := stamp_ns + 1))
        longest_s = 0.0
        for _ in range(500):
            start_s = time.perf_counter()
            served.publish(pose(stamp_ns := stamp_ns + 1))
            longest_s = max(longest_s, time.perf_counter() - start_s)
        assert longest_s < 0.5
        with connected(served) as other:
            served.publish(pose(10**6))
            assert json.loads(other.recv(timeout=5))["stamp_ns"] == 10**6
        start_s = time.perf_counter()
        served.close()
        assert time.perf_counter() - start_s < 3.0
    assert [one.name for one in threading.enumerate() if one.name == "poses"] == []


@pytest.mark.parametrize("origin", [None, ORIGIN, "http://localhost:8080", "http://127.0.0.1"])
def test_pages_that_may_read(served, origin):
    with connected(served, origin=origin) as reader:
        served.publish(pose(7))
        assert json.loads(reader.recv(timeout=5))["stamp_ns"] == 7


@pytest.mark.parametrize("origin", ["https://evil.example", "http://localhost.evil.example", "null"])
def test_other_pages_are_refused(served, origin, capfd):
    with pytest.raises(exceptions.InvalidStatus, match="403"):
        client.connect(f"ws://{served.host}", proxy=None, origin=origin)
    assert capfd.readouterr() == ("", "")


def test_what_is_no_websocket_is_no_trouble(served, capfd):
    with socket.create_connection((served.host.name, served.host.port)) as raw:
        raw.sendall(b"\x00" * 100_000)
        with contextlib.suppress(ConnectionError):
            raw.recv(10)
    with connected(served) as reader:
        served.publish(pose(7))
        assert json.loads(reader.recv(timeout=5))["stamp_ns"] == 7
    assert capfd.readouterr() == ("", "")


def gets_poses(served, connection) -> bool:
    served.publish(pose(7))
    return json.loads(connection.recv(timeout=5))["stamp_ns"] == 7


def test_idle_connections_make_no_thread_and_keep_nobody_out(served):
    threads = threading.active_count()
    with contextlib.ExitStack() as stack:
        for _ in range(300):
            stack.enter_context(socket.create_connection((served.host.name, served.host.port)))
        assert threading.active_count() == threads
        with connected(served) as reader:
            assert gets_poses(served, reader)
        assert len(served.peer_connections._waiting) <= 32


def test_one_that_waits_ends_for_another_of_the_address_with_the_most(served):
    with contextlib.ExitStack() as stack:
        honest = stack.enter_context(from_address(served, "127.0.0.2"))
        for _ in range(100):
            stack.enter_context(from_address(served, "127.0.0.1"))
        time.sleep(0.2)
        honest.settimeout(0.2)
        with pytest.raises(TimeoutError):  # it is open
            honest.recv(1)


def test_too_many_readers_are_refused_before_they_are_served(served):
    with contextlib.ExitStack() as stack:
        for _ in range(MAX_READERS):
            stack.enter_context(connected(served))
        with pytest.raises(exceptions.InvalidStatus, match="503"):
            client.connect(f"ws://{served.host}", proxy=None)
        assert served.peer_connections.open_count == MAX_READERS
    with connected(served) as reader:  # the places are free again
        assert gets_poses(served, reader)


def from_address(sink, address: str) -> socket.socket:
    made = socket.socket()
    made.bind((address, 0))
    made.connect((sink.host.name, sink.host.port))
    return made


def is_disconnected(reader) -> bool:
    """Whether a reader that is sent no more than a few messages is disconnected."""
    with contextlib.suppress(TimeoutError):
        for _ in range(5):
            try:
                reader.recv(timeout=5)
            except exceptions.ConnectionClosed:
                return True
    return False


def test_readers_of_one_machine_do_not_keep_out_those_of_another(served):
    with contextlib.ExitStack() as stack:
        first, *_ = [stack.enter_context(connected(served)) for _ in range(MAX_READERS)]
        with client.connect(f"ws://{served.host}", sock=from_address(served, "127.0.0.2")) as other:
            assert is_disconnected(first)
            assert gets_poses(served, other)
            assert served.peer_connections.open_count == MAX_READERS
        with connected(served), pytest.raises(exceptions.InvalidStatus, match="503"):
            client.connect(f"ws://{served.host}", proxy=None)  # nobody else of its own address goes


def test_a_reader_that_has_long_read_gives_its_place_to_a_newcomer(served, monkeypatch):
    """Sixteen that read and answer and never leave held all places for ever."""
    with contextlib.ExitStack() as stack:
        first, second, *_ = [stack.enter_context(connected(served)) for _ in range(MAX_READERS)]
        monkeypatch.setattr(bounded_websocket, "SURE_S", 0.0)
        with client.connect(f"ws://{served.host}", proxy=None) as newcomer:
            assert is_disconnected(first)
            assert gets_poses(served, newcomer) and gets_poses(served, second)
            assert served.peer_connections.open_count == MAX_READERS


def test_readers_of_other_machines_leave_places_to_programs_of_this_one(served, monkeypatch):
    """Sixteen addresses with correct connections keep no engine beside the agent out, not for a moment."""
    monkeypatch.setattr(bounded_websocket, "_is_own_machine", lambda peer, own: peer[0] == "127.0.0.1")
    places = MAX_READERS - OWN_READERS
    with contextlib.ExitStack() as stack:
        for k in range(places):
            other = from_address(served, f"127.0.1.{k + 1}")
            stack.enter_context(client.connect(f"ws://{served.host}", sock=other))
        with pytest.raises(exceptions.InvalidStatus, match="503"):
            client.connect(f"ws://{served.host}", sock=from_address(served, "127.0.1.99"))
        own = [stack.enter_context(connected(served)) for _ in range(OWN_READERS)]
        assert served.peer_connections.open_count == MAX_READERS
        monkeypatch.setattr(bounded_websocket, "SURE_S", 0.0)
        with client.connect(f"ws://{served.host}", sock=from_address(served, "127.0.1.99")):
            assert served.peer_connections.open_count == MAX_READERS
            assert all(gets_poses(served, reader) for reader in own)


def test_a_program_of_this_machine_is_known_by_its_address():
    is_own = bounded_websocket._is_own_machine
    assert is_own(("127.0.0.2", 1), ("127.0.0.1", 2)) and is_own(("10.0.0.7", 1), ("10.0.0.7", 2))
    assert is_own(("::1", 1, 0, 0), ("::1", 2, 0, 0)) and is_own(
        ("fe80::1%a", 1, 0, 2), ("fe80::1%a", 2, 0, 2)
    )
    assert not is_own(("10.0.0.8", 1), ("10.0.0.7", 2)) and not is_own(None, None)


def test_a_reader_that_answers_no_ping_is_disconnected(monkeypatch):
    monkeypatch.setattr(bounded_websocket, "PING_S", 0.3)
    request = "GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    request += "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    with contextlib.closing(PoseWebSocket("ws://127.0.0.1:0", "ann")) as server, connected(server) as polite:
        with socket.create_connection((server.host.name, server.host.port), timeout=10) as silent:
            silent.sendall(request.encode())
            received = b""
            with contextlib.suppress(ConnectionError):
                while data := silent.recv(1024):
                    received += data
            assert received.startswith(b"HTTP/1.1 101 ") and b"\x89\x04" in received  # a PING
        assert gets_poses(server, polite)


MINUTE = bounded_websocket.SURE_S


@pytest.mark.parametrize(
    ("places", "newcomer", "freed"),
    [
        ([("a", 0.0)] * 3, "b", 0),  # three to none
        ([("a", 2.0), ("a", 1.0), ("b", 0.0)], "b", None),  # two to one: no fairer the other way round
        ([("b", 0.0), ("a", 2.0), ("a", 1.0), ("a", 3.0)], "b", 2),  # the oldest of who has most
        ([("a", 1.0), ("a", 0.5)], "a", None),
        ([("a", 1.0), ("a", 9.0 - MINUTE)], "a", 1),
        ([("a", 9.0 - MINUTE), ("b", 8.0 - MINUTE)], "c", 1),
        ([], "a", None),
    ],
)
def test_whose_place_a_newcomer_takes(places, newcomer, freed):
    assert bounded_websocket.place_to_free(places, newcomer, now_s=9.0) == freed


def test_one_ipv6_peer_is_one_holder():
    holder = bounded_websocket._holder_of
    assert holder(("2001:db8::1", 1, 0, 0)) == holder(("2001:db8::ff:1", 2, 0, 0))
    assert holder(("2001:db8::1", 1, 0, 0)) != holder(("2001:db8:0:1::1", 1, 0, 0))
    assert holder(("fe80::1%eth0", 1, 0, 2)) and holder(("10.0.0.7", 1)) == "10.0.0.7" and holder(None) == ""


@pytest.mark.parametrize("frame", [b"\x89\x80\0\0\0\0", b"\x81\x80\0\0\0\0"], ids=["ping", "text"])
def test_a_reader_that_sends_a_lot_is_disconnected(served, frame):
    """PING frames took a third of the tracker's time each; the answers to them too."""
    with connected(served) as other, connected(served) as loud:
        loud.socket.sendall(frame * 200)
        served.publish(pose(7))
        with contextlib.suppress(exceptions.ConnectionClosed):
            loud.recv(timeout=5)  # what it was sent before
        with pytest.raises(exceptions.ConnectionClosed):
            loud.recv(timeout=5)
        assert json.loads(other.recv(timeout=5))["stamp_ns"] == 7


def test_a_reader_that_sends_now_and_then_stays(served):
    with connected(served) as reader:
        for _ in range(5):
            assert reader.ping().wait(5)
        assert gets_poses(served, reader)


def test_without_file_descriptors_it_says_so_once_and_goes_on():
    told: list[str] = []
    server = PoseWebSocket("ws://127.0.0.1:0", "ann", (), told.append)
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.closing(server), contextlib.ExitStack() as stack:
        probe = socket.socket()
        stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, before)
        resource.setrlimit(resource.RLIMIT_NOFILE, (probe.fileno() + 20, before[1]))
        filling = []
        with contextlib.suppress(OSError):
            while True:
                filling.append(os.dup(0))
        probe.connect((server.host.name, server.host.port))
        end = time.monotonic() + 10
        while not told and time.monotonic() < end:
            time.sleep(0.01)
        time.sleep(1.2)  # it tries again
        for fd in filling:
            os.close(fd)
        probe.close()
        with connected(server) as reader:
            assert gets_poses(server, reader)
    assert len(told) == 1 and "Too many open files; raise `ulimit -n`" in told[0]


@pytest.mark.long
def test_an_agent_serves_the_poses_that_it_sends(share, plain_session, tmp_path):
    """By WebSocket and by UDP at once, the same."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"ws://127.0.0.1:{free.getsockname()[1]}"
    got: list[dict[str, object]] = []

    def read() -> None:
        end = time.monotonic() + 30
        while not got and time.monotonic() < end:
            with contextlib.suppress(OSError, exceptions.WebSocketException):
                for text in client.connect(address, proxy=None):
                    got.append(json.loads(text))
            time.sleep(0.05)

    reader = threading.Thread(target=read)
    reader.start()
    config = tmp_path / "config.yaml"
    config.write_text("agent: {finish_s: 0.1}\n")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as app:
        app.bind(("127.0.0.1", 0))
        udp = f"udp://127.0.0.1:{app.getsockname()[1]}"
        options = (
            "--kind",
            "ar",
            "--edge",
            "127.0.0.1:1",
            "--config",
            config,
            "--poses",
            address,
            "--poses",
            udp,
        )
        share("agent", plain_session / "ar1", "--name", "ann", *options)
        reader.join(timeout=30)
        app.setblocking(False)
        sent = {}
        with contextlib.suppress(BlockingIOError):
            while True:
                message = json.loads(app.recv(2048))
                sent[message["sequence"]] = message
    assert len(sent) == 45 and len(got) >= 10
    assert all(message == sent[message["sequence"]] for message in got)


def test_a_port_in_use_and_a_wrong_origin_are_refused(served):
    with pytest.raises(ShareError, match="the port is in use; stop the other server"):
        open_pose_sinks([f"ws://{served.host}"], "bob")
    with pytest.raises(ShareError, match=r"--poses-origin app\.example: expected a page's origin"):
        open_pose_sinks(["ws://127.0.0.1:0"], "bob", ["app.example"])
