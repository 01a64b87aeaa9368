"""The agent's state machine: scripted events and their effects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
import pytest
from helpers.model_edge import COV, HELLO, MS, UP, S, handle, tracked

from share.config import ClockConfig, Config
from share.errors import UsageError
from share.geometry import se3
from share.protocol import agent_events as ev
from share.protocol.agent import AgentProtocol
from share.protocol.agent_ledger import WINDOW
from share.protocol.common_events import Connected, EdgeMessageReceived, FailRun, PrintLine, SendToEdge
from share.types import Correction, Keyframe, KeyframeImage, OdometryKeyframe, TrackState, View
from share.vision.keyframe_images import compress
from share.wire import messages as m
from share.wire.codec import WIRE_VERSION, decode, encode, message_bytes

T = TypeVar("T")
SESSION = 77


def said(effects: Sequence[ev.AgentEffect]) -> list[str]:
    return [effect.text for effect in effects if isinstance(effect, PrintLine)]


def sent(effects: Sequence[ev.AgentEffect]) -> list[Any]:
    return [decode(effect.frames) for effect in effects if isinstance(effect, SendToEdge)]


def only(kind: type[T], effects: Sequence[ev.AgentEffect], messages: bool = False) -> list[T]:
    return [x for x in (sent(effects) if messages else effects) if isinstance(x, kind)]


def tell(agent: AgentProtocol, message: m.Message, now_ns: int) -> list[ev.AgentEffect]:
    return handle(agent, EdgeMessageReceived(encode(message)), now_ns)


def welcomed(config: Config | None = None) -> AgentProtocol:
    """A connected agent at time 0."""
    agent = AgentProtocol(HELLO, config or Config())
    handle(agent, ev.AgentTick(), 0)
    tell(agent, m.Welcome(SESSION, 0), 0)
    return agent


def pose(x: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    return se3.from_rt(se3.so3_exp(np.array([0, 0, yaw])), np.array([x, 0, 0.0]))


def seen_at(depth: float) -> View:
    """A view of three points at this depth, m."""
    uv = np.array([[-0.1, 0.0], [0.0, 0.1], [0.1, 0.0]])
    return View(uv, depth * np.c_[uv, np.ones(3)], np.zeros((3, 32), np.uint8))


def correction(T: np.ndarray, revision: int, answers: int = -1, map_id: str = "a") -> Correction:
    """A correction of the segment of the keyframe that it answers, by default the first."""
    return Correction(T, COV, map_id, revision, max(answers, 0), answers)


# ---------------------------------------------------------------- being connected


def test_hello_is_repeated_until_a_welcome() -> None:
    agent = AgentProtocol(HELLO, Config())
    hellos = [bool(sent(handle(agent, ev.AgentTick(), t * 100 * MS))) for t in range(11)]
    assert [t for t, hello in enumerate(hellos) if hello] == [0, 5, 10]
    effects = tell(agent, m.Welcome(SESSION, 0), 1100 * MS)
    assert said(effects) == ["connected to the edge"]
    later = [x for t in range(12, 30) for x in sent(handle(agent, ev.AgentTick(), t * 100 * MS))]
    assert {type(x) for x in later} == {m.Ping, m.Status}


def test_keyframes_are_held_for_as_long_as_the_welcome_says() -> None:
    agent = AgentProtocol(HELLO, Config())
    handle(agent, ev.AgentTick(), 0)
    tell(agent, m.Welcome(SESSION, 0, 200.0), MS)
    handle(agent, tracked(0, pose(0), candidate=True), 10 * MS)
    for t in (50, 100, 150, 200):
        assert not only(Keyframe, handle(agent, ev.AgentTick(), t * MS), messages=True)
    [sent_now] = only(Keyframe, handle(agent, ev.AgentTick(), 205 * MS), messages=True)
    assert sent_now.id == 0
    tell(agent, m.Pong(1, 0, 1, 1, SESSION), 206 * MS)
    tell(agent, m.Ack(1), 235 * MS)
    told = agent.evaluation(0, 240 * MS)
    assert told is None or told.ack_ms == pytest.approx(30.0)  # on the air, not while it was held
    assert agent._self_evaluation.delay.ack_ms(240 * MS) == pytest.approx(30.0)


def test_an_unanswered_hello_prints_one_line() -> None:
    agent = AgentProtocol(HELLO, Config())
    lines = [line for t in range(100) for line in said(handle(agent, ev.AgentTick(), t * 100 * MS))]
    assert lines == ["no edge answers yet; tracking continues without the edge"]


def test_silence_and_reconnection_print_one_line_each() -> None:
    agent = welcomed()
    effects = [x for t in range(1, 100) for x in handle(agent, ev.AgentTick(), t * 100 * MS)]
    assert said(effects) == ["the edge is silent; tracking continues without the edge"]
    assert len(only(m.Hello, effects, messages=True)) == pytest.approx(14, abs=1)
    assert said(tell(agent, m.Welcome(SESSION, 0), 10 * S)) == ["reconnected to the edge"]
    assert agent.report()["connected"]
    assert agent.report()["edge_sessions"] == 1


def test_a_refusal_at_the_start_ends_the_run_with_its_reason() -> None:
    agent = AgentProtocol(HELLO, Config())
    handle(agent, ev.AgentTick(), 0)
    [fail] = tell(agent, m.Refused("the name is in use"), 1)
    assert isinstance(fail, FailRun)
    assert isinstance(fail.error, UsageError)
    assert str(fail.error) == "the edge refuses 'ann': the name is in use"
    assert handle(agent, ev.AgentTick(), 2) == []


def test_a_refusal_by_a_restarted_edge_does_not_end_the_run() -> None:
    agent = welcomed()
    assert said(tell(agent, m.Refused("full"), S)) == [
        "the edge refuses 'ann': full; tracking continues without the edge"
    ]
    hellos = [
        t for t in range(11, 80) if only(m.Hello, handle(agent, ev.AgentTick(), t * 100 * MS), messages=True)
    ]
    assert hellos[0] == 60
    assert only(ev.LocalisedPose, handle(agent, tracked(200), 10 * S))


def test_bad_messages_are_counted_and_each_kind_is_printed_once() -> None:
    agent = welcomed()
    lines = []
    for frames in ([b"junk"], [b"junk"], [], encode(m.Bye()), encode(m.Bye())):
        lines += said(handle(agent, EdgeMessageReceived(frames), S))
    assert agent.report()["bad_messages"] == 5
    assert len(lines) == 3
    assert lines[-1] == "the edge sent a Bye, which this agent does not expect"


def test_another_wire_version_prints_which_side_to_upgrade() -> None:
    agent = AgentProtocol(HELLO, Config())
    newer = b"\x94\x09\x01\x90\x90"
    assert said(handle(agent, EdgeMessageReceived([newer]), 0)) == [
        "invalid message from the edge: "
        f"header: peer speaks wire 9, this SHARE wire {WIRE_VERSION}: upgrade the older one"
    ]


def test_a_pong_of_another_session_causes_a_hello_and_a_resend() -> None:
    agent = welcomed()
    for k in range(3):
        handle(agent, tracked(k, pose(k), candidate=True), k * 50 * MS)
    tell(agent, m.Ack(3), 160 * MS)
    [ping] = only(m.Ping, handle(agent, ev.AgentTick(), 500 * MS), messages=True)
    effects = tell(agent, m.Pong(ping.sequence, ping.sent_ns, 1, 2, SESSION + 1), 501 * MS)
    assert only(m.Hello, effects, messages=True)
    effects = tell(agent, m.Welcome(SESSION + 1, 0), 502 * MS)
    assert said(effects) == ["the edge has restarted; 3 keyframes are resent"]
    assert [k.id for k in only(Keyframe, effects, messages=True)] == [0, 1, 2]
    assert tell(agent, m.Welcome(SESSION, 0), 503 * MS) == []  # overtaken on its way


def test_pings_measure_round_trip_and_clock() -> None:
    agent = welcomed()
    for t in range(1, 40):
        now = t * 500 * MS
        for ping in only(m.Ping, handle(agent, ev.AgentTick(), now), messages=True):
            edge = now + MS + 3 * S
            tell(agent, m.Pong(ping.sequence, ping.sent_ns, edge, edge, SESSION), now + 2 * MS)
            tell(agent, m.Pong(ping.sequence, ping.sent_ns, edge, edge, SESSION), now + 90 * MS)  # twice
    report = agent.report()
    assert report["rtt_ms"] == pytest.approx(2.0)
    assert report["clock_offset_ns"] == pytest.approx(3 * S, abs=20_000)
    assert abs(report["clock_drift_ppm"]) < 1


def latencies(edge_ns: Callable[[int], int], claim_ms: float = 1.0) -> tuple[list[float], AgentProtocol]:
    """All that is called latency or delay in 30 s of keyframes, each corrected 27 ms after its frame came,
    with an edge whose clock shows `edge_ns` of the agent's."""
    agent, told = welcomed(Config(clock=ClockConfig(claim_ms=claim_ms))), []
    for k in range(1, 600):
        now = k * 50 * MS + 4 * MS
        effects = handle(agent, tracked(k, pose(k / 100), candidate=k % 20 == 1), now)
        for ping in only(m.Ping, effects, messages=True):
            pong = m.Pong(ping.sequence, ping.sent_ns, edge_ns(now + MS), edge_ns(now + 2 * MS), SESSION)
            effects += tell(agent, pong, now + 4 * MS)
        for keyframe in only(Keyframe, effects, messages=True):
            tell(agent, m.Ack(keyframe.id + 1), now + 5 * MS)
            effects += tell(agent, correction(pose(), k, answers=keyframe.id), now + 23 * MS)
        told += [frame.track_ms for frame in only(ev.FrameDone, effects)]
        told += [evaluation.delay_ms for evaluation in only(m.Evaluation, effects, messages=True)]
        told += [c.corrected_ms for c in only(ev.CorrectionApplied, effects) if c.corrected_ms is not None]
    return told, agent


