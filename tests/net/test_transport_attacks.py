"""Attacks by a raw peer on an edge's link in a process of its own: an honest agent goes on.

Beside each attack an honest agent exchanges messages with the front. Memory is the most that its process ever
had.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from helpers.raw_curve import CurvePeer
from helpers.raw_zmtp import RawPeer, frame, greeting, message, parts, ready

from share.net.keys import AgentKeys, authorize, generate_pair
from share.net.transport import connect
from share.wire.messages import peer_id

GROWTH_BYTES = 100_000_000
FLOOD_BYTES = 40_000_000  # of one peer after the other; without the guard's weights it takes 180 to 300 MB
ROUND_TRIP_S = 2.0  # at most, on a busy machine; without the guard it is as long as the attack
NEWCOMER_S = 6.0  # until the first answer, on a busy machine; without the guard's gate it is 10 and more
IDS = count(1000)
PING = frame(b"\x04PING\0\0abc", command=True)


@dataclass
class Front:
    """`echo_edge.py` as a child. agent, rogue: keys that it lets in; None without keys."""

    process: subprocess.Popen[str]
    endpoint: str
    agent: AgentKeys | None
    rogue: AgentKeys | None
    usual: int = 0

    @property
    def growth(self) -> int:
        """Bytes of memory, at most, beyond what it had when it began."""
        return self._status("VmHWM") - self.usual

    @property
    def descriptors(self) -> int:
        return len(os.listdir(f"/proc/{self.process.pid}/fd"))

    @property
    def cpu_s(self) -> float:
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def begin(self) -> None:
        self.usual = self._status("VmRSS")

    def join(self, identity: bytes | None = None) -> RawPeer:
        """A raw peer that has shaken hands, with an id of its own unless one is given."""
        identity = identity or peer_id(next(IDS))
        if self.rogue is None:
            return RawPeer.joined(self.endpoint, identity)
        return CurvePeer(self.endpoint, identity, self.rogue)

    def try_to_join(self, identity: bytes | None = None) -> RawPeer | None:
        """None where it is not let in."""
        try:
            return self.join(identity)
        except OSError:
            return None

    def end(self) -> tuple[dict[str, Any], float]:
        """What it says at its end, and how long that took, s."""
        began = time.monotonic()
        self.process.send_signal(signal.SIGINT)
        said, _ = self.process.communicate(timeout=30)
        assert self.process.returncode == 0
        return json.loads(said), time.monotonic() - began

    def _status(self, name: str) -> int:
        lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(name))


@pytest.fixture(params=["zmq", "curve"])
def front(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Front]:
    agent = rogue = None
    if request.param == "curve":
        edge = generate_pair(tmp_path / "edge", "edge")
        agent, rogue = (
            AgentKeys(generate_pair(tmp_path / name, name), edge.public) for name in ("agent", "rogue")
        )
        for keys in (agent, rogue):
            authorize(tmp_path / "edge", keys.own.name, keys.own.public)
    where = [] if agent is None else [str(tmp_path / "edge")]
    command = [sys.executable, str(Path(__file__).parents[1] / "helpers" / "echo_edge.py"), *where]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        front = Front(child, child.stdout.readline().strip(), agent, rogue)
        try:
            yield front
        finally:
            child.kill()


class Agent:
    """An honest one in a thread of its own. trips: of each message when it was sent, and how long until it
    came back, s."""

    def __init__(self, front: Front) -> None:
        self.trips: list[tuple[float, float]] = []
        self._front, self._over, self._sent = front, threading.Event(), 0.0
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Agent:
        self._thread.start()
        wait_for(lambda: len(self.trips) > 20)
        self._front.begin()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def longest(self, since: float) -> float:
        """Return the longest trip since then, s; one that has not ended counts as long as it has lasted."""
        took = [took for sent, took in self.trips if sent >= since]
        return max([*took, time.monotonic() - self._sent])

    def p95(self, since: float) -> float:
        took = sorted(took for sent, took in self.trips if sent >= since)
        return took[int(0.95 * len(took))]

    def _run(self) -> None:
        with closing(connect(self._front.endpoint, 1, self._front.agent)) as link:
            for number in count():
                self._sent, payload = time.monotonic(), [b"%d" % number]
                while not link.send(payload) and not self._over.is_set():
                    link.receive(5)
                while link.receive(20) != payload and not self._over.is_set():
                    pass
                if self._over.is_set():
                    return
                self.trips.append((self._sent, time.monotonic() - self._sent))
                time.sleep(0.002)


def wait_for(what: Callable[[], object], within_s: float = 15.0) -> None:
    end = time.monotonic() + within_s
    while not what():
        assert time.monotonic() < end, "did not happen in time"
        time.sleep(0.005)


@dataclass
class Attack:
    """Peers one after the other that each send `say(peer)` again and again, until `over`."""

    front: Front
    say: Callable[[RawPeer], bytes]
    over: threading.Event = field(default_factory=threading.Event)
    sent: list[int] = field(default_factory=list)  # bytes, by those that were cut off

    def run(self) -> None:
        while not self.over.is_set():
            peer = self.front.try_to_join()
            if peer is None:
                time.sleep(0.05)
                continue
            with peer:
                said, sent = self.say(peer), 0
                while peer.send(said) and not self.over.is_set():
                    sent += len(said)
                if not self.over.is_set():
                    self.sent.append(sent)


@contextmanager
def under(front: Front, say: Callable[[RawPeer], bytes], peers: int = 1) -> Iterator[Attack]:
    attack = Attack(front, say)
    threads = [threading.Thread(target=attack.run) for _ in range(peers)]
    for thread in threads:
        thread.start()
    try:
        yield attack
    finally:
        attack.over.set()
        for thread in threads:
            thread.join()


def large_parts(peer: RawPeer) -> bytes:
    if isinstance(peer, CurvePeer):
        return b"".join(peer.sealed(bytes(60_000), more=True) for _ in range(16))
    return parts(16, bytes(60_000))


def empty_parts(peer: RawPeer) -> bytes:
    if isinstance(peer, CurvePeer):
        return b"".join(peer.sealed(b"", more=True) for _ in range(4000))
    return parts(32_768)


def whole_messages(*bodies: bytes) -> Callable[[RawPeer], bytes]:
    """A hundred kB of the same small one."""

    def say(peer: RawPeer) -> bytes:
        if isinstance(peer, CurvePeer):
            return b"".join(peer.sealed_message(*bodies) for _ in range(3000 // len(bodies)))
        return message(*bodies) * (100_000 // len(message(*bodies)))

    return say


def many_parts(peer: RawPeer) -> bytes:
    """Half a million bytes and more: a whole message each time."""
    if isinstance(peer, CurvePeer):
        return b"".join(peer.sealed(b"", more=True) for _ in range(15_000)) + peer.sealed(b"")
    return parts(300_000) + message(b"")


DURATIONS = [pytest.param(2.0, id="2s"), pytest.param(10.0, id="10s", marks=pytest.mark.slow)]
WHAT = [large_parts, empty_parts, many_parts]


@pytest.mark.long
@pytest.mark.parametrize("lasts_s", DURATIONS)
@pytest.mark.parametrize("say", WHAT, ids=lambda say: say.__name__)
def test_endless_messages(front: Front, say: Callable[[RawPeer], bytes], lasts_s: float) -> None:
    """One peer after the other, at full speed: memory stays, the agent is served, and SIGINT ends it."""
    with Agent(front) as agent, under(front, say) as attack:
        began = time.monotonic()
        wait_for(lambda: attack.sent)
        time.sleep(lasts_s)
        print(f"growth {front.growth / 1e6:.1f} MB, sent until cut off {attack.sent[:4]}")
        print(f"round trips: 95 % {1e3 * agent.p95(began):.1f} ms, most {1e3 * agent.longest(began):.0f} ms")
        assert front.growth < GROWTH_BYTES
        assert agent.longest(began) < ROUND_TRIP_S
        said, took_s = front.end()
    assert took_s < 3.0
    assert any("disconnected" in line for line in said["said"])
    assert len(said["said"]) < 10


SMALL = {"empty": [b""], "a ping": [bytes(24)], "a pose": [bytes(300)], "empty parts": [b""] * 9}


@pytest.mark.long
@pytest.mark.parametrize("lasts_s", DURATIONS)
@pytest.mark.parametrize("front", ["zmq"], indirect=True)
@pytest.mark.parametrize("bodies", SMALL.values(), ids=SMALL)
def test_floods_of_small_whole_messages(front: Front, bodies: list[bytes], lasts_s: float) -> None:
    """Each takes 64 bytes and more for 2 on the wire, and the front takes them one by one."""
    with Agent(front) as agent, under(front, whole_messages(*bodies)) as attack:
        began = time.monotonic()
        wait_for(lambda: attack.sent)
        time.sleep(lasts_s)
        print(f"growth {front.growth / 1e6:.1f} MB, sent until cut off {attack.sent[:4]}")
        print(f"round trips: 95 % {1e3 * agent.p95(began):.1f} ms, most {1e3 * agent.longest(began):.0f} ms")
        assert front.growth < FLOOD_BYTES
        assert agent.longest(began) < ROUND_TRIP_S
        said, _ = front.end()
    assert any("disconnected" in line for line in said["said"]) and len(said["said"]) < 10


@pytest.mark.parametrize("front", ["zmq"], indirect=True)
@pytest.mark.parametrize("number", [3, pytest.param(30, marks=pytest.mark.slow)])
def test_new_agents_connect_during_repeated_attacks(front: Front, number: int) -> None:
    """From the same address, so that it cannot be kept out."""
    took = []
    with Agent(front), under(front, whole_messages(b"")) as attack:
        wait_for(lambda: attack.sent)
        for at in range(number):
            took.append(joining_s(front, 100 + at))
    print(f"newcomers waited {sorted(round(s, 2) for s in took)} s")
    assert sorted(took)[number // 2] < NEWCOMER_S


def joining_s(front: Front, run_id: int) -> float:
    """How long it takes a new agent to get its first answer; it says hello again and again, as they do."""
    began = again = time.monotonic()
    with closing(connect(front.endpoint, run_id, front.agent)) as link:
        while not link.receive(20):
            assert time.monotonic() < began + 30.0, "did not get in"
            if time.monotonic() >= again and link.send([b"hello"]):
                again = time.monotonic() + 0.4
    return time.monotonic() - began


@pytest.mark.long
@pytest.mark.parametrize("front", ["curve"], indirect=True)
def test_a_blocked_key_stays_out_and_others_connect(front: Front) -> None:
    with Agent(front), under(front, large_parts) as attack:
        wait_for(lambda: attack.sent)
        attack.over.set()
        time.sleep(0.1)
        assert front.try_to_join() is None
        other, front.rogue = front.rogue, front.agent
        with front.join() as peer:
            assert isinstance(peer, CurvePeer)
            assert peer.send(peer.sealed_message(b"hello")) and peer.hear(1)
        front.rogue = other


@pytest.mark.long
def test_many_peers_that_each_hold_a_little(front: Front) -> None:
    """60 of them begin a message and stay below what one may have waiting."""
    with Agent(front) as agent, ExitStack() as stack:
        began = time.monotonic()
        for _ in range(60):
            peer = front.try_to_join()
            if isinstance(peer, CurvePeer):
                said = peer.sealed_message(b"hi") + b"".join(peer.sealed(b"", more=True) for _ in range(2500))
            else:
                said = message(b"hi") + parts(45_000)
            if peer is not None:
                stack.enter_context(peer).send(said)
        time.sleep(0.5)
        print(f"growth {front.growth / 1e6:.0f} MB")
        assert front.growth < 2.5 * GROWTH_BYTES
        assert agent.longest(began) < ROUND_TRIP_S


@pytest.mark.parametrize("number", [300, pytest.param(10_000, marks=pytest.mark.slow)])
def test_a_flood_of_silent_connections(front: Front, number: int) -> None:
    host, port = front.endpoint.removeprefix("tcp://").split(":")
    usual = front.descriptors
    with Agent(front) as agent, ExitStack() as stack:
        began, used_s, most = time.monotonic(), front.cpu_s, 0
        for at in range(number):
            with suppress(ConnectionResetError):  # cut off before it knew that it was connected
                stack.enter_context(closing(socket.create_connection((host, int(port)), timeout=10)))
            if at % 20 == 0:
                most = max(most, front.descriptors - usual)
        print(f"{number} in {time.monotonic() - began:.2f} s, {front.cpu_s - used_s:.2f} s of CPU time")
        print(f"descriptors {most}, growth {front.growth / 1e6:.1f} MB, most {agent.longest(began):.3f} s")
        wait_for(lambda: front.descriptors - usual < 150)
        assert front.growth < GROWTH_BYTES
        assert agent.longest(began) < ROUND_TRIP_S
        said, took_s = front.end()
    assert took_s < 3.0 and len(said["said"]) < 10


@pytest.mark.slow
@pytest.mark.parametrize(
    "beginning",
    [b"", b"\xff", greeting()[:40], greeting(), greeting() + ready(b"12345678")[:9]],
    ids=["nothing", "a byte", "half a greeting", "a greeting", "half of READY"],
)
def test_an_unfinished_handshake_is_ended(front: Front, beginning: bytes) -> None:
    with RawPeer(front.endpoint) as peer:
        peer.send(beginning)
        assert peer.closed(within_s=15.0)


@pytest.mark.long
@pytest.mark.parametrize("front", ["zmq"], indirect=True)
def test_unidentified_peers_are_counted_and_delay_no_agent(front: Front) -> None:
    """Whoever has an id that is not 8 bytes is no agent, however much it says."""
    with Agent(front) as agent:
        began = time.monotonic()
        while time.monotonic() < began + 1.5:
            peer = front.try_to_join(b"abc")
            while peer and peer.send(message(b"hello") * 2000) and time.monotonic() < began + 1.5:
                pass
            if peer:
                peer.close()
        print(f"growth {front.growth / 1e6:.0f} MB")  # small whole messages: what came before it was cut off
        assert agent.longest(began) < ROUND_TRIP_S and front.growth < 4 * GROWTH_BYTES
        said, _ = front.end()
    assert said["strangers"] > 0 and len(said["said"]) < 10


def test_a_flood_of_failed_handshakes_gives_few_reports(front: Front) -> None:
    wrong = frame(b"\x05READY\xff\xff", command=True)
    with Agent(front) as agent:
        began, used_s = time.monotonic(), front.cpu_s
        for _ in range(500):
            with RawPeer(front.endpoint) as peer:
                peer.send(greeting(b"NULL" if front.rogue is None else b"PLAIN"))
                peer.send(wrong)
        print(f"{front.cpu_s - used_s:.2f} s of CPU time in {time.monotonic() - began:.2f} s")
        assert agent.longest(began) < ROUND_TRIP_S and front.growth < GROWTH_BYTES
        said, _ = front.end()
    assert len(said["said"]) < 10


@pytest.mark.long
@pytest.mark.parametrize("last", [b"", PING], ids=["messages", "a ping"])
def test_a_peer_that_fills_its_queue_and_disconnects(front: Front, last: bytes) -> None:
    """libzmq 4.3.5 ends the whole process where a connection breaks whose input it had stopped, and then
    a heartbeat is to be sent or answered: so its input is never stopped."""
    for _ in range(20):
        with front.join() as peer:
            if isinstance(peer, CurvePeer):
                peer.send(b"".join(peer.sealed_message(bytes(10)) for _ in range(2000)))
            else:
                peer.send((message(bytes(10)) * 200 + last) * 50)
            peer.reset()
    time.sleep(1.2)  # two heartbeats
    with Agent(front):
        said_at_end, _ = front.end()
    assert said_at_end["messages"] > 0


@pytest.mark.long
def test_a_connection_that_was_taken_over_and_is_reset(front: Front) -> None:
    """The same, where a second connection with its id has stopped its input; its heartbeat would be due."""
    for pause_s in (0.0, 0.1, 0.2, 0.3, 0.4):
        first, second = front.join(b"the same"), front.join(b"the same")
        with second:
            for peer in (first, second, *[first] * 5):
                peer.send(peer.sealed_message(b"x") if isinstance(peer, CurvePeer) else message(b"x"))
            time.sleep(pause_s)
            first.reset()
            time.sleep(0.5)
    with Agent(front):
        front.end()
