"""All runs of a name are one agent with one vote, except after suspicion."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.atlas_sim import Walker, near_loops

from share.config import MergeConfig
from share.geometry import se3
from share.mapping.agents.agreement import AgentAgreement
from share.mapping.agents.identities import AgentIdentities, outvoted_agents
from share.mapping.atlas import Atlas
from share.mapping.graph.edges import PoseEdge
from share.mapping.loop_acceptance import LoopDecision
from share.mapping.loops import KeyframeKey, Loop
from share.mapping.recognition.depth_scale import DepthScale

STEP = np.diag([2e-4**2] * 3 + [2e-3**2] * 3)
LOOP = np.diag([4e-3**2] * 3 + [0.02**2] * 3)
SIGMA = 0.004


class Town:
    """Runs with loops at one spot, one after the other."""

    def __init__(self) -> None:
        self.agreement, self.rng = AgentAgreement(), np.random.default_rng(3)
        self.numbers: dict[str, int] = {}

    def enter(self, run: str) -> None:
        """`eve-1` is a run of eve."""
        self.agreement.add_run(run, run.partition("-")[0])
        self.walk(run)

    def walk(self, run: str) -> None:
        self.numbers[run] = first = 1000 * len(self.numbers)
        step = se3.exp(np.array([0, 0, 0, 0.3, 0, 0]))
        for k in range(12):
            self.agreement.add_step(run, first + k, first + k - 1 if k else None, step, STEP)

    def meet(self, a: str, b: str, scale: float, times: int = 1) -> None:
        """scale: of b's depths relative to a's."""
        for _ in range(times):
            k = int(self.rng.integers(12))
            ends = self.numbers[a], self.numbers[b]
            log = np.log(scale) + SIGMA * self.rng.standard_normal()
            edge = PoseEdge(ends[0] + k, ends[1] + k, np.eye(4), LOOP)
            self.agreement.add_loop((a, b), ends, edge, DepthScale(log, SIGMA), None)


def with_a_wrong_agent():
    """Ann and bob agree; eve's scale is 5 % too large."""
    town = Town()
    for run in ("ann-1", "bob-1", "eve-1"):
        town.enter(run)
    town.meet("ann-1", "bob-1", 1.0, 6)
    for other in ("ann-1", "bob-1"):
        town.meet(other, "eve-1", 1.05, 4)
    return town


def test_loops_of_all_runs_of_a_name_count_as_those_of_one_agent():
    """Two loops with each of two others in each run: too few of any one run."""
    town = Town()
    for run in ("ann-1", "bob-1"):
        town.enter(run)
    town.meet("ann-1", "bob-1", 1.0, 6)
    for n in range(1, 4):
        town.enter(f"eve-{n}")
        for _ in range(2):
            for other in ("ann-1", "bob-1"):
                town.meet(other, f"eve-{n}", 1.05)
    for n in range(1, 4):
        assert town.agreement.separation_reason(["ann-1"], [f"eve-{n}"]) or town.agreement.unverified_reason(
            ["ann-1"], [f"eve-{n}"]
        )
    assert town.agreement.standing("eve-1").state == "quarantined"
    assert not town.agreement.separation_reason(["ann-1"], ["bob-1"])


@pytest.mark.parametrize("scale", [1.0, 1.05])
def test_a_new_run_of_a_quarantined_name_is_compared_before_it_joins(scale):
    town = with_a_wrong_agent()
    assert town.agreement.standing("eve-1").state == "quarantined"
    town.enter("eve-2")
    assert "earlier run" in town.agreement.standing("eve-2").reason
    assert "earlier run" in town.agreement.unverified_reason(["ann-1"], ["eve-2"])
    assert not town.agreement.unverified_reason(["eve-2"], ["eve-2"])  # its own segments
    for _ in range(10):
        for other in ("ann-1", "bob-1"):
            town.meet(other, "eve-2", scale)
    standing, honest = town.agreement.standing("eve-2"), town.agreement.standing("bob-1")
    assert honest.state == "agrees"
    assert town.agreement.standing("eve-1").state == "quarantined"
    if scale == 1.0:
        assert standing.state == "agrees"
        assert not town.agreement.unverified_reason(["ann-1"], ["eve-2"])
        assert not town.agreement.separation_reason(["ann-1"], ["eve-2"])
    else:
        assert standing.state == "quarantined"
        assert town.agreement.separation_reason(["ann-1"], ["eve-2"])