@pytest.mark.parametrize(
    "edge_ns",
    [
        lambda ns: ns - 86_400 * S,
        lambda ns: ns + 3 * S + ns // 10_000,  # and 100 ppm fast
        lambda ns: ns + (7 * S if ns < 15 * S else 9 * S),  # set in the middle
    ],
    ids=["a day behind", "fast", "set"],
)
def test_no_latency_depends_on_the_clock_offset(edge_ns: Callable[[int], int]) -> None:
    """So latencies are valid without the offset."""
    true, _ = latencies(lambda ns: ns)
    told, _ = latencies(edge_ns)
    assert told == pytest.approx(true, abs=1e-3)
    assert {round(x) for x in true} == {4, 27}  # to the pose; to the correction


def test_the_clock_offset_is_reported_if_the_setting_allows_its_uncertainty() -> None:
    """1 ms there and 2 back: the offset is wrong by 0.5, which no exchange shows."""
    _, agent = latencies(lambda ns: ns + 3 * S)
    strict = agent.clock_estimate(30 * S)
    assert (strict.claim_ms, strict.is_reliable, strict.offset_ms) == (1.0, False, None)
    assert strict.asymmetry_ms == pytest.approx(2.5)
    _, agent = latencies(lambda ns: ns + 3 * S, claim_ms=3.0)
    assert agent.clock_estimate(30 * S).offset_ms == pytest.approx(2999.5, abs=0.1)
    assert not agent.clock_estimate(7200 * S).is_reliable  # long after it was last heard


