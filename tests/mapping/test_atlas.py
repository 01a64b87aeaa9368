import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.atlas_sim import Walker, answer, error, loop, near_loops, settle

from share.config import MergeConfig
from share.geometry import se3
from share.mapping import loop_acceptance, loop_consistency
from share.mapping.atlas import Atlas
from share.mapping.loop_consistency import LoopEvidence
from share.mapping.loops import KeyframeKey, Loop
from share.types import F64

pytestmark = pytest.mark.usefixtures("entered_at_once")

CONFIG = MergeConfig(join_places=5, enter_m=0.2)  # the loops of walkers are no surer
WRONG = se3.exp(np.array([0.0, 0.0, 0.5, 1.0, -0.7, 0.1]))


def atlas_of(*walkers: Walker, config: MergeConfig = CONFIG) -> Atlas:
    """An atlas with the keyframes of all walkers, in turn."""
    atlas = Atlas(config)
    for i in range(max(len(w.keyframes) for w in walkers)):
        for w in walkers:
            if i < len(w.keyframes):
                atlas.add_keyframe(w.name, w.keyframes[i])
    return atlas


def poses(atlas: Atlas, *walkers: Walker) -> F64:
    return np.array([atlas.pose(KeyframeKey(w.name, k.id)) for w in walkers for k in w.keyframes])


def truth(*walkers: Walker) -> F64:
    return np.concatenate([w.truth for w in walkers])


@pytest.fixture(autouse=True)
def strict_places(monkeypatch: pytest.MonkeyPatch) -> None:
    """As strict as copies of whole corridors require."""
    for name, value in (("NEAR_M", 1.0), ("NEAR_RAD", 0.52), ("PLACE_M", 0.7), ("PLACE_RAD", 0.5)):
        monkeypatch.setattr(loop_consistency, name, value)
    monkeypatch.setattr(loop_acceptance, "JOIN_FOUND", 0.45)


@pytest.fixture
def ann() -> Walker:
    return Walker("ann", 1)


@pytest.fixture
def bob() -> Walker:
    return Walker("bob", 2, phase=0.7)


def test_every_segment_is_a_map_until_merged(ann: Walker, bob: Walker) -> None:
    atlas = atlas_of(ann, bob)
    assert atlas.map_sizes() == {"ann/0": 60, "bob/0": 60}
    assert len(atlas) == 120
    assert atlas.solving.due_maps() == []
    assert atlas.T_map_odom("bob") == pytest.approx(np.eye(4), abs=1e-9)
    assert atlas.T_map_odom("nobody") is None


def test_maps_of_two_agents_merge_at_their_true_poses(ann: Walker, bob: Walker) -> None:
    atlas = atlas_of(ann, bob)
    rng = np.random.default_rng(0)
    decisions, applied = [], []
    for x in near_loops(ann, bob, rng) + near_loops(bob, bob, rng):
        decisions.append(atlas.propose(x))
        applied += settle(atlas)
    assert "would merge two maps, 1 of 5 required places agree: pending" in decisions[0].reason
    joining = [k for k, d in enumerate(decisions) if d.joined_maps]
    assert joining == [4]  # every one of these loops is at a place of its own
    assert decisions[4].joined_maps == ("ann/0", "bob/0")
    assert not any(d.accepted for d in decisions[:4])
    assert len(decisions[4].added) == 5
    assert all(d.accepted for d in decisions[4:])
    before = error(np.array(ann.T_odom_body), ann.truth), error(np.array(bob.T_odom_body), bob.truth)
    assert applied[-1].corrections.keys() == {"ann", "bob"}
    after = error(poses(atlas, ann, bob), truth(ann, bob))
    assert after < 0.06
    assert after < max(before)


