"""Emulated networks: the model of a channel, the link around it, and which agent has which."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from share.errors import ConfigError, UsageError
from share.lab.evaluate.emulated_network import (
    NETWORK_PRESETS,
    Channel,
    ChannelModel,
    EmulatedLink,
    LinkAssignment,
    NetworkModel,
    load_network,
)
from share.plain_data import from_mapping
from share.wire.codec import encode
from share.wire.layouts import Bytes
from share.wire.messages import Ping

MS = 1_000_000


def arrivals(
    way: ChannelModel, sizes: list[int], every_ms: float, seed: int = 0, round_trip_ms: float = 4.0
) -> np.ndarray:
    """When each message arrives after it was sent, ms."""
    channel = Channel(way, round_trip_ms, np.random.default_rng(seed))
    sent = [round(i * every_ms * MS) for i in range(len(sizes))]
    return np.array([channel.arrival_ns(n, t) - t for n, t in zip(sizes, sent, strict=True)]) / MS


def test_a_message_takes_its_time_on_the_air_and_waits_for_those_before_it() -> None:
    late = arrivals(ChannelModel(mbps=8.0, delay_ms=3.0), [10_000 - 7 * 66, 934, 934], every_ms=1.0)
    assert late == pytest.approx([10 + 3, 10 + 1 + 3 - 1, 10 + 1 + 1 + 3 - 2])


def test_messages_arrive_in_order() -> None:
    sent = np.arange(2000) * 2.0
    late = arrivals(NETWORK_PRESETS["wifi-busy"].up, [400] * 2000, every_ms=2.0)
    assert (np.diff(sent + late) >= -1e-6).all()
    assert len(np.unique(late)) > 1000


def test_jitter_has_the_stated_mean() -> None:
    late = arrivals(ChannelModel(delay_ms=2.0, jitter_ms=3.0), [100] * 20_000, every_ms=1000.0)
    assert late.min() >= 2.0
    assert late.mean() == pytest.approx(5.0, rel=0.03)


def test_lost_packets_arrive_late() -> None:
    """One packet a message: the share that is late is the loss; the first try again after 2 x 4 + 10 ms."""
    late = arrivals(ChannelModel(loss=0.05), [100] * 40_000, every_ms=5000.0)
    assert (late > 0).mean() == pytest.approx(0.05, rel=0.07)
    once = late[late > 0]
    assert np.isclose(once, 18.0).mean() == pytest.approx(0.95, abs=0.02)
    assert set(np.round(np.unique(once[once < 700]), 6)) == {18.0, 218.0, 618.0}


def test_bursts_keep_the_loss_rate() -> None:
    """Large messages lose as many packets, but fewer of them are late."""
    single, bursts = (
        arrivals(ChannelModel(loss=0.02, burst=b), [14_000] * 8_000, every_ms=10_000.0) > 0
        for b in (1.0, 5.0)
    )
    assert single.mean() == pytest.approx(1 - 0.98**10, rel=0.06)
    assert bursts.mean() == pytest.approx(1 - 0.98 * (1 - 0.2 * 0.02 / 0.98) ** 9, rel=0.15)
    channel = Channel(ChannelModel(loss=0.02, burst=5.0), 4.0, np.random.default_rng(1))
    lost = np.array([channel._is_lost() for _ in range(300_000)])
    assert lost.mean() == pytest.approx(0.02, rel=0.1)
    assert lost.sum() / (np.diff(lost.astype(int)) == 1).sum() == pytest.approx(5.0, rel=0.1)


def test_delays_follow_from_the_seed() -> None:
    way = NETWORK_PRESETS["wifi5"].down
    assert (arrivals(way, [500] * 300, 3.0, seed=4) == arrivals(way, [500] * 300, 3.0, seed=4)).all()
    assert (arrivals(way, [500] * 300, 3.0, seed=4) != arrivals(way, [500] * 300, 3.0, seed=5)).any()


def test_bursts_continue_from_message_to_message() -> None:
    """A packet each: a burst goes on from one to the next."""
    late = arrivals(ChannelModel(loss=0.02, burst=4.0), [100] * 60_000, every_ms=10_000.0) > 0
    assert late.mean() == pytest.approx(0.02, rel=0.12)
    ends = np.flatnonzero(np.diff(late.astype(int)) == -1)
    begins = np.flatnonzero(np.diff(late.astype(int)) == 1)
    runs = min(len(begins), len(ends))
    assert late.sum() / runs == pytest.approx(4.0, rel=0.12)


@pytest.mark.parametrize("wrong", [{"loss": 0.9}, {"burst": 0.5}])
def test_impossible_losses_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="loss must be at most"):
        from_mapping(ChannelModel, wrong, "a file")


# ---------------------------------------------------------------- the link


class Loopback:
    """An `AgentLink` that keeps what is sent and gives what is put into `incoming`; None wakes it."""

    def __init__(self) -> None:
        self.sent: list[list[bytes]] = []
        self.incoming: queue.SimpleQueue[list[bytes] | None] = queue.SimpleQueue()

    def send(self, frames: Sequence[Bytes]) -> bool:
        self.sent.append([bytes(frame) for frame in frames])
        return True

    def receive(self, timeout_ms: int) -> list[bytes] | None:
        try:
            return self.incoming.get(timeout=timeout_ms * 1e-3)
        except queue.Empty:
            return None

    def wake(self) -> None:
        self.incoming.put(None)

    def trouble(self) -> str | None:
        return None

    def poll_connected(self) -> bool:
        return False

    def close(self) -> None:
        pass


def test_an_emulated_link_delays_both_directions_and_can_be_woken() -> None:
    inner = Loopback()
    link = EmulatedLink(inner, NetworkModel(ChannelModel(delay_ms=30.0), ChannelModel(delay_ms=20.0)), 0)
    delays = []
    for i in range(5):
        sent = time.monotonic()
        assert link.send(encode(Ping(i, 0)))
        assert not inner.sent
        assert link.receive(25) is None
        while not inner.sent:
            link.receive(5)
        there = time.monotonic()
        inner.incoming.put(inner.sent.pop())
        while link.receive(50) is None:
            pass
        delays.append((1e3 * (there - sent), 1e3 * (time.monotonic() - there)))
    up, down = zip(*delays, strict=True)
    assert min(up) >= 30 and sorted(up)[2] < 40
    assert min(down) >= 20 and sorted(down)[2] < 30
    threading.Timer(0.05, link.wake).start()
    began = time.monotonic()
    assert link.receive(2000) is None
    assert time.monotonic() - began < 1.0
    link.close()


def test_a_network_is_a_preset_or_a_file(tmp_path: Path) -> None:
    file = tmp_path / "far.yaml"
    file.write_text("up: {mbps: 5, delay_ms: 40}\ndown: {delay_ms: 35, jitter_ms: 2}\n")
    assert load_network(str(file)) == NetworkModel(ChannelModel(5.0, 40.0), ChannelModel(0.0, 35.0, 2.0))
    assert load_network("wifi5").round_trip_ms == pytest.approx(3.4)
    with pytest.raises(UsageError, match="neither a file nor one of wifi5, wifi-busy"):
        load_network("wifi6")
    file.write_text("up: {speed: 5}\n")
    with pytest.raises(ConfigError, match=r"far.yaml: up: unknown key 'speed'"):
        load_network(str(file))


# ---------------------------------------------------------------- --link


@pytest.mark.parametrize(
    ("text", "ann", "bob"),
    [
        (None, None, None),
        ("wifi5", "wifi5", "wifi5"),
        ("wifi5,bob=wifi-busy", "wifi5", "wifi-busy"),
        ("bob=wifi-busy, wifi5", "wifi5", "wifi-busy"),
        ("bob=wifi-busy", None, "wifi-busy"),
        ("ann=wifi5,bob=wifi-busy", "wifi5", "wifi-busy"),
    ],
)
def test_links_of_agents(text: str | None, ann: str | None, bob: str | None) -> None:
    links = LinkAssignment.parse(text)
    assert (links.name_for("ann"), links.name_for("bob")) == (ann, bob)
    assert links.network_for("ann") == (NETWORK_PRESETS[ann] if ann else NetworkModel())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("wifi5,wifi-busy", "two links for all; give one, and others as AGENT=LINK"),
        ("bob=wifi5,bob=wifi-busy", "two links for bob"),
        ("wifi5,bob=wifi6", "'wifi6' is neither a file"),
        ("wifi5,", "'' is neither a file"),
        ("bob=", "'' is neither a file"),
    ],
)
def test_malformed_links_are_refused(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        LinkAssignment.parse(text)


def test_a_link_of_an_unknown_agent_is_refused() -> None:
    links = LinkAssignment.parse("wifi5,bop=wifi-busy")
    links.check(["ann", "bop"])
    with pytest.raises(UsageError, match="there is no agent 'bop'; the agents are ann, bob"):
        links.check(["ann", "bob"])


def test_a_file_name_may_have_any_character(tmp_path: Path) -> None:
    odd, plain = tmp_path / "a=b,c.yaml", tmp_path / "far.yaml"
    for file in (odd, plain):
        file.write_text("up: {mbps: 5, delay_ms: 40}\n")
    assert LinkAssignment.parse(str(odd)).network_for("ann") == NetworkModel(ChannelModel(5.0, 40.0))
    assert LinkAssignment.parse(f"bob={plain}").network_for("bob") == NetworkModel(ChannelModel(5.0, 40.0))