# ---------------------------------------------------------------- frames


def test_every_frame_is_localised_and_done_with_or_without_an_edge() -> None:
    agent = AgentProtocol(HELLO, Config())
    [localised] = only(ev.LocalisedPose, effects := handle(agent, tracked(3, pose(1)), 160 * MS))
    assert (localised.index, localised.T_map_odom, localised.map_id) == (3, None, None)
    np.testing.assert_array_equal(localised.T_odom_body, pose(1))
    assert only(ev.FrameDone, effects) == [
        ev.FrameDone(10**15 + 150 * MS, 4.0, TrackState.OK, is_keyframe=False, is_sent=False)
    ]


def test_a_lost_frame_is_done_without_a_pose() -> None:
    agent = welcomed()
    lost = ev.FrameTracked(0, 0, 0, MS, TrackState.LOST)
    effects = handle(agent, lost, MS)
    assert only(ev.LocalisedPose, effects) == only(m.PoseUpdate, effects, messages=True) == []
    assert only(ev.FrameDone, effects)[0].state is TrackState.LOST


def test_a_frame_is_done_if_its_keyframe_could_not_be_made() -> None:
    agent = welcomed()
    handle(agent, tracked(0, pose(0), candidate=True), 0)
    frame = tracked(1, pose(1), candidate=True)
    effects = agent.handle(frame, 60 * MS) + agent.handle(ev.KeyframeMade(frame, None), 70 * MS)
    assert only(ev.FrameDone, effects) == [
        ev.FrameDone(frame.stamp_ns, 4.0, TrackState.OK, is_keyframe=False, is_sent=False)
    ]
    assert not only(Keyframe, effects, messages=True)
    [after] = only(Keyframe, handle(agent, tracked(2, pose(2), candidate=True), 100 * MS), messages=True)
    assert (after.id, after.reference, agent.report()["candidates"]) == (1, 0, 2)
    np.testing.assert_allclose(after.T_ref_body, pose(2))


