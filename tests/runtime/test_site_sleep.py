"""Rooms of a site with real mappers and map files: they sleep, and wake up as they were."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
from helpers.hellos import hello_of
from helpers.map_changes import keyframe, pose, run, small_map
from helpers.map_files import is_locked

from share.config import Config, EdgeConfig
from share.protocol.edge import EdgeProtocol
from share.protocol.edge_events import PeerMessageReceived
from share.runtime import site_rooms
from share.runtime.edge_observer import EdgeObservers
from share.runtime.site_rooms import RoomSetup, SiteRooms
from share.store.map_store import MapStore
from share.wire.codec import decode, encode
from share.wire.messages import Refused, Welcome, peer_id


class Host:
    """The edge around the rooms, without a link."""

    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.events: list[tuple[str, str]] = []

    def wake(self) -> None: ...

    def send(self, peer: bytes, frames: Any) -> None:
        self.sent.append(decode([bytes(f) for f in frames]))

    def expect_growth(self, is_expected: bool) -> None: ...

    def record(self, fields: dict[str, Any]) -> None:
        self.events.append((fields["event"], fields["reason"]))

    def log_event(self, event: str, reason: str) -> None:
        self.events.append((event, reason))


def setup_of(folder: Path, name: str, changes: list[Any]) -> RoomSetup:
    store = MapStore.open(folder / f"{name}.sqlite")
    store.write(changes)
    return RoomSetup(name, Config(), store, EdgeObservers())


class Room:
    """Stands for a `ServedRoom`. name: by the policy of its settings."""

    is_idle, loss, protocol = False, None, EdgeProtocol(Config(), 7)

    def __init__(self, settings: Config, *_: Any) -> None:
        self.settings, self.steps = settings, 0

    def handle(self, event: PeerMessageReceived) -> None: ...

    def step(self) -> None:
        self.steps += 1
        if self.settings.edge.max_agents == 1:
            raise KeyError("a mistake")

    def report(self) -> dict[str, Any]:
        return self.protocol.report({}) | {"trouble": [], "degraded": [], "agent_trouble": []}

    def close(self) -> None:
        self.is_closed = True
        if self.settings.edge.max_agents == 1:
            raise KeyError("another")


def test_a_mistake_in_one_room_is_said_and_costs_the_others_nothing(monkeypatch) -> None:
    """It ended the site, or the steps of all rooms after it."""
    monkeypatch.setattr(site_rooms, "ServedRoom", Room)
    host, faulty = Host(), Config(edge=EdgeConfig(max_agents=1))
    setups = [
        RoomSetup(name, config, None, EdgeObservers())
        for name, config in {"hall": faulty, "lab": Config()}.items()
    ]
    site = SiteRooms(host, setups, time.monotonic_ns(), False)
    for _ in range(3):
        site.step()
    assert [room.room.steps for room in site._rooms.values()] == [3, 3]
    assert [kind for kind, _ in host.events] == ["internal error"]
    assert "room 'hall': KeyError" in host.events[0][1]
    (line,) = site.report()["trouble"]
    assert line.startswith("internal error: room 'hall': KeyError")
    assert (site.close() or "").startswith("room 'hall': KeyError: 'another'")
    assert all(room.room.is_closed for room in site._rooms.values())


def test_a_room_whose_report_fails_is_shown_as_it_was(monkeypatch) -> None:
    """One such room froze the page of all."""
    monkeypatch.setattr(site_rooms, "ServedRoom", Room)
    setups = [RoomSetup(name, Config(), None, EdgeObservers()) for name in ("hall", "lab")]
    host = Host()
    site = SiteRooms(host, setups, time.monotonic_ns(), False)
    assert site.report()["trouble"] == []

    def fail() -> None:
        raise KeyError(b"a run")

    monkeypatch.setattr(site._rooms["hall"].room, "report", fail)
    report = site.report()
    assert report["rooms"].keys() == {"hall", "lab"}
    stale, mistake = report["trouble"]
    assert stale == "room 'hall': no new report can be made: all values shown are old"
    assert mistake.startswith("internal error: a report of room 'hall': KeyError")
    assert len(site.report()["trouble"]) == 2
    site.close()


def test_hellos_of_whom_no_room_lets_in_are_counted(monkeypatch) -> None:
    monkeypatch.setattr(site_rooms, "ServedRoom", Room)
    setups = [RoomSetup("hall", Config(), None, EdgeObservers(), frozenset({"ann"}))]
    host = Host()
    site = SiteRooms(host, setups, time.monotonic_ns(), False)
    for k in range(30):
        site.handle(PeerMessageReceived(peer_id(k), [bytes(f) for f in encode(hello_of("eve", k))]))
    assert {type(one) for one in host.sent} == {Refused}
    (line,) = site.report()["refused"]
    assert line.startswith("agents that no room lets in: 30 hellos refused, the last: no room of this site")
    site.close()


def test_each_room_is_shown_its_own_report(monkeypatch) -> None:
    monkeypatch.setattr(site_rooms, "ServedRoom", Room)
    seen = dict[str, Any]()

    class Observer(EdgeObservers):
        def __init__(self, room: str) -> None:
            super().__init__()
            self._room = room

        def add_report(self, report: Any) -> None:
            seen[self._room] = report

    setups = [RoomSetup(name, Config(), None, Observer(name)) for name in ("hall", "lab")]
    site = SiteRooms(Host(), setups, time.monotonic_ns(), False)
    site.show_report({})
    assert seen == {}  # there is none yet
    whole = site.report()
    site.show_report(whole)
    assert seen.keys() == {"hall", "lab"}
    assert all("rooms" not in report and report["session"] == 7 for report in seen.values())
    site.close()


def one_run(room: str) -> list[Any]:
    key = f"{room}-0003"
    return [run(key), *(keyframe(key, i, first=i == 0) for i in range(20))]


@pytest.mark.long
def test_rooms_sleep_and_a_run_that_returns_goes_on_in_its_room(tmp_path: Path) -> None:
    host = Host()
    setups = [
        setup_of(tmp_path, "hall", []),
        setup_of(tmp_path, "lab", small_map()),
        *(setup_of(tmp_path, name, one_run(name)) for name in ("kitchen", "attic")),
    ]
    site = SiteRooms(host, setups, time.monotonic_ns(), False)
    most_awake = 0

    def step_until(condition: Any) -> dict[str, Any]:
        deadline = time.monotonic() + 180.0
        while not condition(report := site.report()):
            assert time.monotonic() < deadline, (report["directory"], report["rooms"])
            time.sleep(0.01)
            site.step()
            nonlocal most_awake
            most_awake = max(most_awake, sum(room.room is not None for room in site._rooms.values()))
        return report

    def are_asleep(now: dict[str, Any]) -> bool:
        return all("asleep" in room for room in now["rooms"].values())

    assert are_asleep(site.report())  # from the beginning
    asleep = step_until(lambda now: now["directory"]["keyframes"] == 80 and are_asleep(now))
    assert asleep["rooms"]["lab"]["keyframes"] == 40
    assert most_awake == 2
    step_until(lambda now: not any(map(is_locked, tmp_path.glob("*.sqlite"))))

    ann = hello_of("ann", 1, T=pose(3))
    site.handle(PeerMessageReceived(peer_id(1), [bytes(f) for f in encode(ann)]))
    awake = step_until(lambda now: host.sent)
    assert [type(one) for one in host.sent[:1]] == [Welcome]
    assert host.sent[0].next_keyframe == 20
    assert "asleep" not in awake["rooms"]["lab"]
    assert awake["rooms"]["hall"]["asleep"]
    again = step_until(lambda now: now["rooms"]["lab"]["keyframes"] == 40 and not now.get("loading"))
    assert again["directory"]["keyframes"] == 80
    assert again["agents"]["ann"]["room"] == "lab"
    assert site.close() is None
    assert not [one for one in host.events if one[0] in ("mapper died", "internal error")]
