"""UDP sockets that stamp datagrams on arrival."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest

from share.errors import TransportError, UsageError
from share.net import udp
from share.net.udp import HostPort, StampedSocket, clock_precision, parse_host


@contextmanager
def pair() -> Iterator[tuple[StampedSocket, StampedSocket]]:
    with (
        closing(StampedSocket.bind(HostPort("127.0.0.1", 0))) as server,
        closing(StampedSocket.connect(HostPort("127.0.0.1", server.port))) as client,
    ):
        yield server, client


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux is asked for stamps")
def test_kernel_stamps_are_arrival_times() -> None:
    with pair() as (server, client):
        client.send(
            b"first"
        )  # the kernel begins to stamp a moment after it was asked to (net_enable_timestamp)
        assert server.receive(1.0) is not None
        time.sleep(0.05)
        before = time.time_ns()
        client.send(b"hello")
        after = time.time_ns()
        time.sleep(0.05)
        datagram = server.receive(1.0)
        assert server.has_kernel_stamps
        assert datagram is not None
        assert datagram.data == b"hello"
        assert before <= datagram.stamp_ns <= after + 10_000_000 < time.time_ns()


def test_without_kernel_stamps_the_process_stamps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(udp, "_TIMESTAMPNS", 9999)  # an option that no kernel has
    with pair() as (server, client):
        client.send(b"hello")
        time.sleep(0.02)
        before = time.time_ns()
        datagram = server.receive(1.0)
        assert not server.has_kernel_stamps
        assert datagram is not None
        assert before <= datagram.stamp_ns <= time.time_ns()


def test_a_reply_goes_to_the_sender() -> None:
    with pair() as (server, client):
        client.send(b"hello")
        datagram = server.receive(1.0)
        assert datagram is not None
        server.send(b"hello yourself", datagram.source)
        answer = client.receive(1.0)
        assert answer is not None
        assert answer.data == b"hello yourself"
        assert client.receive(0.01) is None


def test_a_refused_datagram_raises_at_receive() -> None:
    with pair() as (server, client):
        server.close()
        client.send(b"hello")
        with pytest.raises(ConnectionRefusedError):
            client.receive(1.0)


def test_a_port_in_use_is_reported() -> None:
    with pair() as (server, _):
        at = HostPort("127.0.0.1", server.port)
        with pytest.raises(TransportError, match=f"^{at}: the port is in use; stop the other server"):
            StampedSocket.bind(at)


def test_an_address_of_another_machine_is_reported() -> None:
    with pytest.raises(TransportError, match="this machine has no such address"):
        StampedSocket.bind(HostPort("192.0.2.1", 0))


@pytest.mark.parametrize(
    ("text", "host"),
    [
        ("192.168.1.10", HostPort("192.168.1.10", 11123)),
        ("edge.local:123", HostPort("edge.local", 123)),
        ("localhost", HostPort("127.0.0.1", 11123)),
        ("[::1]", HostPort("::1", 11123)),
        ("[fe80::1%eth0]:9", HostPort("fe80::1%eth0", 9)),
    ],
)
def test_hosts_may_have_a_port_or_not(text: str, host: HostPort) -> None:
    assert parse_host(text, 11123) == host
    assert parse_host(str(host), 1) == host


@pytest.mark.parametrize(
    "text", ["", "11123", ":123", "a b", "udp://a:1", "a:99999", "a:0", "::1", "a:b", "ä"]
)
def test_malformed_hosts_are_refused(text: str) -> None:
    with pytest.raises(
        UsageError, match=r"is not an address; give HOST or HOST:PORT, such as 192.168.1.10:11123"
    ):
        parse_host(text, 11123)


def test_a_clock_is_read_in_less_than_a_millisecond() -> None:
    assert -30 <= clock_precision() <= -10