def test_of_two_that_disagree_the_one_with_a_quarantined_run_is_quarantined():
    town = with_a_wrong_agent()
    town.enter("eve-2")
    town.meet("bob-1", "eve-2", 1.05, 5)
    assert town.agreement.standing("eve-2").state == "quarantined"
    assert town.agreement.standing("bob-1").state == "agrees"


def test_runs_of_one_name_have_one_vote():
    town = Town()
    town.enter("ann-1")
    for n in range(1, 5):
        town.enter(f"eve-{n}")
        town.meet("ann-1", f"eve-{n}", 1.05, 8)
    assert town.agreement.standing("ann-1").state == "disputed"
    assert not town.agreement.quarantined


def test_a_new_run_of_a_name_inherits_its_scale():
    town = Town()
    for run in ("ann-1", "bob-1", "eve-1"):
        town.enter(run)
    for _ in range(12):
        for a, b, scale in (("ann-1", "bob-1", 1.0), ("bob-1", "eve-1", 0.99), ("ann-1", "eve-1", 0.99)):
            town.meet(a, b, scale)
    town.enter("eve-2")
    assert town.agreement.log_scale("eve-2") == town.agreement.log_scale("eve-1")
    assert town.agreement.log_scale("eve-2") == pytest.approx(np.log(0.99), abs=0.004)


def test_an_agent_that_becomes_wrong_is_detected_by_its_newest_loops():
    """After thirty correct loops, by fewer wrong ones."""
    town = Town()
    for run in ("ann-1", "bob-1", "eve-1"):
        town.enter(run)
    for _ in range(30):
        for a, b in (("ann-1", "bob-1"), ("ann-1", "eve-1"), ("bob-1", "eve-1")):
            town.meet(a, b, 1.0)
    assert town.agreement.standing("eve-1").state == "agrees"
    loops = 0
    while town.agreement.standing("eve-1").state != "quarantined" and loops < 40:
        loops += 1
        for other in ("ann-1", "bob-1"):
            town.meet(other, "eve-1", 1.05)
    assert loops <= 12
    assert not town.agreement.separation_reason(["ann-1"], ["bob-1"])


def test_restored_runs_outside_the_largest_map_are_an_unverified_identity():
    identities = AgentIdentities()
    for run, name in (("eve-1", "eve"), ("eve-2", "eve"), ("ann-1", "ann"), ("eve-3", "eve")):
        identities.add_run(run, name, ())
    identities.mark_unverified({"eve-1", "eve-3"})
    assert identities.identity("eve-3") == identities.identity("eve-1") != identities.identity("eve-2")
    assert identities.unverified == {identities.identity("eve-1")}
    assert identities.name("eve-2") == identities.name("eve-3") == "eve"
    identities.add_run("eve-4", "eve", ())
    assert identities.identity("eve-4") in identities.unverified


def test_loops_of_an_unverified_run_are_not_accepted_before_it_is_compared():
    """In the atlas: loops of the newest run of a quarantined name move no map."""
    ann, bob = Walker("ann", 1), Walker("bob", 2, phase=0.3)
    first, second = Walker("eve-1", 3, phase=0.7), Walker("eve-2", 4, phase=0.7)
    atlas, rng = Atlas(MergeConfig()), np.random.default_rng(0)
    for walker in (ann, bob, first):
        atlas.add_run(walker.name, walker.name.partition("-")[0])
        for keyframe in walker.keyframes:
            atlas.add_keyframe(walker.name, keyframe)
    for a, b, log in ((ann, bob, 0.0), (ann, first, 0.05), (bob, first, 0.05)):
        for loop in near_loops(a, b, rng):
            atlas.quarantine.add_loop(loop, DepthScale(log, 0.005))
    assert atlas.quarantine.agreement.standing("eve-1").state == "quarantined"
    atlas.add_run("eve-2", "eve")
    for keyframe in second.keyframes:
        atlas.add_keyframe("eve-2", keyframe)
    said = [atlas.propose(loop) for loop in near_loops(ann, second, rng)[:6]]
    assert not any(decision.accepted for decision in said)
    assert all("an earlier run of its name" in decision.reason for decision in said)


