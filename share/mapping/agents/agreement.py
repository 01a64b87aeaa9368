"""Which agents agree on scale, calibration and covariances, and which must not affect others' maps.

Every two agents are compared by the loops between them (`share.mapping.agents.pairwise`), by all loops and by
the newest, since an agent may become wrong. A disagreement is a difference that is significant and large
enough to matter. Among several agents the one that disagrees with most is quarantined, as in pairwise
consistency (Mangelson et al., ICRA 2018) with agents for loops. Of two agents it is undetermined which is
wrong; the pair is disputed, and each keeps its own map. All runs of a name are one agent here
(`share.mapping.agents.identities`).
"""

from __future__ import annotations

from collections.abc import Collection, Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from share.event_kinds import EventKind
from share.mapping.agents.agent_pair import AgentPair
from share.mapping.agents.covariance_scales import CovarianceScales, SegmentPair
from share.mapping.agents.identities import AgentIdentities, outvoted_agents
from share.mapping.agents.pairwise import AccumulatedOdometry, InterAgentLoop
from share.mapping.graph.edges import PoseEdge
from share.mapping.recognition.depth_scale import DepthScale
from share.types import F64

_APPLY_SIGMAS = 2.5  # significance at which a scale is corrected
_KEEP_SIGMAS = 1.25  # significance down to which it stays corrected
_MIN_SCALE_CHANGE = 0.001  # log scale
_EVENTS: dict[str, EventKind] = {  # by state
    "quarantined": "agent quarantined",
    "disputed": "agents disputed",
}


@dataclass(frozen=True)
class AgentConsistency:
    """How an agent agrees with the others, as reported.

    state: `agrees`, `quarantined`, `disputed` or `unknown`. log_scale, sigma: of its depths relative to the
    others'; corrected_log_scale: the part that is corrected. nis: of its loops, see
    `share.mapping.agents.pairwise`; None where unknown. severity: of its worst contradiction with another
    agent; a disagreement begins at 1. covariance_scale: factor on the variances of its odometry, which it
    understates.
    """

    state: str = "unknown"
    reason: str = ""
    log_scale: float | None = None
    sigma: float | None = None
    corrected_log_scale: float = 0.0
    nis: float | None = None
    severity: float = 0.0
    covariance_scale: float = 1.0

    @property
    def event(self) -> tuple[EventKind, str]:
        """Event and reason to report when this standing is new."""
        if self.state in _EVENTS:
            return _EVENTS[self.state], self.reason
        return "quarantine lifted", "consistent with the others again"


AgentNames = tuple[str, str]