def test_a_keyframe_is_of_the_frame_that_it_came_with() -> None:
    """Its stamp and pose are that frame's, and a correction that answers it is as old as that. It carries the
    candidate's image, and no ORB features: the edge finds them."""
    agent = welcomed()
    for k in range(3):
        handle(agent, tracked(k, pose(k)), 50 * k * MS)
    frame = replace(tracked(3, pose(3)), is_keyframe=True)
    image = KeyframeImage(np.arange(9, dtype=np.uint8), np.zeros((1, 2)), [[0, 0, 0.5]], [0.01])
    candidate = OdometryKeyframe(pose(3), pose(3), COV, UP, 0.01, View.empty(), True, image)
    effects = agent.handle(frame, 154 * MS) + agent.handle(ev.KeyframeMade(frame, candidate), 160 * MS)
    [made] = only(Keyframe, effects, messages=True)
    assert made.stamp_ns == tracked(3).stamp_ns
    assert made.image.jpeg.tolist() == image.jpeg.tolist() and made.image.plane.tolist() == [[0, 0, 0.5]]
    assert len(made.view) == 0
    [done] = only(ev.FrameDone, effects)
    assert (done.stamp_ns, done.is_keyframe, done.is_sent) == (frame.stamp_ns, True, True)
    [applied] = only(ev.CorrectionApplied, tell(agent, correction(pose(0), 1, answers=0), 250 * MS))
    assert (applied.stamp_ns, applied.corrected_ms) == (made.stamp_ns, pytest.approx(100.0))


def test_poses_are_relative_to_the_last_acknowledged_keyframe() -> None:
    agent = welcomed()
    handle(agent, tracked(0, pose(1), candidate=True), 0)
    [before] = only(m.PoseUpdate, handle(agent, tracked(1, pose(2)), 50 * MS), messages=True)
    assert before.keyframe == -1
    np.testing.assert_array_equal(before.T_keyframe_body, pose(2))
    tell(agent, m.Ack(1), 60 * MS)
    [after] = only(m.PoseUpdate, handle(agent, tracked(2, pose(2.5)), 100 * MS), messages=True)
    assert after.keyframe == 0
    np.testing.assert_allclose(after.T_keyframe_body, pose(1.5))
    broken = handle(agent, tracked(3, pose(9), candidate=True, new_stretch=True), 150 * MS)
    for effects in (broken, handle(agent, tracked(4, pose(9)), 200 * MS)):
        assert [p.keyframe for p in only(m.PoseUpdate, effects, messages=True)] == [-1]