def test_a_quarantined_agent_does_not_affect_the_scales_of_others():
    """Ann and bob have loops with eve only, whose depths became wrong: theirs cannot be compared."""
    town = Town()
    for run in ("ann-1", "bob-1", "eve-1"):
        town.enter(run)
    town.meet("ann-1", "eve-1", 1.05, 30)
    town.meet("bob-1", "eve-1", 1.0, 10)
    town.meet("bob-1", "eve-1", 1.05, 30)
    assert town.agreement.standing("eve-1").state == "quarantined"
    assert town.agreement.log_scale("ann-1") == town.agreement.log_scale("bob-1") == 0.0


def test_removing_one_run_keeps_what_is_known_of_its_name():
    identities = AgentIdentities()
    for number in range(1, 4):
        identities.add_run(f"eve-{number}", "eve", ())
    assert [identities.remove_run(f"eve-{number}", (), ()) for number in (1, 2)] == [None, None]
    identities.add_run("eve-4", "eve", ())
    assert identities.identity("eve-4") == "eve-1"
    assert (identities.name("eve-1"), identities.newest_run("eve-1")) == ("eve", "eve-4")
    assert [identities.remove_run(f"eve-{number}", (), ()) for number in (3, 4)] == [None, "eve-1"]
    identities.add_run("eve-5", "eve", ())
    assert (identities.identity("eve-5"), identities.unverified) == ("eve-5", set())


def test_suspicion_of_a_name_outlives_its_runs():
    identities = AgentIdentities()
    identities.add_run("eve-1", "eve", ())
    assert identities.remove_run("eve-1", {"eve-1"}, ()) == "eve-1"
    for number in range(2, 5):
        identities.add_run(f"eve-{number}", "eve", ())
        assert identities.unverified == {f"eve-{number}"}
        assert f"eve-{number}" in identities.suspected
        assert identities.had_quarantined_run(f"eve-{number}", ())
        identities.remove_run(f"eve-{number}", (), ())
    assert not identities.unverified
    identities.add_run("eve-9", "eve", ())
    identities.mark_verified("eve-9")  # it was compared, and agrees
    identities.remove_run("eve-9", (), ())
    identities.add_run("eve-10", "eve", ())
    assert not identities.unverified


def test_any_number_of_removed_runs_leaves_only_the_suspicion():
    """Each run of eve disagreed with ann and is removed with its keyframes."""
    ann, atlas, rng = Walker("ann", 1, n=20), Atlas(MergeConfig()), np.random.default_rng(0)
    atlas.add_run("ann", "ann")
    for keyframe in ann.keyframes:
        atlas.add_keyframe("ann", keyframe)
    agreement = atlas.quarantine.agreement
    for n in range(1, 6):
        eve = Walker(f"eve-{n}", n, n=20, phase=0.1)
        atlas.add_run(eve.name, "eve")
        assert agreement.identities.unverified == ({eve.name} if n > 1 else set())
        numbers = [atlas.add_keyframe(eve.name, keyframe) for keyframe in eve.keyframes]
        for loop in near_loops(ann, eve, rng):
            atlas.quarantine.add_loop(loop, DepthScale(0.05, 0.005))
        assert atlas.quarantine.agreement.standing("ann").state == "disputed"
        atlas.set_present(eve.name, False)
        atlas.add_run("eve-next", "eve")
        atlas.remove_keyframes(numbers)
        assert atlas.is_run_gone(eve.name)
        atlas.remove_run(eve.name)
        atlas.set_present("eve-next", False)
        atlas.remove_run("eve-next")
        assert not agreement.pairs
        assert not agreement.disputed
        assert agreement.covariance_scales.stated.known_agents == {"ann"}
        assert atlas.quarantine.agreement.standing("ann").state == "unknown"


def test_a_disagreement_outlives_the_keyframes_that_showed_it():
    """Two loops with each of many runs of bob, whose segments are removed one after the other."""
    town = Town()
    town.enter("ann-1")
    for n in range(1, 30):
        town.enter(f"bob-{n}")
    for n in range(1, 30):
        town.meet("ann-1", f"bob-{n}", 1.05, 2)
        first = town.numbers[f"bob-{n}"]
        town.agreement.remove_nodes(range(first, first + 12), {town.numbers["ann-1"]})
        assert bool(town.agreement.disputed) == (n > 1)
    (pair,) = town.agreement.pairs.values()
    assert len(pair.by_segments) == 1
    assert sum(len(met.loops) for met in pair.by_segments.values()) <= 32