def test_the_gauge_of_the_reference_segment_never_moves(ann: Walker, bob: Walker) -> None:
    atlas = atlas_of(ann, bob)
    rng = np.random.default_rng(0)
    for x in near_loops(bob, ann, rng) + near_loops(ann, ann, rng):
        atlas.propose(x)
        settle(atlas)
        T = se3.inverse(ann.T_odom_body[0]) @ atlas.pose(KeyframeKey("ann", 0))
        assert np.array_equal(T[:3, 3], np.zeros(3))
        turned = np.degrees(se3.so3_log(T[:3, :3]))
        assert abs(turned[2]) < 1e-4 and np.abs(turned).max() < 0.5
        assert atlas.map_id(KeyframeKey("ann", 5)) == "ann/0"


def test_the_map_of_lower_rank_stays_however_old_the_other_is() -> None:
    """A robot comes first, then two headsets; their maps merge, then with that of the robot."""
    robot, ann, bob = Walker("robot", 1), Walker("ann", 0), Walker("bob", 2)
    atlas, rng = Atlas(CONFIG), np.random.default_rng(0)
    for walker in (robot, ann, bob):
        for keyframe in walker.keyframes:
            atlas.add_keyframe(walker.name, keyframe, rank=int(walker is robot))
    joined = [d.joined_maps for x in near_loops(ann, bob, rng) if (d := atlas.propose(x)).joined_maps]
    settle(atlas)
    before = atlas.T_map_odom("ann")
    joined += [d.joined_maps for x in near_loops(robot, bob, rng) if (d := atlas.propose(x)).joined_maps]
    applied = settle(atlas)[-1]
    assert joined == [("ann/0", "bob/0"), ("ann/0", "robot/0")]
    assert {c.map_id for c in applied.corrections.values()} == {"ann/0"}
    assert np.array_equal(atlas.pose(KeyframeKey("ann", 0))[:3, 3], ann.T_odom_body[0][:3, 3])
    moved = se3.log(se3.inverse(before) @ atlas.T_map_odom("ann"))
    assert np.abs(moved).max() < 0.05
    assert error(poses(atlas, robot, ann, bob), truth(robot, ann, bob)) < 0.08


def test_correction_brings_odometry_into_the_map(ann: Walker, bob: Walker) -> None:
    atlas = atlas_of(ann, bob)
    rng = np.random.default_rng(0)
    for x in near_loops(ann, bob, rng):
        atlas.propose(x)
    (applied,) = settle(atlas)
    correction = applied.corrections["bob"]
    last = KeyframeKey("bob", 59)
    assert correction.T_map_odom @ bob.T_odom_body[-1] == pytest.approx(atlas.pose(last), abs=1e-9)
    assert correction.T_map_odom == pytest.approx(atlas.T_map_odom("bob"))
    assert (correction.map_id, correction.revision, correction.answered_keyframe) == ("ann/0", 0, 56)
    assert applied.corrections["ann"].answered_keyframe == -1
    # uncertain is where bob is, to a few centimetres, not the distant origin of its odometry
    cov = se3.inverse_cov(se3.inverse(bob.T_odom_body[-1]), correction.cov)
    assert 0.001 < np.sqrt(np.trace(cov[3:, 3:])) < 0.2


@pytest.mark.long
def test_correction_covariance_is_not_too_small() -> None:
    """NEES of the newest pose of the second agent in the frame of the first. Odometry is half as uncertain
    as the atlas assumes, so that the mean is below 6; it must not be above."""
    nees = []
    for seed in range(25):
        a, b = Walker("a", 2 * seed, 30), Walker("b", 2 * seed + 1, 30, phase=0.3)
        atlas = atlas_of(a, b, config=replace(CONFIG, enter_m=1.0))  # published however uncertain
        for x in near_loops(a, b, np.random.default_rng(seed), every=2):
            atlas.propose(x)
        applied = settle(atlas)[-1]
        c = applied.corrections["b"]
        true_T = a.T_odom_body[0] @ se3.inverse(a.truth[0]) @ b.truth[-1]
        cov = se3.inverse_cov(se3.inverse(b.T_odom_body[-1]), c.cov)
        xi = se3.log(se3.inverse(c.T_map_odom @ b.T_odom_body[-1]) @ true_T)
        nees.append(xi @ np.linalg.solve(cov, xi))
    assert 0.8 < np.mean(nees) < 7.2