def test_a_pose_in_the_map_says_how_certain_it_is() -> None:
    """By the correction, turned and moved to the body, and odometry since."""
    agent = welcomed()
    [before] = only(m.PoseUpdate, handle(agent, tracked(0, pose(1), candidate=True), 0), messages=True)
    assert before.sigma_m is None and before.sigma_rad is None
    tell(agent, m.Ack(1), 50 * MS)
    tell(agent, correction(pose(0), 1, answers=0), 60 * MS)
    effects = handle(agent, tracked(1, pose(2)), 100 * MS)
    [sent], [known] = only(m.PoseUpdate, effects, messages=True), only(ev.LocalisedPose, effects)
    assert sent.sigma_m == pytest.approx(np.sqrt(np.trace(known.map_cov[3:, 3:]))) and sent.sigma_m > 0
    assert sent.sigma_rad == pytest.approx(np.sqrt(np.trace(known.map_cov[:3, :3]))) and sent.sigma_rad > 0


def test_keyframes_are_numbered_sent_and_evaluated() -> None:
    agent = welcomed()
    [ping] = only(m.Ping, handle(agent, ev.AgentTick(), 500 * MS), messages=True)
    tell(agent, m.Pong(ping.sequence, ping.sent_ns, 0, 0, SESSION), 503 * MS)
    effects = handle(agent, tracked(11, pose(1), candidate=True, ms=5), 560 * MS)
    [keyframe] = only(Keyframe, effects, messages=True)
    assert (keyframe.id, keyframe.reference, keyframe.stamp_ns) == (0, -1, 10**15 + 550 * MS)
    assert only(m.Evaluation, effects, messages=True) == [m.Evaluation(0, 10.0, 0.0, 10.0, 3.0)]
    assert only(ev.FrameDone, effects)[0].is_sent


def test_keyframes_made_offline_are_sent_after_the_welcome() -> None:
    agent = AgentProtocol(HELLO, Config())
    for k in range(40):
        effects = handle(agent, tracked(k, pose(k), candidate=True), k * 50 * MS)
        assert not only(Keyframe, effects, messages=True)
    effects = tell(agent, m.Welcome(SESSION, 0), 2 * S)
    assert [k.id for k in only(Keyframe, effects, messages=True)] == list(range(WINDOW))


# ---------------------------------------------------------------- rate


def test_the_rate_limit_is_a_token_bucket() -> None:
    agent = welcomed()
    tell(agent, m.Rate(2.0), 0)
    done, keyframes = [], []
    for k in range(100):  # 5 s, a candidate every frame
        effects = handle(agent, tracked(k, pose(k), candidate=True), k * 50 * MS)
        done += only(ev.FrameDone, effects)
        keyframes += only(Keyframe, effects, messages=True)
        tell(agent, m.Ack(len(keyframes)), k * 50 * MS)
    assert len(keyframes) == pytest.approx(1 + 2 * 5, abs=1)
    report = agent.report()
    assert report["candidates"] == 100 == report["keyframes"] + report["drop_rate"]
    assert [d.stamp_ns for d in done] == [10**15 + k * 50 * MS for k in range(100)]
    assert [d.stamp_ns for d in done if d.is_sent] == [k.stamp_ns for k in keyframes]
    T = np.eye(4)
    for keyframe in keyframes:  # the chain still leads to where the body was
        T = T @ keyframe.T_ref_body
        assert T[0, 3] == pytest.approx((keyframe.stamp_ns - 10**15) / (50 * MS))


def test_pictures_have_the_quality_that_the_edge_asks_for() -> None:
    rng, agent = np.random.default_rng(3), welcomed()
    made = replace(KeyframeImage.empty(), jpeg=compress(rng.integers(0, 256, (48, 64), np.uint8)))

    def sent_bytes(k: int) -> int:
        frame = tracked(4 * k, pose(k), candidate=True)
        handle(agent, replace(frame, is_keyframe=False), 200 * k * MS)
        candidate = OdometryKeyframe(pose(k), pose(1), COV, UP, 0.01, View.empty(), image=made)
        effects = agent.handle(ev.KeyframeMade(frame, candidate), 200 * k * MS)
        return len(only(Keyframe, effects, messages=True)[0].image.jpeg)

    assert sent_bytes(0) == len(made.jpeg)
    tell(agent, m.Rate(m.MAX_RATE_HZ, jpeg_quality=10), 100 * MS)
    assert sent_bytes(1) < 0.7 * len(made.jpeg)
    tell(agent, m.Rate(m.MAX_RATE_HZ), 300 * MS)
    assert sent_bytes(2) == len(made.jpeg)