class AgentAgreement:
    """Agreement of all agents, which are given by their runs.

    quarantined: agents that must not affect others. disputed: pairs in which it is undetermined which is
    wrong. log_scales: log of how much too long each agent's metres are, where significant; else missing.
    pairs: comparisons of every two agents with loops, by their names.
    """

    def __init__(self) -> None:
        self.quarantined: frozenset[str] = frozenset()
        self.disputed: frozenset[frozenset[str]] = frozenset()
        self.log_scales: dict[str, float] = {}
        self.identities = AgentIdentities()
        self.covariance_scales = CovarianceScales()
        self._accumulated: dict[int, AccumulatedOdometry] = {}
        self.pairs: dict[AgentNames, AgentPair] = {}

    def add_run(self, run: str, name: str, credential: str | None = "") -> None:
        """Register a run of the agent of this name; what is known of the name applies to it. credential: see
        `AgentIdentities.set_credential`.
        """
        self.identities.add_run(run, name, self.quarantined.union(*self.disputed), credential)

    def add_step(self, run: str, node_id: int, previous_id: int | None, T_ref_body: F64, cov: F64) -> bool:
        """Add a node, by odometry from the previous one; None: it begins a segment. Return whether scales may
        have changed."""
        previous = None if previous_id is None else self._accumulated.get(previous_id)
        self._accumulated[node_id] = (
            AccumulatedOdometry.origin() if previous is None else previous.with_step(T_ref_body, cov)
        )
        if previous_id is None:
            return False
        return self.covariance_scales.add_step(self.identities.identity(run), T_ref_body, cov)

    def log_scale(self, run: str) -> float:
        """Log of how much too long the run's metres are, where significant; else 0."""
        return self.log_scales.get(self.identities.identity(run), 0.0)

    def covariance_scale(self, run: str) -> float:
        """Factor on the variances of the run's odometry."""
        return self.covariance_scales.scales.get(self.identities.identity(run), 1.0)

    def scaled_runs(self) -> set[str]:
        """Return the runs of agents that have a log scale or a covariance scale."""
        agents = self.log_scales.keys() | self.covariance_scales.scales.keys()
        return {run for agent in agents for run in self.identities.runs(agent)}

    def remove_nodes(self, node_ids: Collection[int], live: Container[int]) -> None:
        """Remove nodes. live: segments that still have nodes; see `AgentPair.end_segments` for the loops of
        others.
        """
        for node_id in node_ids:
            self._accumulated.pop(node_id, None)
        ended = set[SegmentPair]().union(*[pair.end_segments(live) for pair in self.pairs.values()])
        self.covariance_scales.drop_evidence(sorted(ended))

    def remove_run(self, run: str) -> None:
        """Forget a run that will not return; after an agent's last run only suspicion of its name stays."""
        removed = self.identities.remove_run(run, self.quarantined, frozenset[str]().union(*self.disputed))
        if removed is None:
            return
        self.pairs = {names: pair for names, pair in self.pairs.items() if removed not in names}
        self.quarantined -= {removed}
        self.disputed = frozenset(names for names in self.disputed if removed not in names)
        self.log_scales.pop(removed, None)
        self.covariance_scales.remove_agent(removed)

    def add_loop(
        self,
        run_keys: tuple[str, str],
        segments: tuple[int, int],
        edge: PoseEdge,
        scale: DepthScale | None,
        tilt: tuple[float, float] | None,
    ) -> bool:
        """Add a verified loop between two agents' runs; `edge` connects its nodes.

        scale, tilt: see `InterAgentLoop`. Returns whether the quarantined or disputed agents have changed.
        """
        first, second = (self.identities.identity(run) for run in run_keys)
        if self.identities.name(first) == self.identities.name(second):
            return False
        if first > second:
            first, second, segments, edge = second, first, segments[::-1], edge.reverse()
            scale = None if scale is None else scale.reverse()
        pair = self.pairs.setdefault((first, second), AgentPair())
        self.covariance_scales.stated.link(first, second)
        a, b = self._accumulated[edge.a], self._accumulated[edge.b]
        if not pair.add_loop(segments, InterAgentLoop(a, b, edge.T_a_b, edge.cov, scale, tilt)):
            return False
        did_disagree = pair.disagrees
        self._compare(pair, (first, second), segments)
        changed = self._update_quarantine() if pair.disagrees or did_disagree else False
        self._update_scales()
        return changed

    def separation_reason(self, first_runs: Collection[str], second_runs: Collection[str]) -> str:
        """Why these agents must not share a map with those; empty if they may."""
        for a in map(self.identities.identity, first_runs):
            for b in map(self.identities.identity, second_runs):
                if a != b and ({a, b} & self.quarantined or frozenset((a, b)) in self.disputed):
                    return f"{a} and {b} are kept in separate maps"
        return ""

    def are_separated(self, first: str, second: str) -> bool:
        """Return whether these runs must be in separate maps."""
        return bool(self.separation_reason([first], [second]))

    def unverified_reason(self, first_runs: Collection[str], second_runs: Collection[str]) -> str:
        """Why an agent must be compared before these share a map with those; empty if none must."""
        identities = {self.identities.identity(run) for run in (*first_runs, *second_runs)}
        unverified = self.identities.unverified & identities if len(identities) > 1 else set[str]()
        return (
            f"{min(unverified)} must be compared first: {self._unverified_cause(min(unverified))}"
            if unverified
            else ""
        )

    def standing(self, run: str) -> AgentConsistency:
        """Return how the run's agent agrees with the others."""
        return self.standings([run])[run]

    def standings(self, runs: Sequence[str]) -> dict[str, AgentConsistency]:
        """Return how the agents of these runs agree with the others."""
        pairs_by_agent: dict[str, dict[AgentNames, AgentPair]] = {}
        for names, pair in self.pairs.items():
            for agent in names:
                pairs_by_agent.setdefault(agent, {})[names] = pair
        agents, scales = {run: self.identities.identity(run) for run in runs}, self._estimate_scales()
        known = {
            agent: self._standing(agent, pairs_by_agent.get(agent, {}), scales.get(agent, (None, None)))
            for agent in dict.fromkeys(agents.values())
        }
        return {run: known[agent] for run, agent in agents.items()}

    def _standing(
        self,
        agent: str,
        pairs: Mapping[AgentNames, AgentPair],
        scale: tuple[float, float] | tuple[None, None],
    ) -> AgentConsistency:
        """pairs: those with this agent. scale: log scale and sigma of its depths."""
        disagreeing = [(names, pair) for names, pair in pairs.items() if pair.disagrees]
        nis = max((pair.nis for pair in pairs.values() if pair.nis is not None), default=None)
        log, sigma = scale
        state = "agrees" if any(pair.agrees for pair in pairs.values()) else "unknown"
        reason = ""
        if agent in self.quarantined:
            state, reason = "quarantined", _contradiction_text(agent, disagreeing) + ": check its calibration"
        elif any(frozenset(names) in self.disputed for names, _ in disagreeing):
            state, reason = (
                "disputed",
                f"{_contradiction_text(agent, disagreeing)}; undetermined which of the two is wrong",
            )
        elif agent in self.identities.unverified:
            state, reason = "unknown", f"not compared with the others yet: {self._unverified_cause(agent)}"
        worst = max((pair.severity for pair in pairs.values()), default=0.0)
        return AgentConsistency(
            state,
            reason,
            log,
            sigma,
            self.log_scales.get(agent, 0.0),
            nis,
            worst,
            self.covariance_scales.scales.get(agent, 1.0),
        )

    def _unverified_cause(self, unverified: str) -> str:
        if unverified in self.identities.suspected:
            return "an earlier run of its name was kept in a separate map"
        return "the edge has restarted"

    def _compare(self, pair: AgentPair, names: AgentNames, segment_pair: SegmentPair) -> None:
        min_scale = self.covariance_scales.stated.min_scale
        equations = pair.compare(segment_pair, (min_scale(names[0]), min_scale(names[1])))
        if pair.disagrees:
            self.covariance_scales.drop_evidence(pair.by_segments)
            return
        self._mark_verified(pair, names)
        comparison = pair.by_segments[segment_pair].comparison
        if equations is not None and comparison is not None and not self.quarantined & {*names}:
            with suppress(np.linalg.LinAlgError):  # absurd numbers are no evidence
                self.covariance_scales.set_evidence(segment_pair, names, equations, comparison.weights)

    def _mark_verified(self, pair: AgentPair, names: AgentNames) -> None:
        """Mark agents of the pair as compared, unless the other is itself suspect.

        An earlier run of a suspected name may have had a wrong path, so depths alone are not enough for it.
        """
        for one, other in (names, names[::-1]):
            was_suspected = one in self.identities.suspected
            is_suspect = other in self.quarantined or (was_suspected and other in self.identities.unverified)
            if not is_suspect and (pair.has_path_comparison or (pair.agrees and not was_suspected)):
                self.identities.mark_verified(one)

    def _update_quarantine(self) -> bool:
        """Recompute the quarantined and disputed agents; return whether they changed.

        Quarantined are those outvoted under every assumption on unknown credentials. Agents with a
        quarantined earlier run are suspects.
        """
        disagreeing = {frozenset(names) for names, pair in self.pairs.items() if pair.disagrees}
        agreeing = [names for names, pair in self.pairs.items() if pair.agrees]
        agents = {name for names in self.pairs for name in names}
        suspects = {name for name in agents if self.identities.had_quarantined_run(name, self.quarantined)}
        quarantined = frozenset(agents)
        for credentials in self.identities.credential_hypotheses(agents):
            if quarantined:  # else the result stays empty
                quarantined &= outvoted_agents(disagreeing, agreeing, credentials, suspects)
        previous = self.quarantined, self.disputed
        self.quarantined = quarantined
        self.disputed = frozenset(names for names in disagreeing if not names & quarantined)
        self.covariance_scales.exclude(quarantined)
        return previous != (self.quarantined, self.disputed)

    def _update_scales(self) -> None:
        """Update the significant log scales. Separated agents are left out, since their maps are separate."""
        separated = self.quarantined.union(*self.disputed)
        known = self._estimate_scales(separated)
        for agent in sorted(known.keys() | self.log_scales.keys()):
            log, sigma = known.get(agent, (0.0, 1.0))
            previous = self.log_scales.get(agent, 0.0)
            new = log if abs(log) > (_KEEP_SIGMAS if previous else _APPLY_SIGMAS) * sigma else 0.0
            if abs(new - previous) > _MIN_SCALE_CHANGE:
                self.log_scales[agent] = new

    def _estimate_scales(self, excluded: Collection[str] = ()) -> Mapping[str, tuple[float, float]]:
        """Log scale of each agent's depths relative to the median of those not quarantined, with its sigma.

        Least squares over all pairs without an excluded agent.
        """
        estimates = (
            (names, pair.pooled_depth_scale)
            for names, pair in self.pairs.items()
            if not {*names} & {*excluded}
        )
        known = [(names, scale) for names, scale in estimates if scale is not None]
        agents = sorted({name for names, _ in known for name in names})
        if not agents:
            return {}
        column = {name: i for i, name in enumerate(agents)}
        J, z = np.zeros((len(known), len(agents))), np.zeros(len(known))
        for row, ((a, b), scale) in enumerate(known):
            J[row, column[a]], J[row, column[b]] = -1 / scale.sigma, 1 / scale.sigma
            z[row] = scale.value / scale.sigma
        inverse = np.linalg.pinv(J)
        x = inverse @ z
        by_credential = {
            self.identities.credential(agent): x[column[agent]]
            for agent in agents
            if agent not in self.quarantined
        }
        x -= np.median([*by_credential.values()] or x)  # one value per credential
        sigma = np.sqrt((inverse * inverse).sum(axis=1))  # z has unit variance
        return {name: (float(x[i]), float(sigma[i])) for name, i in column.items()}


def _contradiction_text(agent: str, disagreeing: list[tuple[AgentNames, AgentPair]]) -> str:
    """Text of the agent's contradictions in these pairs."""
    texts = []
    for (first, second), pair in disagreeing:
        other, text = (first, pair.reason_second) if agent == second else (second, pair.reason_first)
        texts.append(f"against {other} {text}")
    return "; ".join(texts)