def test_a_wrong_loop_never_merges_maps(ann: Walker, bob: Walker) -> None:
    atlas = atlas_of(ann, bob)
    rng = np.random.default_rng(0)
    for i in range(6):
        turned = se3.exp(rng.normal(0, [0.4] * 3 + [1.0] * 3))
        decision = atlas.propose(loop(ann, 5 * i, bob, 7 * i, rng, turned))
        assert not decision.accepted
    good = [atlas.propose(x) for x in near_loops(ann, bob, rng)[:5]]
    assert [d.accepted for d in good] == [False] * 4 + [True]
    settle(atlas)
    assert len(tuple(atlas.graph.edges.loops.values())) == 5
    assert len(tuple(atlas.loop_acceptance.pending)) == 6


def test_small_maps_need_fewer_places_but_more_than_one_keyframe() -> None:
    """Both maps have two or three places."""
    ann, bob = Walker("ann", 1, 5, turn=0.5), Walker("bob", 2, 5, turn=0.5)
    rng = np.random.default_rng(0)
    atlas = atlas_of(ann, bob)
    assert "0 of 1 required places" in atlas.propose(far_loop(ann, 0, bob, 4, rng)).reason
    for i in (1, 2, 3):
        assert not atlas.propose(loop(ann, i, bob, 1, rng)).accepted
    assert atlas.propose(loop(ann, 1, bob, 2, rng)).joined_maps == ("ann/0", "bob/0")


