"""Whose word a run's is: all runs of one name are one witness, as long as the name is not under suspicion.

So a headset that is restarted before it is found out is found out all the same, with all its runs; a name
counts once however often it came. A run that comes while its name is under suspicion is a subject of its own,
for it may have been calibrated anew; it is kept apart until it has been compared.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping

import numpy as np

from share.mapping.agents.pairwise import InterAgentLoop, ScalarEstimate
from share.mapping.graph.edges import PoseEdge
from share.types import F64

# ---- What is held against two agents: how severe it is, and in which words.
#
# A severity of 1 begins a disagreement. Each finding is (severity, of the second agent against the first, of
# the first against the second).

_MIN_SIGMAS = 4.5  # that a difference must have: of thousands of comparisons none by chance
_MAX_TILT_RAD = np.radians(1.0)  # rad, less does no harm
_MIN_LOOPS = 8  # loops before their ups say anything

Contradiction = tuple[float, str, str]


def tilt_between(
    up_a: F64, sigma_a: float, up_b: F64, sigma_b: float, edge: PoseEdge
) -> tuple[float, float] | None:
    """Angle between two ups (3,) across a loop, and its sigma, rad; None if one is not known."""
    if not up_a.any() or not up_b.any():
        return None
    up_b_in_a = edge.T_a_b[:3, :3] @ up_b
    cross = np.linalg.norm(np.cross(up_a, up_b_in_a)) / np.linalg.norm(up_a) / np.linalg.norm(up_b)
    sigma = np.sqrt(sigma_a**2 + sigma_b**2 + np.trace(edge.cov[:3, :3]) / 3)
    return float(np.arcsin(min(1.0, float(cross)))), float(sigma)


def gravity_contradictions(loops: list[InterAgentLoop]) -> list[Contradiction]:
    known = np.array([w.tilt for w in loops if w.tilt is not None]).reshape(-1, 2)
    if len(known) < _MIN_LOOPS:
        return []
    angle, sigmas = float(np.median(known[:, 0])), float(np.median(known[:, 0] / known[:, 1]))
    text = f"its up is {np.degrees(angle):.1f} degrees off"
    return [(min(angle / _MAX_TILT_RAD, sigmas / _MIN_SIGMAS), text, text)]


def severity(estimate: ScalarEstimate, tolerance: float) -> float:
    """1 where it is as large as may be, or as sure as must be, whichever comes later."""
    return min(abs(estimate.value) / tolerance, estimate.significance / _MIN_SIGMAS)


def scale_contradiction(
    estimate: ScalarEstimate, tolerance: float, text: str, words: tuple[str, str]
) -> Contradiction:
    """Severity, and the text for either side."""
    size = f"{100 * abs(np.expm1(estimate.value)):.1f} ± {100 * np.exp(estimate.value) * estimate.sigma:.1f}"
    more, less = (text.format(size, word) for word in words)
    return (severity(estimate, tolerance), *((more, less) if estimate.value > 0 else (less, more)))


def first_of_each_kind(texts: list[str]) -> str:
    """Of each kind of thing the first."""
    kinds = {" ".join(text.split()[:2]): text for text in reversed(texts)}
    return ", ".join(text for text in texts if text in kinds.values())


# ---- Which agents are outvoted: with whom most others disagree, where one voice counts once.

Credentials = Mapping[str, str | None]


def outvoted_agents(
    disagreeing: Collection[frozenset[str]],
    agreeing: Collection[tuple[str, str]],
    credentials: Credentials,
    suspects: Collection[str],
) -> frozenset[str]:
    """Of the pairs of agents that disagree, one after the other, with whom most others do; of equals a
    suspect, then with whom fewer agree. Nobody, where several voices are equal."""
    supporters, out, remaining = _count_votes(agreeing, credentials), set[str](), set(disagreeing)
    while remaining:
        opponents = _count_votes((tuple(names) for names in remaining), credentials)
        rank = {name: (count, name in suspects, -supporters[name]) for name, count in opponents.items()}
        highest = {agent for agent in rank if rank[agent] == max(rank.values())}
        if len({credentials[agent] for agent in highest}) != 1:  # 0: who still disagree are of one voice
            break
        out |= highest
        remaining = {names for names in remaining if not names & highest}
    return frozenset(out)


def _count_votes(pairs: Iterable[tuple[str, ...]], credentials: Credentials) -> Counter[str]:
    """With how many others each is paired: voices, but for its own."""
    both = ((a, b) for pair in pairs for a, b in (pair, pair[::-1]))
    return Counter(a for a, _ in {(a, credentials[b]) for a, b in both if credentials[a] != credentials[b]})


class AgentIdentities:
    """Of runs. A subject is called as its first run is; one that nobody announced is its own, of its own
    name. unproven: subjects that are yet to be compared with others before they come into a map with them;
    suspected: those of them whose name was under suspicion. A name's voice is the key that spoke for its
    newest run, where keys are used: one key counts once."""

    def __init__(self) -> None:
        self.unverified: set[str] = set()
        self.suspected: set[str] = set()
        self._credentials: dict[str, str | None] = {}  # of each name for which a key speaks
        self._identity_by_run: dict[str, str] = {}
        self._names: dict[str, str] = {}
        self._runs: dict[str, list[str]] = {}
        self._newest: dict[str, str] = {}  # of each name
        self._suspect_names: dict[
            str, bool
        ] = {}  # names of suspects that are gone, and whether one was set apart

    def add_run(
        self, run: str, name: str, suspect_identities: Iterable[str], credential: str | None = ""
    ) -> None:
        """A run of this name; suspects: subjects that are; voice: see `set_credential`. What is known
        already changes nothing else."""
        self.set_credential(name, credential)
        if run in self._identity_by_run:
            return
        before = self._newest.get(name)
        if before is not None and before not in self.suspected.union(suspect_identities):
            self._assign(run, before)
            return
        self._names[run] = name
        self._newest[name] = run
        self._assign(run, run)
        if before is not None or name in self._suspect_names:
            self.unverified.add(run)
            self.suspected.add(run)

    def set_credential(self, name: str, credential: str | None) -> None:
        """Which key speaks for a name from now on; "": none, it has a voice of its own; None: not known."""
        if credential == "":
            self._credentials.pop(name, None)
        else:
            self._credentials[name] = credential

    def mark_verified(self, identity: str) -> None:
        """It has been compared, and agrees."""
        self.unverified.discard(identity)
        self.suspected.discard(identity)

    def mark_unverified(self, runs: Collection[str]) -> None:
        """Of an earlier life, of which nothing else is known: those of each name are a subject, unproven."""
        for run in runs:
            self.add_run(run, run, ())
        known = [(run, self.name(run)) for run in self._identity_by_run]
        self._identity_by_run, self._names, self._runs, self._newest = {}, {}, {}, {}
        first_runs: dict[tuple[str, bool], str] = {}
        for run, name in known:
            first = first_runs.setdefault((name, run in runs), run)
            self._names[first], self._newest[name] = name, first
            self._assign(run, first)
        self.unverified = {first for (_, is_unverified), first in first_runs.items() if is_unverified}
        self.suspected = set()

    def _assign(self, run: str, identity: str) -> None:
        self._identity_by_run[run] = identity
        runs = self._runs.setdefault(identity, [])
        if run not in runs:
            runs.append(run)

    def remove_run(self, run: str, quarantined: Collection[str], disputed: Collection[str]) -> str | None:
        """A run that will not come back; apart, disputed: subjects that are. Returns its subject if that was
        its last run. What is held against that is held against the next run of its name."""
        identity = self.identity(run)
        runs = self._runs.get(identity, [run])
        if run in runs:
            runs.remove(run)
            self._identity_by_run.pop(run, None)
        if runs:
            return None
        name, is_newest = self.name(identity), self._newest.get(self.name(identity)) == identity
        if identity in self.suspected.union(quarantined, disputed):
            self._suspect_names[name] = self._suspect_names.get(name, False) or identity in quarantined
        elif is_newest:
            self._suspect_names.pop(name, None)
        if is_newest:
            del self._newest[name]
        self.mark_verified(identity)
        self._runs.pop(identity, None)
        self._names.pop(identity, None)
        return identity

    def identity(self, run: str) -> str:
        return self._identity_by_run.get(run, run)

    def name(self, run: str) -> str:
        """Of a run, or of a subject."""
        identity = self.identity(run)
        return self._names.get(identity, identity)

    def credential(self, identity: str) -> str | None:
        """Whose it is: names of one key have one. None: not known."""
        name = self.name(identity)
        return self._credentials.get(name, f"of {name}")  # no key has a space

    def credential_hypotheses(self, identities: Iterable[str]) -> list[dict[str, str | None]]:
        """Voices of these subjects, in every way that matters where some are not known: each its own, all the
        same one, and all that of a subject whose voice is known."""
        credentials = {identity: self.credential(identity) for identity in sorted(identities)}
        unknown = [identity for identity, credential in credentials.items() if credential is None]
        if not unknown:
            return [credentials]
        known = sorted({credential for credential in credentials.values() if credential is not None})
        together = [credentials | dict.fromkeys(unknown, credential) for credential in (None, *known)]
        return [credentials | {identity: f"of {identity}" for identity in unknown}, *together]

    def newest_run(self, identity: str) -> str:
        """Its newest run."""
        return self._runs.get(identity, [identity])[-1]

    def had_quarantined_run(self, run: str, quarantined: Iterable[str]) -> bool:
        """Whether another subject of its name was set apart; apart: those that are still there."""
        return self.shares_name_with_any(run, quarantined) or self._suspect_names.get(self.name(run), False)

    def shares_name_with_any(self, run: str, others: Iterable[str]) -> bool:
        """Whether one of these is another subject of its name."""
        identity, name = self.identity(run), self.name(run)
        return any(other != identity and self._names.get(other) == name for other in others)
