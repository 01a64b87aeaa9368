"""Links over ZeroMQ, with keys and without."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from mmap import mmap
from pathlib import Path
from typing import Any

import pytest
import zmq

from share.errors import TransportError, UsageError
from share.net import tcp
from share.net.keys import AgentKeys, EdgeKeys, allow_list, authorize, generate_pair
from share.net.transport import (
    LINGER_MS,
    QUEUE_MESSAGES,
    AgentLink,
    EdgeLink,
    IncomingMessage,
    bind,
    connect,
    parse_address,
)
from share.wire.codec import encode
from share.wire.layouts import MAX_FRAME_BYTES
from share.wire.messages import Bye, Ping, peer_id


class Net:
    """Opens links of one kind and closes them all at the end."""

    def __init__(self, kind: str, stack: ExitStack, folder: Path) -> None:
        self._stack = stack
        self._edge_keys, self._agent_keys = keys_in(folder) if kind == "curve" else (None, None)
        self.agent_key = self._agent_keys.own.public if self._agent_keys else ""

    def edge(self, at: str | None = None) -> EdgeLink:
        return self._stack.enter_context(closing(bind(at or "tcp://127.0.0.1:0", self._edge_keys)))

    def agent(self, at: str, run_id: int = 1) -> AgentLink:
        return self._stack.enter_context(closing(connect(at, run_id, self._agent_keys)))


def keys_in(folder: Path) -> tuple[EdgeKeys, AgentKeys]:
    """Return the keys of an edge and of an agent that it accepts."""
    edge, ann = generate_pair(folder / "edge", "edge"), generate_pair(folder / "ann", "ann")
    authorize(folder / "edge", "ann", ann.public)
    return EdgeKeys(edge, allow_list(folder / "edge")), AgentKeys(ann, edge.public)


@pytest.fixture(params=["zmq", "curve"])
def net(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Net]:
    with ExitStack() as stack:
        yield Net(request.param, stack, tmp_path)


def eventually(what: Callable[[], Any], within_s: float = 5.0) -> Any:
    """The first true value of `what()`."""
    end = time.monotonic() + within_s
    while not (value := what()):
        assert time.monotonic() < end, "did not happen in time"
        time.sleep(0.005)
    return value


def heard(edge: EdgeLink) -> tuple[bytes, list[bytes]] | None:
    """Who sent what, if anybody did within 0.1 s."""
    arrival = edge.receive(100)
    return None if arrival is None else (arrival.peer, arrival.frames)


def joined(net: Net, edge: EdgeLink, run_id: int = 1) -> AgentLink:
    """An agent that the edge has heard once."""
    agent = net.agent(edge.endpoint, run_id)
    eventually(lambda: agent.send([b"hello"]))
    assert eventually(lambda: heard(edge)) == (peer_id(run_id), [b"hello"])
    return agent


def test_a_message_goes_there_and_back_in_its_frames(net: Net) -> None:
    edge = net.edge()
    agent = joined(net, edge)
    assert agent.send([*encode(Ping(1, 2)), memoryview(bytes(range(256)) * 250), b""])
    peer, frames = eventually(lambda: heard(edge))
    assert (peer, len(frames), len(frames[1])) == (peer_id(1), 3, 64_000)
    assert edge.send(peer, frames)
    assert eventually(lambda: agent.receive(100)) == frames


def test_a_message_carries_the_key_of_its_sender(net: Net) -> None:
    edge = net.edge()
    agent = net.agent(edge.endpoint)
    eventually(lambda: agent.send([b"hello"]))
    arrival = eventually(lambda: edge.receive(100))
    assert arrival == IncomingMessage(peer_id(1), [b"hello"], net.agent_key)


def test_a_failed_check_costs_neither_the_edge_nor_its_guard(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> int:
        raise ZeroDivisionError

    with ExitStack() as stack:
        net = Net("zmq", stack, tmp_path)
        edge = net.edge()
        with monkeypatch.context() as patch:
            patch.setattr(tcp, "resident_bytes", fail)
            agent = joined(net, edge)
            assert eventually(lambda: "guard of connections failed" in " ".join(edge.refusals()))
        assert agent.send([b"again"])
        assert eventually(lambda: heard(edge)) == (peer_id(1), [b"again"])
        eventually(lambda: not edge.refusals())
        time.sleep(0.05)  # two checks
        assert not edge.refusals()


def test_without_an_edge_nothing_is_sent_and_nothing_blocks(net: Net) -> None:
    edge = net.edge()
    address = edge.endpoint
    edge.close()
    agent = net.agent(address)
    start = time.monotonic()
    assert [agent.send([b"x"]) for _ in range(1000)] == [False] * 1000
    assert agent.receive(0) is None
    assert time.monotonic() - start < 0.5


def test_messages_to_an_absent_edge_are_dropped(net: Net) -> None:
    first = net.edge()
    agent = joined(net, first)
    first.close()
    eventually(lambda: not agent.send([b"gap"]))
    assert not any(agent.send([b"gap"]) for _ in range(10))
    second = net.edge(first.endpoint)
    eventually(lambda: agent.send([b"new"]))
    assert eventually(lambda: heard(second)) == (peer_id(1), [b"new"])


def test_a_restarted_edge_is_found_again_and_can_send(net: Net) -> None:
    edge = net.edge()
    agent = joined(net, edge)
    for life in range(3):
        edge.close()
        edge = net.edge(edge.endpoint)
        eventually(lambda: edge.send(peer_id(1), [b"%d" % life]))  # noqa: B023
        assert eventually(lambda: agent.receive(100)) == [b"%d" % life]


def test_sending_to_an_absent_peer_returns_false(net: Net) -> None:
    edge = net.edge()
    assert not edge.send(peer_id(77), [b"x"])
    agent = joined(net, edge, 77)
    assert edge.send(peer_id(77), [b"x"])
    agent.close()
    eventually(lambda: not edge.send(peer_id(77), [b"x"]))


def test_a_slow_reader_costs_bounded_memory(net: Net) -> None:
    edge = net.edge()
    agent = joined(net, edge)
    payload = [bytes(26_000)]
    start = time.monotonic()
    taken = sum(edge.send(peer_id(1), payload) for _ in range(5000))
    assert QUEUE_MESSAGES <= taken <= 5000
    taken = sum(agent.send(payload) for _ in range(5000))
    assert QUEUE_MESSAGES - 1 <= taken < 1500  # the hello may count yet
    assert time.monotonic() - start < 3
    while edge.receive(50):
        pass
    assert eventually(lambda: (edge.receive(5), agent.send([b"again"]))[1])  # it may have been cut off


def test_many_agents_are_distinguished(net: Net) -> None:
    edge = net.edge()
    agents = {peer_id(k): net.agent(edge.endpoint, k) for k in (-5, 0, 1, 255, 2**62, *range(10, 25))}
    for peer, agent in agents.items():
        eventually(lambda agent=agent, peer=peer: agent.send([peer]))
    got = [eventually(lambda: heard(edge)) for _ in agents]
    assert {peer: [peer] for peer in agents} == dict(got)
    for peer in agents:
        assert edge.send(peer, [b"to " + peer])
    for peer, agent in agents.items():
        assert eventually(lambda agent=agent: agent.receive(100)) == [b"to " + peer]


def test_a_reconnected_agent_takes_over_its_id(net: Net) -> None:
    edge = net.edge()
    stale = joined(net, edge)
    fresh = net.agent(edge.endpoint, 1)  # the same run over another path: the old one is half open
    eventually(lambda: fresh.send([b"back"]))
    assert eventually(lambda: heard(edge)) == (peer_id(1), [b"back"])
    assert edge.send(peer_id(1), [b"welcome"])
    assert eventually(lambda: fresh.receive(100)) == [b"welcome"]
    assert stale.receive(20) is None


@pytest.mark.parametrize("side", ["edge", "agent"])
def test_wake_from_another_thread(net: Net, side: str) -> None:
    edge = net.edge()
    agent = joined(net, edge)
    link: Any = edge if side == "edge" else agent
    timer = threading.Timer(0.1, link.wake)
    timer.start()
    start = time.monotonic()
    assert link.receive(5000) is None
    assert 0.05 < time.monotonic() - start < 2
    timer.join()
    link.wake()
    link.wake()
    start = time.monotonic()
    assert link.receive(5000) is None  # a wake before the call is not lost
    assert time.monotonic() - start < 1
    start = time.monotonic()
    assert link.receive(100) is None  # … and spent once
    assert time.monotonic() - start > 0.08
    link.close()
    link.wake()


def test_the_last_message_leaves_before_close(net: Net) -> None:
    edge = net.edge()
    agent = joined(net, edge)
    assert agent.send(encode(Bye()))
    start = time.monotonic()
    agent.close()
    agent.close()
    assert time.monotonic() - start < LINGER_MS / 1000 + 0.5
    assert eventually(lambda: heard(edge)) == (peer_id(1), encode(Bye()))


def test_an_address_in_use_is_reported(net: Net) -> None:
    edge = net.edge()
    with pytest.raises(TransportError, match="in use; stop the other edge or choose another") as caught:
        net.edge(edge.endpoint)
    assert edge.endpoint in str(caught.value)
    edge.close()
    net.edge(edge.endpoint)


# ---------------------------------------------------------------- ZeroMQ alone


@pytest.mark.parametrize(
    "text",
    ["", "127.0.0.1", "tcp://:5", "tcp://h", "tcp://h:x", "tcp://h:70000", "udp://h:5", "tcp://h:0"],
)
def test_malformed_addresses(text: str) -> None:
    with pytest.raises(UsageError, match="is not an address; expected tcp://HOST:PORT"):
        connect(text, 1)


def test_addresses() -> None:
    assert str(parse_address("tcp://[::1]:5")) == "tcp://[::1]:5"
    assert parse_address("tcp://localhost:0", bind=True).local
    assert parse_address("tcp://127.8.9.1:7").local
    assert not parse_address("tcp://0.0.0.0:7").local
    assert not parse_address("tcp://example.org:7").local


def test_only_loopback_without_keys() -> None:
    with pytest.raises(UsageError, match=r"0\.0\.0\.0.*need keys.*`share keys generate`"):
        bind("tcp://0.0.0.0:0")
    with pytest.raises(UsageError, match=r"192\.0\.2\.1.*need keys"):
        connect("tcp://192.0.2.1:5555", 1)


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1"])
def test_loopback_names(host: str) -> None:
    with closing(bind(f"tcp://{host}:0")) as edge:
        assert parse_address(edge.endpoint).port > 0


def test_an_oversized_frame_is_refused() -> None:
    with closing(bind("tcp://127.0.0.1:0")) as edge, closing(connect(edge.endpoint, 2)) as good:
        context = zmq.Context()
        rogue = context.socket(zmq.DEALER)
        rogue.setsockopt(zmq.LINGER, 0)
        rogue.connect(edge.endpoint)
        rogue.send(bytes(MAX_FRAME_BYTES + 1))
        rogue.send_multipart([b"part"] * 5000)
        eventually(lambda: good.send([b"fine"]))
        got = [message for message in (edge.receive(200) for _ in range(4)) if message]
        assert (peer_id(2), [b"fine"]) in [(arrival.peer, arrival.frames) for arrival in got]
        assert max(len(arrival.frames) for arrival in got) < 12
        rogue.close()
        context.term()


@pytest.mark.parametrize("with_keys", [False, True], ids=["zmq", "curve"])
def test_images_are_accepted_up_to_the_limit(with_keys: bool, tmp_path: Path) -> None:
    edge_keys, agent_keys = keys_in(tmp_path) if with_keys else (None, None)
    most = 1_000_000
    with (
        closing(bind("tcp://127.0.0.1:0", edge_keys, most)) as edge,
        closing(connect(edge.endpoint, 1, agent_keys)) as agent,
    ):
        eventually(lambda: agent.send([b"hello"]))  # of a stranger the first message has to be small
        assert eventually(lambda: heard(edge))[1] == [b"hello"]
        assert agent.send([b"images", bytes(most)])
        _, frames = eventually(lambda: heard(edge))
        assert [len(frame) for frame in frames] == [6, most]
        assert agent.send([bytes(most + 1)])
        assert edge.receive(500) is None  # its sender was cut off
        eventually(lambda: agent.send([b"back"]) and edge.receive(100))


def test_bytes_that_are_not_zeromq_do_no_harm() -> None:
    with closing(bind("tcp://127.0.0.1:0")) as edge, closing(connect(edge.endpoint, 2)) as agent:
        raw = socket.create_connection(("127.0.0.1", parse_address(edge.endpoint).port))
        raw.sendall(b"GET / HTTP/1.1\r\n\r\n" + bytes(range(256)) * 40)
        eventually(lambda: agent.send([b"fine"]))
        assert eventually(lambda: heard(edge)) == (peer_id(2), [b"fine"])
        raw.close()


def test_an_address_needs_no_scheme():
    assert parse_address("192.168.1.10:5555") == parse_address("tcp://192.168.1.10:5555")
    assert str(parse_address("[::1]:5555")) == "tcp://[::1]:5555"
    assert parse_address("localhost:0", bind=True).local


@pytest.mark.parametrize("loads", [True, False])
def test_no_agent_is_blamed_for_the_growth_of_an_edge_that_loads_a_map(loads: bool) -> None:
    """Its keyframes wait meanwhile. A peer with small parts would make it grow, too."""
    with ExitStack() as stack:
        edge = stack.enter_context(closing(bind("tcp://127.0.0.1:0")))
        agent = stack.enter_context(closing(connect(edge.endpoint, 7)))
        _until(lambda: agent.send([b"hello"]) and edge.receive(20) is not None)
        edge.expect_growth(loads)
        at = parse_address(edge.endpoint)
        stack.enter_context(socket.create_connection((at.host, at.port)))  # wakes the guard's thread
        time.sleep(0.1)
        for _ in range(8):  # more than the largest message
            assert agent.send([bytes(MAX_FRAME_BYTES), bytes(MAX_FRAME_BYTES)])
        time.sleep(0.3)
        loaded = stack.enter_context(closing(mmap(-1, 60_000_000)))
        loaded.write(bytes([1]) * 60_000_000)
        time.sleep(0.3)
        edge.expect_growth(False)
        time.sleep(0.1)
        said = edge.refusals()
        assert bool(said) is not loads


def _until(is_done: Callable[[], bool]) -> None:
    end = time.monotonic() + 10
    while not is_done():
        assert time.monotonic() < end