def test_distant_views_are_preferred_at_the_same_rate() -> None:
    agent, depths = welcomed(), np.random.default_rng(3).uniform(1.0, 9.0, 200)
    tell(agent, m.Rate(2.0), 0)
    taken = []
    for k, depth in enumerate(depths):  # 40 s, five candidates a second
        at_ns = 200 * k * MS
        effects = handle(agent, tracked(4 * k, pose(k), candidate=True), at_ns, seen_at(depth))
        if only(ev.FrameDone, effects)[0].is_sent:
            taken.append(depth)
            tell(agent, m.Ack(len(taken)), at_ns)
    assert len(taken) == pytest.approx(1 + 2 * 40, abs=4)
    assert np.mean(taken) > np.mean(depths) + 0.8  # m


def test_a_correction_resets_the_expected_drift() -> None:
    agent, errors_cm = welcomed(), []
    [ping] = only(m.Ping, handle(agent, ev.AgentTick(), 500 * MS), messages=True)
    tell(agent, m.Pong(ping.sequence, ping.sent_ns, 0, 0, SESSION), 503 * MS)
    for k in range(12):
        now_ns = (550 + 50 * k) * MS
        if k == 6:
            tell(agent, replace(correction(pose(), 1, answers=4), cov=np.zeros((6, 6))), now_ns)
        effects = handle(agent, tracked(11 + k, candidate=True), now_ns)
        errors_cm += [e.error_cm for e in only(m.Evaluation, effects, messages=True)]
        tell(agent, m.Ack(k + 1), now_ns)
    sigma_cm = 100 * np.sqrt(np.trace(COV[3:, 3:]))
    since = np.array([0, 1, 2, 3, 4, 5, 2, 3, 4, 5, 6, 7])
    np.testing.assert_allclose(errors_cm, sigma_cm * np.sqrt(since))


# ---------------------------------------------------------------- corrections


def corrected_agent() -> AgentProtocol:
    """Connected, keyframe 0 of frame 0 sent and acknowledged."""
    agent = welcomed()
    handle(agent, tracked(0, candidate=True), 4 * MS)
    tell(agent, m.Ack(1), 10 * MS)
    return agent


