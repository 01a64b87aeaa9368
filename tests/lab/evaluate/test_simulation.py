"""Real agents and a real edge in virtual time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.edge_sim import Person, walls
from helpers.room_simulation import MS, tracked_frames

from share.config import Config, EdgeConfig
from share.geometry.camera import Camera
from share.lab.evaluate.emulated_network import NETWORK_PRESETS, NetworkModel
from share.lab.evaluate.processing_delays import Delay, MeasuredDelay, ProcessingDelays
from share.lab.evaluate.simulation import Simulation
from share.mapping import settling
from share.mapping.recognition.index import PlaceIndex
from share.mapping.recognition.patch_alignment import ImageView
from share.mapping.recognition.verification import CameraView, Refusal, Verification
from share.mapping.steps import AlignStep, DescribeStep, IndexStep, LookupStep, QueryStep, VerifyStep
from share.protocol import edge_events as ed
from share.protocol.common_events import SendToEdge
from share.store.map_store import MapStore
from share.types import KeyframeImage, View
from share.wire.codec import decode, encode
from share.wire.messages import Evaluation, Ping

pytestmark = pytest.mark.long

ROOM = walls(1)
IMAGE = ImageView(KeyframeImage.empty(), Camera(640, 480, 385.0, 385.0, 320.0, 240.0), np.eye(4))
LOOKS = CameraView(View.empty(), 385.0, np.eye(4), np.zeros(3))


def world(
    policy: str = "covins-g",
    seed: int = 0,
    seconds: float = 6.0,
    store: MapStore | None = None,
    day: int = 0,
    link: str = "wifi5",
    **costs: Delay,
) -> Simulation:
    """store: a map that the edge continues. day: the runs of another day have other numbers."""
    people = [Person("ann", ROOM, 0.0, 11), Person("bob", ROOM, 0.5, 22)]
    agents = [
        (
            replace(person.hello, run_id=person.hello.run_id + day),
            tracked_frames(person, seconds),
            NETWORK_PRESETS[link],
        )
        for person in people
    ]
    settings = Config(edge=EdgeConfig(policy=policy))
    made = Simulation(settings, agents, ProcessingDelays(**costs), seed, store=store)
    made.run(seconds + 1.0)
    return made


def track_ms(room: Simulation, name: str) -> list[float]:
    return room.logs[name].frames().track_ms.tolist()


def corrected_ms(room: Simulation, name: str) -> list[float]:
    """Return those of the frames that were corrected."""
    late = room.logs[name].frames().corrected_ms.tolist()
    return [ms for ms in late if not np.isnan(ms)]


def test_a_delay_has_its_median_and_95th_percentile() -> None:
    rng = np.random.default_rng(0)
    drawn = np.array([Delay(4.0, 9.0).draw_ns(x) for x in rng.standard_normal(20_000)]) / MS
    assert np.percentile(drawn, [50, 95]) == pytest.approx([4.0, 9.0], rel=0.03)


def test_a_sampled_delay_has_the_measured_quantiles() -> None:
    rng = np.random.default_rng(0)
    measured = MeasuredDelay((0.0, 0.0, 0.0, 2.0, 5.0))
    drawn = np.array([measured.draw_ns(x) for x in rng.standard_normal(20_000)]) / MS
    assert np.percentile(drawn, [0, 25, 50, 75, 100]) == pytest.approx([0, 0, 0, 2, 5], abs=0.06)


def test_agents_of_one_access_point_share_its_air() -> None:
    """Two agents send the same over either; over shared air each message waits for those of both."""
    own, shared = (world("fixed", link=link) for link in ("wifi5", "shared-5"))
    assert own.airs == {} and len(shared.airs) == 1
    [air] = shared.airs.values()
    sent = sum(one["bytes_up"] + one["bytes_down"] for one in shared.reports().values())
    assert sent * 8 / 5e6 < air.busy_ns / 1e9 < 7.0
    own_ms, shared_ms = (corrected_ms(room, "ann") + corrected_ms(room, "bob") for room in (own, shared))
    assert np.median(shared_ms) > np.median(own_ms)


def test_keyframe_work_after_a_frame_delays_the_next_one() -> None:
    none, always = (
        world(seconds=3.0, frame=Delay(5.0, 5.0), finish_keyframe=MeasuredDelay((ms,) * 2))
        for ms in (0.0, 80.0)
    )
    assert max(track_ms(none, "ann")) < 5.1
    waits = np.diff(track_ms(always, "ann"))
    assert np.median(waits) == pytest.approx(35.0, abs=1.0)  # 85 ms each, every 50 ms


@pytest.mark.slow
def test_an_edge_continues_the_map_of_another_day(tmp_path: Path) -> None:
    path = tmp_path / "room.sqlite"
    with MapStore.open(path) as store:
        first = world(store=store)
        store.write([first.mapper.current_poses()])
    with MapStore.open(path) as store:
        before = {k.keyframe_key for k in store.load().keyframes}
        second = world(store=store, day=1)
        after = {k.keyframe_key for k in store.load().keyframes}
    assert len(before) == 48 and len(after) == 96 and before < after
    report = second.edge.report(second.mapper.report())
    assert report["failed_steps"] == 0 and report["index_ms"]["n"] == 3  # 48 views, 16 at once
    assert list(second.mapper.report()["maps"].values()) == [96]


def test_all_agents_are_tracked_and_corrected_in_one_map() -> None:
    room = world()
    report = room.edge.report(room.mapper.report())
    assert {name: agent["keyframes"] for name, agent in report["agents"].items()} == {"ann": 24, "bob": 24}
    assert report["failed_steps"] == 0
    assert len(set(room.mapper.current_poses().map_ids)) == 1
    for name, log in room.logs.items():
        assert len(track_ms(room, name)) == 120
        assert np.median(track_ms(room, name)) == pytest.approx(ProcessingDelays().frame.p50, abs=1.0)
        assert corrected_ms(room, name)
        # tracked, sent, looked up, solved
        assert min(corrected_ms(room, name)) > 4 + 3 + 2 * 1.0 + 3 + 4 + 14 - 15
        both = [*track_ms(room, name), *corrected_ms(room, name)]
        assert log.report()["latency_ms"]["mean"] == pytest.approx(np.mean(both))


def test_who_settles_in_a_map_enters_it_after_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    """As without keyframes: none of those that come are enough."""
    monkeypatch.setattr(settling, "SETTLING_KEYFRAMES", 1000)
    assert len({report["map_id"] for report in world().reports().values()}) == 1
    monkeypatch.setattr(settling, "MAX_SETTLING_S", 1000.0)
    assert len({report["map_id"] for report in world().reports().values()}) == 2


def test_messages_arrive_in_order_however_long_the_edge_takes_to_receive_one() -> None:
    room = world(seconds=0.0, receive=Delay(2.0, 40.0))
    received: list[tuple[bytes, int]] = []
    edge_handle = room.edge.handle

    def handle(event: ed.EdgeEvent, now_ns: int) -> list[ed.EdgeEffect]:
        if isinstance(event, ed.PeerMessageReceived) and isinstance(ping := decode(event.frames), Ping):
            received.append((event.peer_id, ping.sequence))
        return edge_handle(event, now_ns)

    room.edge.handle = handle  # type: ignore[method-assign]
    for sequence in range(100):
        for member in room._members.values():
            room._send_up(member, encode(Ping(sequence, 0)))
    room.run(10.0)
    for peer in room._members:
        sequences = [sequence for sender, sequence in received if sender == peer][:100]
        assert sequences == sorted(sequences) and len(sequences) == 100


def test_loopback_is_no_scarce_air() -> None:
    """Nor are the first keyframes, which the edge holds, and whose evaluation arrives just before them."""
    people = [Person(name, ROOM, phase, k) for k, (name, phase) in enumerate([("ann", 0.0), ("bob", 0.5)])]
    agents = [(person.hello, tracked_frames(person, 6.0), NetworkModel()) for person in people]

    def on_effect(name: str, effect: object) -> None:
        if isinstance(effect, SendToEdge) and isinstance(message := decode(effect.frames), Evaluation):
            assert message.ack_ms < 10.0

    settings = Config(edge=EdgeConfig(policy="share"))
    room = Simulation(settings, agents, ProcessingDelays(), 3, on_effect=on_effect)
    room.run(7.0)
    peers = list(room.edge._registry.values())
    assert {peer.name: peer.arrival_ms < 3.0 for peer in peers} == {"ann": True, "bob": True}
    assert [peer.grant.jpeg_quality for peer in peers if peer.grant] == [None, None]


def test_a_run_depends_on_its_seed_alone() -> None:
    first, again, other = (track_ms(world(seed=seed, seconds=3.0), "ann") for seed in (1, 1, 2))
    assert first == again != other


def test_slow_tracking_delays_frames_and_slow_solving_delays_corrections() -> None:
    usual = world(seconds=3.0)
    slow = world(seconds=3.0, frame=Delay(70.0, 70.0))
    waits = np.diff(track_ms(slow, "ann"))
    assert 20.0 < np.median(waits) < 26.0  # 70 ms each, every 50 ms, and slices of keyframe work
    late = world(seconds=3.0, solve=Delay(300.0, 300.0))
    assert min(corrected_ms(late, "bob")) > 300 > np.median(corrected_ms(usual, "bob"))
    assert np.mean(track_ms(late, "bob")) == pytest.approx(np.mean(track_ms(usual, "bob")), rel=0.1)


def test_an_agent_receives_its_rate() -> None:
    room = world("share")
    report = room.edge.report(room.mapper.report())["agents"]
    received = {name: own["rate_hz"] for name, own in room.reports().items()}
    assert all(rate is not None for rate in received.values())
    assert {name: agent["rate_hz"] for name, agent in report.items()} == pytest.approx(received, abs=1e-3)


@pytest.mark.parametrize(
    ("step", "accepted", "refused"),
    [
        (DescribeStep(0, IMAGE), "describe", "describe"),
        (IndexStep(0, PlaceIndex(), ()), "index", "index"),
        (QueryStep(PlaceIndex(), 0, LOOKS, 5, ()), "query", "query"),
        (AlignStep(0, IMAGE, 1, IMAGE, np.eye(4)), "align_accepted", "align_refused"),
        (VerifyStep(0, LOOKS, 1, LOOKS), "verify_accepted", "verify_refused"),
        (VerifyStep(0, LOOKS, 1, LOOKS, IMAGE, None), "verify_accepted", "verify_refused"),
        (VerifyStep(0, LOOKS, 1, LOOKS, IMAGE, IMAGE), "verify_images_accepted", "verify_images_refused"),
    ],
    ids=lambda value: getattr(value, "kind", ""),
)
def test_each_step_of_a_look_up_has_its_delay(step: LookupStep, accepted: str, refused: str) -> None:
    """An accepted candidate is checked too."""
    delays, room = ProcessingDelays(), world(seconds=0.0)
    if accepted != refused:
        loop = Verification(np.eye(4), np.eye(6), 80, 70)
        done = getattr(delays, accepted)
        checked = Delay(done.p50 + delays.check_loop.p50, done.p95 + delays.check_loop.p95)
        assert room.delay_of(step, loop) == checked
    assert room.delay_of(step, Refusal("no")) == getattr(delays, refused)