def test_the_covariance_evidence_of_a_segment_is_removed_with_it():
    ann, bob = Walker("ann", 1), Walker("bob-1", 2, phase=0.3)
    atlas, rng = Atlas(MergeConfig()), np.random.default_rng(0)
    for walker in (ann, bob):
        atlas.add_run(walker.name, walker.name.partition("-")[0])
        for keyframe in walker.keyframes:
            atlas.add_keyframe(walker.name, keyframe)
    for loop in near_loops(ann, bob, rng, every=2):
        atlas.quarantine.add_loop(loop, DepthScale(0.0, 0.005))
    agreement = atlas.quarantine.agreement
    (pair,) = agreement.pairs.values()
    assert agreement.covariance_scales.evidence.keys() == pair.by_segments.keys() == {(0, 1)}
    atlas.set_present("bob-1", False)
    atlas.add_run("bob-2", "bob")
    gone = [n for n in range(len(atlas)) if atlas.key(n).agent == "bob-1"]
    assert len(atlas.remove_keyframes(gone)) == len(gone)
    assert not agreement.covariance_scales.evidence
    assert (0, 1) not in pair.by_segments
    assert atlas.quarantine.agreement.standing("ann").state == "agrees"


def test_two_unverified_agents_of_a_restored_map_verify_each_other():
    """Both were alone in their maps; there is no third agent."""
    town = Town()
    for run in ("ann-1", "bob-1"):
        town.enter(run)
    town.agreement.identities.mark_unverified({"ann-1", "bob-1"})
    for run in ("ann-2", "bob-2"):
        town.enter(run)
    assert "edge has restarted" in town.agreement.unverified_reason(["ann-2"], ["bob-2"])
    town.meet("ann-2", "bob-2", 1.0, 10)
    assert not town.agreement.unverified_reason(["ann-2"], ["bob-2"])


def test_names_of_one_key_have_one_vote():
    """Three names have the key of eve and a wrong scale; ann and bob agree."""
    for voice, apart in (("eve", {"e1-1", "e2-1", "e3-1"}), ("", None)):
        town = Town()
        for run in ("ann-1", "bob-1"):
            town.enter(run)
        for run in ("e1-1", "e2-1", "e3-1"):
            town.agreement.add_run(run, run[:2], voice)
            town.walk(run)
        town.meet("ann-1", "bob-1", 1.0, 12)
        for run in ("e1-1", "e2-1", "e3-1"):
            for honest in ("ann-1", "bob-1"):
                town.meet(honest, run, 1.05, 12)
        assert apart is None or town.agreement.quarantined == apart
        assert not apart or not town.agreement.separation_reason(["ann-1"], ["bob-1"])


def disagreeing_agents(known: dict[str, str], honest: tuple[str, ...] = ("ann",)) -> Town:
    """The names e1 and e2 have the key of eve and the same wrong scale. known: credentials; those of
    the others are unknown."""
    town = Town()
    names = (*honest, "e1", "e2")
    for name in names:
        town.agreement.add_run(f"{name}-1", name, known.get(name))
        town.walk(f"{name}-1")
    for k, one in enumerate(names):
        for other in names[k + 1 :]:
            scale = 1.05 if (one in honest) != (other in honest) else 1.0
            town.meet(f"{one}-1", f"{other}-1", scale, 12)
    return town


@pytest.mark.parametrize(
    "known", [{}, {"ann": "A"}, {"ann": "A", "e1": "E"}, {"e1": "E"}, {"ann": "A", "e1": "E", "e2": "E"}]
)
def test_unknown_credentials_may_all_be_the_same(known):
    """Ann disagrees with two names of one key, also before the key is known."""
    town = disagreeing_agents(known)
    assert not town.agreement.quarantined
    assert town.agreement.standing("ann-1").state == "disputed"


def test_an_agent_outvoted_under_every_hypothesis_is_quarantined_at_once():
    known = {"ann": "A", "bob": "B", "e1": "E", "e2": "E"}
    assert disagreeing_agents(known, ("ann", "bob", "cat")).agreement.quarantined == {"e1-1", "e2-1"}
    town = disagreeing_agents({"e1": "E"}, ("ann", "bob"))  # which may have the key too
    assert not town.agreement.quarantined


def test_a_credential_counts_from_when_it_is_known():
    town = disagreeing_agents({"ann": "A"})
    town.agreement.add_run("e1-1", "e1", "E")
    town.agreement.add_run("e2-1", "e2", "F")
    town.meet("ann-1", "e1-1", 1.05, 12)
    assert town.agreement.quarantined == {"ann-1"}  # against two
    town.agreement.add_run("e2-1", "e2", "E")
    town.meet("ann-1", "e1-1", 1.05, 12)
    assert not town.agreement.quarantined