def in_force(agent: AgentProtocol, now_ns: int) -> Any:
    [localised] = only(ev.LocalisedPose, handle(agent, tracked(now_ns // (50 * MS)), now_ns))
    return localised.T_map_odom


def test_the_first_correction_applies_at_once_and_its_latency_is_measured() -> None:
    agent = corrected_agent()
    effects = tell(agent, correction(pose(5), 1, answers=0), 31 * MS)
    assert only(ev.CorrectionApplied, effects) == [
        ev.CorrectionApplied(0, 0, 10**15, 31.0, "a", 1, jumps=True)
    ]
    np.testing.assert_array_equal(in_force(agent, 50 * MS), pose(5))
    [second] = only(ev.CorrectionApplied, tell(agent, correction(pose(5), 2, answers=0), 60 * MS))
    assert (second.keyframe_id, second.corrected_ms, second.jumps) == (0, None, False)
    [anothers] = only(ev.CorrectionApplied, tell(agent, correction(pose(5), 3), 60 * MS))
    assert (anothers.keyframe_id, anothers.stamp_ns, anothers.corrected_ms) == (None, None, None)


def test_a_correction_to_another_map_applies_at_once() -> None:
    agent = corrected_agent()
    tell(agent, correction(pose(0), 1), 100 * MS)
    [applied] = only(ev.CorrectionApplied, tell(agent, correction(pose(9), 2, map_id="b"), 200 * MS))
    assert applied.jumps
    np.testing.assert_array_equal(in_force(agent, 200 * MS), pose(9))


def test_stale_corrections_are_counted_and_ignored() -> None:
    agent = corrected_agent()
    tell(agent, correction(pose(1), 5), 100 * MS)
    for revision in (5, 4, 1):
        assert not only(ev.CorrectionApplied, tell(agent, correction(pose(2), revision), 200 * MS))
    assert agent.report()["corrections_stale"] == 3
    np.testing.assert_array_equal(in_force(agent, 300 * MS), pose(1))


def test_a_new_segment_ignores_corrections_of_earlier_ones() -> None:
    agent = corrected_agent()
    tell(agent, correction(pose(1), 1, answers=0), 100 * MS)
    handle(agent, tracked(4, pose(0), candidate=True, new_stretch=True), 200 * MS)
    assert in_force(agent, 250 * MS) is None
    for late in (correction(pose(1), 2, answers=0), correction(pose(1), 2)):
        assert not only(ev.CorrectionApplied, tell(agent, late, 260 * MS))
    [applied] = only(ev.CorrectionApplied, tell(agent, correction(pose(7), 3, answers=1), 300 * MS))
    assert applied.keyframe_id == 1
    np.testing.assert_array_equal(in_force(agent, 300 * MS), pose(7))


def test_the_first_correction_of_a_map_may_overtake_the_acknowledgement() -> None:
    """Acknowledgements wait for the disk of the edge; corrections do not."""
    agent = welcomed()
    handle(agent, tracked(0, candidate=True), 4 * MS)
    tell(agent, correction(pose(1), 1), 8 * MS)
    np.testing.assert_array_equal(in_force(agent, 50 * MS), pose(1))


def test_a_late_correction_of_an_earlier_segment_is_ignored() -> None:
    agent = corrected_agent()
    handle(agent, tracked(4, pose(0), candidate=True, new_stretch=True), 200 * MS)
    tell(agent, m.Ack(2), 210 * MS)  # the edge has a keyframe of the new one
    tell(agent, correction(pose(1), 1), 220 * MS)
    assert in_force(agent, 250 * MS) is None


def test_round_trip_and_time_to_the_keyframe_are_reported_smoothed() -> None:
    """Their sum is the delay of the paper."""
    agent = welcomed()
    [ping] = [
        p for t in (1, 500) for p in only(m.Ping, handle(agent, ev.AgentTick(), t * MS), messages=True)
    ][-1:]
    tell(agent, m.Pong(ping.sequence, ping.sent_ns, 0, 0, SESSION), ping.sent_ns + 6 * MS)
    delays = []
    for k, took_ms in enumerate((11, 11, 91, 11), 20):
        handle(agent, tracked(k, pose(k), candidate=False), k * 50 * MS + 5 * MS)
        effects = handle(agent, tracked(k, pose(k), candidate=True), k * 50 * MS + took_ms * MS)
        delays += [told.rtt_ms + told.track_ms for told in only(m.Evaluation, effects, messages=True)]
    assert delays == pytest.approx([17.0, 17.0, 27.0, 25.75])


def test_a_correction_of_a_keyframe_resent_to_a_restarted_edge_is_no_latency() -> None:
    agent = corrected_agent()
    handle(agent, Connected(), 60 * S)
    tell(agent, m.Welcome(SESSION + 1, 0), 60 * S)
    tell(agent, m.Ack(1), 60 * S)
    [applied] = only(ev.CorrectionApplied, tell(agent, correction(pose(1), 1, answers=0), 60 * S))
    assert (applied.keyframe_id, applied.corrected_ms) == (0, None)


# ---------------------------------------------------------------- the end


def test_the_run_ends_after_all_acknowledgements() -> None:
    agent = welcomed()
    handle(agent, tracked(0, candidate=True), 0)
    assert not only(ev.CloseLink, handle(agent, ev.InputFinished(), 100 * MS))
    [ping] = only(m.Ping, handle(agent, ev.AgentTick(), 500 * MS), messages=True)
    assert not only(Keyframe, handle(agent, ev.AgentTick(), 1000 * MS), messages=True)  # on its way, it seems
    effects = tell(agent, m.Pong(ping.sequence, ping.sent_ns, 0, 0, SESSION), 1010 * MS)
    assert only(Keyframe, effects, messages=True)  # lost: resent meanwhile
    effects = tell(agent, m.Ack(1), 1100 * MS)
    assert isinstance(sent(effects)[-1], m.Bye)
    assert isinstance(effects[-1], ev.CloseLink)
    assert handle(agent, ev.AgentTick(), 2 * S) == []


def test_the_run_ends_after_finish_s_without_acknowledgements() -> None:
    agent = AgentProtocol(HELLO, Config())
    handle(agent, tracked(0, candidate=True), 0)
    handle(agent, ev.InputFinished(), S)
    stops = [t for t in range(1, 100) if only(ev.CloseLink, handle(agent, ev.AgentTick(), S + t * 100 * MS))]
    assert stops == [50]
    assert agent.report()["pending"] == 1


def test_the_run_ends_at_once_with_nothing_pending() -> None:
    effects = AgentProtocol(HELLO, Config()).handle(ev.InputFinished(), 0)
    assert isinstance(effects[-1], ev.CloseLink)
    assert not only(m.Bye, effects, messages=True)


def test_the_report_is_plain_data() -> None:
    report = corrected_agent().report()
    report |= report.pop("settle_s")
    assert all(value is None or type(value) in (int, float, str, bool) for value in report.values())
    assert (report["sent"], report["acknowledged"], report["pending"]) == (1, 1, 0)
    assert report["bytes_up"] > report["bytes_down"] > 0


def test_an_evaluation_includes_the_sigma_of_the_correction() -> None:
    agent = welcomed()
    [ping] = only(m.Ping, handle(agent, ev.AgentTick(), 500 * MS), messages=True)
    tell(agent, m.Pong(ping.sequence, ping.sent_ns, 0, 0, SESSION), 503 * MS)
    handle(agent, tracked(10, pose(3), candidate=True), 510 * MS)
    tell(agent, correction(pose(), 1, answers=0), 520 * MS)
    effects = handle(agent, tracked(11, pose(3), candidate=True), 560 * MS)
    [told] = only(m.Evaluation, effects, messages=True)
    # of one motion, after that of odometry in the map
    cov = se3.compose_cov(pose(3), COV, COV)
    assert told.error_cm == pytest.approx(100 * np.sqrt(np.trace(cov[3:, 3:])))


def test_each_keyframe_follows_its_evaluation() -> None:
    """The edge sees by that how long the keyframe takes, also of one that was held."""
    agent = AgentProtocol(HELLO, Config())
    handle(agent, ev.AgentTick(), 0)
    effects = tell(agent, m.Welcome(SESSION, 0, 200.0), MS)
    [ping] = only(m.Ping, effects, messages=True)
    tell(agent, m.Pong(ping.sequence, ping.sent_ns, 0, 0, SESSION), 8 * MS)
    handle(agent, tracked(0, pose(0), candidate=True), 10 * MS)
    messages = sent(handle(agent, ev.AgentTick(), 205 * MS))
    messages += sent(handle(agent, tracked(1, pose(1), candidate=True), 300 * MS))
    before = [(a, b.id) for a, b in pairwise(messages) if isinstance(b, Keyframe)]
    assert [(evaluation.keyframe, k) for evaluation, k in before] == [(0, 0), (1, 1)]


def test_a_keyframe_that_the_link_refuses_does_not_count_as_sent() -> None:
    """Neither bytes nor keyframes count, however often the link refuses them."""
    agent, now, tried = welcomed(), 0, 0
    bytes_up = agent.report()["bytes_up"]
    effects = handle(agent, tracked(0, candidate=True), now)
    while tried < 3:
        for effect in only(SendToEdge, effects):
            tried += effect.keyframe_id == 0
            assert not only(SendToEdge, handle(agent, ev.SendFailed(effect), now))
        now += 100 * MS
        effects = tell(agent, m.Ack(0), now)  # it is there, but its queue is full
    told = agent.report()
    assert (told["sent"], told["resent"], told["bytes_up"]) == (0, 0, bytes_up)
    assert (told["keyframes"], told["unacknowledged"]) == (1, 1)
    while not (keyframes := [s for s in only(SendToEdge, effects) if s.keyframe_id == 0]):
        now += 100 * MS
        effects = tell(agent, m.Ack(0), now)
    told = agent.report()
    assert (told["sent"], told["resent"]) == (1, 0)
    assert told["bytes_up"] >= bytes_up + message_bytes(keyframes[0].frames)
    tell(agent, m.Ack(1), now)
    assert agent.report()["unacknowledged"] == 0