def test_loops_of_distant_views_do_not_support_a_merge(
    ann: Walker, bob: Walker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They would merge the maps if such views counted as near."""
    rng = np.random.default_rng(0)
    far = [far_loop(ann, i, bob, i, rng) for i in range(0, 40, 4)]
    assert not any(atlas_of(ann, bob).propose(x).accepted for x in far)
    monkeypatch.setattr(loop_consistency, "NEAR_M", 9.0)
    monkeypatch.setattr(loop_consistency, "NEAR_RAD", 4.0)
    easy = atlas_of(ann, bob)
    assert any(easy.propose(x).accepted for x in far)


def test_a_wrong_loop_within_a_map_contradicts_it(ann: Walker) -> None:
    atlas = atlas_of(ann)
    rng = np.random.default_rng(0)
    right = near_loops(ann, ann, rng)[0]
    wrong = Loop(right.a, right.b, right.T_a_b @ se3.exp(np.array([0, 0, 1.5, 3, 0, 0])), right.cov, 80)
    decision = atlas.propose(wrong)
    assert not decision.accepted
    assert "contradicts the map" in decision.reason
    assert atlas.propose(right).accepted
    assert "have a loop already" in atlas.propose(right.reverse()).reason


def test_odometry_neighbours_make_no_loop(ann: Walker) -> None:
    atlas = atlas_of(ann)
    rng = np.random.default_rng(0)
    assert "neighbours by odometry" in atlas.propose(loop(ann, 20, ann, 29, rng)).reason
    assert atlas.propose(loop(ann, 20, ann, 30, rng)).accepted


def test_drift_beyond_the_covariance_needs_two_consistent_loops() -> None:
    ann = Walker("ann", 3, breaks=())
    bent = [
        replace(k, T_ref_body=k.T_ref_body @ se3.exp(np.array([0, 0, 0.08, 0, 0, 0]))) if k.id == 25 else k
        for k in ann.keyframes
    ]
    ann.keyframes = bent
    atlas = atlas_of(ann)
    rng = np.random.default_rng(0)
    across = [x for x in near_loops(ann, ann, rng, every=2) if x.a.id < 20 and x.b.id > 30]
    first, *others = (atlas.propose(x) for x in across)
    assert "fits the map badly" in first.reason
    assert not first.accepted
    assert any(d.accepted for d in others)
    drifted = error(poses(atlas, ann), ann.truth)
    settle(atlas)
    assert error(poses(atlas, ann), ann.truth) < 0.5 * drifted


def test_order_of_arrival_does_not_matter(ann: Walker, bob: Walker) -> None:
    rng = np.random.default_rng(0)
    loops = near_loops(ann, bob, rng) + near_loops(bob, bob, rng) + near_loops(ann, ann, rng)
    results = []
    for seed in range(4):
        atlas = atlas_of(ann, bob)
        for i in np.random.default_rng(seed).permutation(len(loops)):
            atlas.propose(loops[i])
        settle(atlas)
        settle(atlas)
        assert atlas.map_sizes().keys() == {"ann/0"}
        assert len(tuple(atlas.graph.edges.loops.values())) == len(loops)
        results.append(poses(atlas, ann, bob))
    for other in results[1:]:
        assert np.abs(other - results[0]).max() < 2e-3


def test_three_maps_merge_into_one(ann: Walker, bob: Walker) -> None:
    cyd = Walker("cyd", 5, phase=1.4)
    atlas = atlas_of(ann, bob, cyd)
    rng = np.random.default_rng(0)
    for x in near_loops(bob, cyd, rng):
        atlas.propose(x)
    settle(atlas)
    assert atlas.map_sizes().keys() == {"ann/0", "bob/0"}
    for x in near_loops(ann, bob, rng):
        atlas.propose(x)
    applied = settle(atlas)[-1]
    assert atlas.map_sizes().keys() == {"ann/0"}
    assert applied.corrections["cyd"].map_id == "ann/0"
    assert error(poses(atlas, ann, bob, cyd), truth(ann, bob, cyd)) < 0.08


def test_a_new_segment_is_a_map_of_its_own_and_merges_again() -> None:
    ann = Walker("ann", 1, breaks=(40,))
    atlas = atlas_of(ann)
    assert atlas.map_sizes() == {"ann/0": 40, "ann/1": 20}
    rng = np.random.default_rng(0)
    for x in (y for y in near_loops(ann, ann, rng) if y.b.id >= 40):
        atlas.propose(x)
    (applied,) = settle(atlas)
    assert atlas.map_sizes().keys() == {"ann/0"}
    assert applied.corrections.keys() == {"ann"}
    expected = atlas.pose(KeyframeKey("ann", 59))
    assert applied.corrections["ann"].T_map_odom @ ann.T_odom_body[-1] == pytest.approx(expected, abs=1e-9)
    assert error(poses(atlas, ann), ann.truth) < 0.06


def test_keyframes_that_arrive_while_solving_follow_the_solution(ann: Walker, bob: Walker) -> None:
    rng = np.random.default_rng(0)
    late = 45
    atlas = Atlas(CONFIG)
    for w in (ann, bob):
        for k in w.keyframes[:late]:
            atlas.add_keyframe(w.name, k)
    for x in near_loops(ann, bob, rng):
        if x.a.id < late and x.b.id < late:
            atlas.propose(x)
    result = answer(atlas, "ann/0")
    for k in bob.keyframes[late:]:
        atlas.add_keyframe("bob", k)
    applied = atlas.solving.apply(*result)
    rigid = se3.inverse(bob.T_odom_body[late - 1]) @ bob.T_odom_body[-1]
    assert se3.inverse(atlas.pose(KeyframeKey("bob", late - 1))) @ atlas.pose(
        KeyframeKey("bob", 59)
    ) == pytest.approx(rigid, abs=1e-9)
    assert applied.corrections["bob"].T_map_odom == pytest.approx(atlas.T_map_odom("bob"), abs=1e-9)


def test_a_solution_of_a_map_that_was_merged_meanwhile_is_discarded(ann: Walker, bob: Walker) -> None:
    atlas = atlas_of(ann, bob)
    rng = np.random.default_rng(0)
    for x in near_loops(bob, bob, rng):
        atlas.propose(x)
    result = answer(atlas, "bob/0")
    for x in near_loops(ann, bob, rng):
        atlas.propose(x)
    before = poses(atlas, ann, bob)
    applied = atlas.solving.apply(*result)
    assert applied.corrections == {}
    assert "merged or split" in applied.reason
    assert np.array_equal(poses(atlas, ann, bob), before)
    assert atlas.solving.due_maps() == ["ann/0"]
    assert settle(atlas)[0].corrections.keys() == {"ann", "bob"}


def far_loop(ann: Walker, i: int, bob: Walker, j: int, rng: np.random.Generator) -> Loop:
    """A true loop of views that are too far apart to support a merge."""
    x = loop(ann, i, bob, j, rng)
    assert np.linalg.norm(x.T_a_b[:3, 3]) > loop_consistency.NEAR_M
    return x


def twin_loops(ann: Walker, bob: Walker, count: int, found: float = 0.46) -> list[Loop]:
    """The room looks the same from the other side: turned by 180°, bob's path lies on ann's."""
    half = se3.exp(np.array([0, 0, np.pi, 0, 0, 0]))
    cov = loop(ann, 0, bob, 0, np.random.default_rng(0)).cov
    out = []
    for i in range(0, 4 * count, 4):
        j = i + 13
        T = se3.inverse(ann.truth[i]) @ half @ bob.truth[j]
        assert np.linalg.norm(T[:3, 3]) < loop_consistency.NEAR_M
        out.append(Loop(KeyframeKey("ann", i), KeyframeKey("bob", j), T, cov, 80, found))
    return out


def test_a_false_merge_is_undone_by_better_evidence(ann: Walker, bob: Walker) -> None:
    """Consistent false loops at many places do merge maps; later evidence undoes it."""
    atlas = atlas_of(ann, bob)
    false = twin_loops(ann, bob, 5)
    assert [atlas.propose(x).accepted for x in false] == [False] * 4 + [True]
    settle(atlas)
    true = [replace(x, found_share=0.62) for x in near_loops(ann, bob, np.random.default_rng(0))]
    first, second, third, fourth = [atlas.propose(x) for x in true[:4]]
    settle(atlas)
    others = []
    for x in true[4:]:
        others.append(atlas.propose(x))
        settle(atlas)
    assert "contradicts the map" in first.reason
    assert "1 places (weight 0.38) support it, 4 places needed" in first.reason
    assert not (first.dropped or second.dropped or third.dropped)
    assert set(fourth.dropped) == set(false)
    assert "loops removed: ann:0 - bob:13, ann:4 - bob:17" in fourth.reason
    assert fourth.joined_maps == ("ann/0", "bob/0")
    assert len(fourth.added) == 4
    assert all(d.accepted for d in others)
    settle(atlas)
    assert error(poses(atlas, ann, bob), truth(ann, bob)) < 0.06


def test_slightly_more_contradicting_weight_does_not_undo_a_merge(ann: Walker, bob: Walker) -> None:
    """Four places against five of nearly the same weight."""
    atlas = atlas_of(ann, bob)
    for x in twin_loops(ann, bob, 5):
        atlas.propose(x)
    settle(atlas)
    true = [replace(x, found_share=0.58) for x in near_loops(ann, bob, np.random.default_rng(0))]
    fourth = [atlas.propose(x) for x in true[:4]][-1]
    assert "4 places (weight 1.35) support it, 5 places (weight 1.06) oppose it" in fourth.reason
    assert not fourth.accepted


def test_along_an_aisle_and_its_copy_what_they_share_tells() -> None:
    """Of a copy more places agree the longer one walks."""
    true, copy = LoopEvidence(6, 0.62, 6), LoopEvidence(26, 0.48, 26)
    assert true.weight < copy.weight
    assert true.outweighs(copy, 1.4)
    assert not copy.outweighs(replace(true, places=15), 1.4)
    assert not LoopEvidence(3, 0.62, 3).outweighs(copy, 1.4)  # of too few places


def test_loops_of_copies_do_not_outweigh_true_loops(ann: Walker, bob: Walker) -> None:
    rng = np.random.default_rng(0)
    for found, overthrown in ((0.4, False), (0.7, True)):  # the second as a check that they could
        atlas = atlas_of(ann, bob)
        for x in near_loops(ann, bob, rng)[:6]:
            atlas.propose(replace(x, found_share=0.6))
        settle(atlas)
        decisions = [atlas.propose(x) for x in twin_loops(ann, bob, 8, found)]
        assert any(d.dropped for d in decisions) == overthrown
        assert (error(poses(atlas, ann, bob), truth(ann, bob)) < 0.08) != overthrown


def test_two_hypotheses_of_similar_weight_block_the_merge(ann: Walker, bob: Walker) -> None:
    true = near_loops(ann, bob, np.random.default_rng(0))[:5]
    for found, joined in ((0.45, False), (0.3, True)):
        atlas = atlas_of(ann, bob)
        for x in twin_loops(ann, bob, 4, found):
            assert not atlas.propose(x).accepted
        decisions = [atlas.propose(x) for x in true]
        assert decisions[-1].accepted == joined
        assert joined or "a competing hypothesis has 4 places" in decisions[-1].reason


def test_loops_with_a_low_found_share_merge_nothing(ann: Walker, bob: Walker) -> None:
    true = near_loops(ann, bob, np.random.default_rng(0))
    for found, joined in (
        (loop_acceptance.JOIN_FOUND - 0.01, False),
        (loop_acceptance.JOIN_FOUND + 0.01, True),
    ):
        atlas = atlas_of(ann, bob)
        decisions = [atlas.propose(replace(x, found_share=found)) for x in true]
        assert any(d.joined_maps for d in decisions) == joined
    assert "only 44% of the points in both views are found" in atlas_says(ann, bob, true, 0.44)


def atlas_says(ann: Walker, bob: Walker, loops: list[Loop], found: float) -> str:
    atlas = atlas_of(ann, bob)
    return [atlas.propose(replace(x, found_share=found)).reason for x in loops][-1]


def test_places_in_all_segments_of_a_map_count(ann: Walker, bob: Walker) -> None:
    """Cyd sees three places where ann has been and two where bob has."""
    cyd = Walker("cyd", 5, phase=1.4)
    atlas, rng = atlas_of(ann, bob, cyd), np.random.default_rng(0)
    for x in near_loops(ann, bob, rng)[:5]:
        atlas.propose(x)
    settle(atlas)
    seen = near_loops(ann, cyd, rng)[:3] + near_loops(bob, cyd, rng)[8:10]
    decisions = [atlas.propose(x) for x in seen]
    assert [d.accepted for d in decisions] == [False] * 4 + [True]
    assert "5 of 5 required places agree" in decisions[-1].reason
    assert re.match(
        r"map \S+ merged into \S+: keyframe \d+ of \S+ and keyframe \d+ of \S+ see the same place; 5 of 5",
        decisions[-1].reason,
    )
    assert atlas.map_sizes().keys() == {"ann/0"}


def test_a_loop_with_a_third_agent_makes_a_merge_no_weaker(ann: Walker, bob: Walker) -> None:
    """A copy has to outweigh the loops of ann and bob, and one of bob with cyd, who is in ann's map."""
    cyd = Walker("cyd", 5, phase=1.4)
    atlas, rng = atlas_of(ann, bob, cyd), np.random.default_rng(0)
    for x in near_loops(ann, bob, rng)[:8] + near_loops(ann, cyd, rng)[:8] + near_loops(bob, cyd, rng)[:1]:
        atlas.propose(x)
    settle(atlas)
    last = [atlas.propose(x) for x in twin_loops(ann, bob, 5)][-1]
    assert "8 places (weight 2.00) oppose it" in last.reason
    assert not last.accepted


def test_a_merge_needs_a_loop_by_which_images_align(ann: Walker, bob: Walker) -> None:
    """Descriptors of a flat scene may agree on a wrong pose; then no image does."""
    doubtful = [replace(x, is_confirmed=False) for x in near_loops(ann, bob, np.random.default_rng(0))[:7]]
    atlas = atlas_of(ann, bob)
    decisions = [atlas.propose(x) for x in doubtful[:6]]
    assert not any(d.accepted for d in decisions)
    assert "6 of 5 required places agree, but the images align by none: pending" in decisions[-1].reason
    sure = replace(doubtful[6], is_confirmed=True)
    assert atlas.propose(sure).joined_maps == ("ann/0", "bob/0")
    assert sure.reverse().is_confirmed and not doubtful[0].reverse().is_confirmed


def test_many_views_of_one_spot_are_one_place(ann: Walker, bob: Walker) -> None:
    atlas = atlas_of(ann, bob)
    spot = [loop(ann, i, bob, j, np.random.default_rng(i)) for i in (4, 5) for j in (0, 1, 2)]
    decisions = [atlas.propose(x) for x in spot]
    assert not any(d.accepted for d in decisions)
    assert all("2 of 5" in d.reason or "1 of 5" in d.reason for d in decisions)


def test_invalid_keyframes_loops_and_maps_are_refused_by_name(ann: Walker) -> None:
    atlas = atlas_of(ann)
    with pytest.raises(ValueError, match="ann:3 was added before"):
        atlas.add_keyframe("ann", ann.keyframes[3])
    with pytest.raises(ValueError, match="keyframe zoe:3 is not known"):
        atlas.add_keyframe("zoe", ann.keyframes[4])
    with pytest.raises(ValueError, match="keyframe ann:99 is not known"):
        atlas.propose(Loop(KeyframeKey("ann", 1), KeyframeKey("ann", 99), np.eye(4), np.eye(6), 50))
    with pytest.raises(ValueError, match="there is no map"):
        atlas.solving.make_job("zoe/0")


def test_an_outlier_loop_is_dropped_after_the_solution(
    ann: Walker, bob: Walker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop_acceptance, "AGREE_CHI2", 1e9)
    atlas = atlas_of(ann, bob)
    rng = np.random.default_rng(0)
    for x in near_loops(ann, bob, rng):
        atlas.propose(x)
    wrong = loop(ann, 30, bob, 8, rng, WRONG)
    assert atlas.propose(wrong).accepted
    reasons = [applied.reason for applied in settle(atlas)]
    assert "outlier loops removed: ann:30 - bob:8" in reasons[0]
    assert wrong not in tuple(atlas.graph.edges.loops.values())
    assert error(poses(atlas, ann, bob), truth(ann, bob)) < 0.06


def test_without_its_loops_a_merge_is_undone(ann: Walker, bob: Walker) -> None:
    """As if every loop between the two were an outlier of the solution."""
    atlas = atlas_of(ann, bob)
    rng = np.random.default_rng(0)
    for x in near_loops(ann, bob, rng):
        atlas.propose(x)
    job, solution = answer(atlas, "ann/0")
    applied = atlas.solving.apply(job, replace(solution, loop_chi2=np.full_like(solution.loop_chi2, 1e6)))
    assert atlas.map_sizes().keys() == {"ann/0", "bob/0"}
    assert applied.corrections["bob"].map_id == "bob/0"
    assert np.abs(atlas.pose(KeyframeKey("bob", 0)) - bob.T_odom_body[0]).max() < 1e-9
    assert atlas.solving.due_maps() == ["ann/0", "bob/0"]
    settle(atlas)
    assert not atlas.propose(near_loops(ann, bob, rng)[0]).accepted


def test_covariances_are_requested_for_agents_that_are_answered(ann: Walker, bob: Walker) -> None:
    """For others the published one stays, until they are in another map."""
    atlas = atlas_of(ann, bob)
    loops = near_loops(ann, bob, np.random.default_rng(0))
    for x in loops[:-1]:
        atlas.propose(x)
    first = settle(atlas)[-1]
    atlas.propose(loops[-1])
    job, solution = answer(atlas, "ann/0")
    assert job.covariance_segments == (atlas.graph.odometry.current_segment("bob"),)
    second = atlas.solving.apply(job, solution)
    assert (second.corrections["ann"].cov == first.corrections["ann"].cov).all()
    assert (second.corrections["bob"].cov != first.corrections["bob"].cov).any()