def test_names_of_one_key_that_disagree_are_disputed():
    """No other agent has a vote: the search ends."""
    assert outvoted_agents([frozenset("ab")], [], dict.fromkeys("ab", "E"), ()) == frozenset()
    assert outvoted_agents([frozenset("ab"), frozenset("ac")], [], {"a": "E", "b": "E", "c": "C"}, "a") == {
        "a"
    }


def pair_with_withdrawn_loops(decide=None) -> tuple[Atlas, list[Loop]]:
    """An atlas of ann and bob with withdrawn loops; decide: replaces the decision on loops."""
    ann, bob = Walker("ann", 1), Walker("bob", 2, phase=0.3)
    atlas = Atlas(MergeConfig())
    for walker in (ann, bob):
        atlas.add_run(walker.name, walker.name)
        for keyframe in walker.keyframes:
            atlas.add_keyframe(walker.name, keyframe)
    loops = near_loops(ann, bob, np.random.default_rng(0))
    atlas.quarantine.withdrawn = list(loops)
    atlas.quarantine.schedule_withdrawn()
    if decide is not None:
        atlas.loop_acceptance.decide = decide
    return atlas, loops


def test_withdrawn_loops_wait_while_their_agents_are_kept_apart():
    """Bob is not separated any more, but unverified."""
    atlas, loops = pair_with_withdrawn_loops()
    quarantine, unverified = atlas.quarantine, atlas.quarantine.agreement.identities.unverified
    unverified.add("bob")
    change = quarantine.reconsider_withdrawn()
    assert not change.added
    assert not change.dropped
    unverified.clear()
    gone = Loop(KeyframeKey("ann", 99), loops[0].b, loops[0].T_a_b, loops[0].cov, 9)
    quarantine.withdrawn.append(gone)
    quarantine.schedule_withdrawn()
    changes = [quarantine.reconsider_withdrawn() for _ in loops]
    assert sum(len(change.added) for change in changes) > len(loops) / 2
    assert len(changes[0].added) < len(loops) / 2  # a few at a time
    assert not any(change.dropped for change in changes)
    assert not quarantine.withdrawn


def test_withdrawn_loops_are_decided_once_their_agents_are_compared():
    atlas, loops = pair_with_withdrawn_loops()
    atlas.quarantine.agreement.identities.unverified.add("bob")
    said = [atlas.quarantine.add_loop(loop, DepthScale(0.0, 0.005)) for loop in loops]
    assert "bob" not in atlas.quarantine.agreement.identities.unverified
    assert sum(len(parted.added) for parted in said) > len(loops) / 2
    assert not any(parted.standings for parted in said)


def test_a_decision_that_compares_many_views_is_the_last_of_its_turn():
    def decide(loop: Loop) -> LoopDecision:
        decided.append(loop)
        atlas.overlap_check.comparison_count += 40 * (loop is loops[1])
        return LoopDecision(False, "")

    decided: list[Loop] = []
    atlas, loops = pair_with_withdrawn_loops(decide)
    atlas.quarantine.reconsider_withdrawn()
    assert decided == loops[:2]
    atlas.quarantine.reconsider_withdrawn()
    assert decided == loops[:10]


def test_a_loop_added_again_and_undone_at_once_is_not_reported_as_added():
    def decide(loop: Loop) -> LoopDecision:
        return LoopDecision(True, "", None, (loop,), (loops[0],) if loop is loops[1] else ())

    atlas, loops = pair_with_withdrawn_loops(decide)
    change = atlas.quarantine.reconsider_withdrawn()
    assert change.added
    assert loops[0] not in change.added
    assert change.dropped == (loops[0],)


def test_scales_are_applied_in_the_order_of_names():
    """Independent of the hashes of their names."""
    atlas, done = Atlas(MergeConfig()), list[str]()
    names = [f"agent{k}" for k in range(10)]
    for name in names:
        atlas.add_keyframe(name, Walker(name, 1, n=1).keyframes[0])
    atlas.quarantine.agreement.log_scales = dict.fromkeys(names, 0.01)
    atlas.graph.rescale_odometry = lambda agent, log, width: done.append(agent)
    atlas.quarantine.apply_scales()
    assert done == names
