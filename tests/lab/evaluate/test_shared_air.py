"""The air of one access point: time on it, turns, collisions, order."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from share.errors import ConfigError, UsageError
from share.lab.evaluate.emulated_network import NETWORK_PRESETS, LinkAssignment, NetworkModel, load_network
from share.lab.evaluate.shared_air import AirModel, SharedAir
from share.plain_data import from_mapping

MS = 1_000_000


class Room:
    """A clock, a shared channel, and when messages arrived, ms, by label."""

    def __init__(self, mbps: float, loss: float = 0.0, seed: int = 0) -> None:
        self.now_ns, self._order = 0, count()
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self.air = SharedAir(AirModel(mbps, loss), np.random.default_rng(seed), self.after)
        self.arrived: list[tuple[str, float]] = []

    def after(self, delay_ns: int, action: Callable[[], None]) -> None:
        heapq.heappush(self._events, (self.now_ns + delay_ns, next(self._order), action))

    def send(self, station: str, size: int, label: str = "", at_ms: float = 0.0) -> None:
        def arrive() -> None:
            self.arrived.append((label or station, self.now_ns / MS))

        self.after(round(at_ms * MS) - self.now_ns, lambda: self.air.send(station, station, size, arrive))

    def run(self, until_ms: float = 1e9) -> None:
        while self._events and self._events[0][0] <= until_ms * MS:
            self.now_ns, _, action = heapq.heappop(self._events)
            action()


@pytest.mark.parametrize(("mbps", "ms"), [(5.0, 53.7), (8.0, 33.9), (150.0, 2.0)])
def test_a_keyframe_takes_its_bytes_and_the_overhead_of_its_turns(mbps: float, ms: float) -> None:
    took = []
    for seed in range(50):
        room = Room(mbps, seed=seed)
        room.send("ann", 27_000)
        room.run()
        [(_, at_ms)] = room.arrived
        took.append(at_ms)
    assert np.mean(took) == pytest.approx(ms, rel=0.02)
    assert min(took) > 27_000 * 8e-3 / mbps


def test_a_pose_of_another_agent_does_not_wait_for_a_whole_keyframe() -> None:
    room = Room(5.0)
    room.send("ann", 27_000)
    room.send("bob", 155, at_ms=1.0)
    room.run()
    assert [label for label, _ in room.arrived] == ["bob", "ann"]
    assert room.arrived[0][1] < 12


def test_stations_with_much_to_send_get_equal_shares_and_together_no_more_than_the_rate() -> None:
    room, size = Room(8.0), 14_480
    for k in range(100):
        for station in ("ann", "bob", "carl"):
            room.send(station, size, f"{station}{k}")
    room.run(until_ms=2000)
    got = {name: sum(label.startswith(name) for label, _ in room.arrived) for name in ("ann", "bob", "carl")}
    assert max(got.values()) - min(got.values()) <= 10
    carried = sum(got.values()) * size * 8e-3 / 2000
    assert 5.5 < carried < 8 * 1448 / (1448 + 106)


def test_messages_of_a_station_stay_in_order() -> None:
    rng, room = np.random.default_rng(3), Room(15.0, loss=0.1)
    for k, at_ms in enumerate(np.cumsum(rng.exponential(2.0, 300))):
        room.send("ann", int(rng.integers(50, 5000)), f"{k}", at_ms)
        room.send("bob", 500, "-", at_ms)
    room.run()
    assert [label for label, _ in room.arrived if label != "-"] == [str(k) for k in range(300)]


@pytest.mark.parametrize("n", [2, 6, 12])
def test_collisions_are_as_often_as_by_bianchis_formula(n: int) -> None:
    """Saturated stations: p = 1 - (1 - tau)^(n - 1), tau the chance that a station sends in a slot."""
    room = Room(54.0)
    for k in range(400):
        for station in range(n):
            room.send(f"s{station}", 27_000, f"{k}")
    room.run(until_ms=400 * n * 3)
    low, high = 0.0, 1.0  # tau falls with p
    for _ in range(60):
        p = (low + high) / 2
        doublings = sum((2 * p) ** k for k in range(6))  # windows of 16 to 1,024 slots
        tau = 2 / (1 + 16 + p * 16 * doublings)
        low, high = (p, high) if 1 - (1 - tau) ** (n - 1) > p else (low, p)
    some, one = 1 - (1 - tau) ** n, n * tau * (1 - tau) ** (n - 1)
    assert room.air.transmissions > 500
    assert room.air.collisions / room.air.transmissions == pytest.approx(1 - one / some, rel=0.2)


def test_losses_cost_time_only() -> None:
    sure, lossy = Room(8.0), Room(8.0, loss=0.3)
    for room in (sure, lossy):
        for k in range(100):
            room.send("ann", 2000, f"{k}", k * 100.0)
        room.run()
        assert len(room.arrived) == 100
    assert lossy.air.busy_ns == pytest.approx(sure.air.busy_ns / 0.7, rel=0.15)


def test_equal_seeds_give_equal_arrivals() -> None:
    def arrivals(seed: int) -> list[tuple[str, float]]:
        room = Room(8.0, 0.05, seed)
        for k in range(50):
            for station in ("ann", "bob"):
                room.send(station, 3000, at_ms=5.0 * k)
        room.run()
        return room.arrived

    assert arrivals(1) == arrivals(1) != arrivals(2)


def test_presets_and_files(tmp_path: Path) -> None:
    assert [NETWORK_PRESETS[f"shared-{n}"].air for n in (5, 8, 15, 150)] == [
        AirModel(float(n), 0.01) for n in (5, 8, 15, 150)
    ]
    path = tmp_path / "hall.yaml"
    path.write_text("air: {mbps: 8}\nup: {delay_ms: 2}\n")
    assert load_network(str(path)).air == AirModel(8.0)
    for wrong in ("air: {mbps: 0}", "air: {mbps: 8, loss: 0.7}", "air: {mbps: 8}\nup: {mbps: 3}"):
        path.write_text(wrong)
        with pytest.raises(ConfigError, match=r"mbps"):
            load_network(str(path))
    with pytest.raises(ConfigError):
        from_mapping(NetworkModel, {"air": {"mbps": -1}}, "a file")


def test_shared_air_has_any_rate_by_its_name() -> None:
    assert load_network("shared-2.5").air == AirModel(2.5, 0.01)
    assert load_network("shared-5") is NETWORK_PRESETS["shared-5"]
    for name in ("shared-0", "shared-", "shared-5000", "shared-2.5e1"):
        with pytest.raises(UsageError, match="is neither a file nor one of"):
            load_network(name)


def test_shared_air_is_refused_in_real_time() -> None:
    links = LinkAssignment.parse("wifi5,bob=shared-8")
    links.check(["ann", "bob"], virtual=True)
    with pytest.raises(UsageError, match=r"--link shared-8: .*virtual time only"):
        links.check(["ann", "bob"])
