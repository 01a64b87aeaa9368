"""Identities: which runs count as one agent, and votes on which agents are wrong.

All runs of a name are one agent while the name is not suspected. So an agent that restarts before it is found
wrong is found wrong with all its runs, and a name counts once however often it reconnects. A run that starts
while its name is suspected is an agent of its own, since it may have been calibrated anew; it is kept
separate until it is compared.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping

# Votes: each credential counts once.

Credentials = Mapping[str, str | None]


def outvoted_agents(
    disagreeing: Collection[frozenset[str]],
    agreeing: Collection[tuple[str, str]],
    credentials: Credentials,
    suspects: Collection[str],
) -> frozenset[str]:
    """Agents that most others disagree with, found one after the other.

    disagreeing, agreeing: pairs of agents. Of equals a suspect is chosen, then the agent with fewer that
    agree. The search ends where agents with different credentials rank equal.
    """
    agreement_counts, out, remaining = _count_votes(agreeing, credentials), set[str](), set(disagreeing)
    while remaining:
        disagreement_counts = _count_votes((tuple(names) for names in remaining), credentials)
        rank = {
            name: (count, name in suspects, -agreement_counts[name])
            for name, count in disagreement_counts.items()
        }
        highest = {agent for agent in rank if rank[agent] == max(rank.values())}
        if len({credentials[agent] for agent in highest}) != 1:  # 0: the rest share one credential
            break
        out |= highest
        remaining = {names for names in remaining if not names & highest}
    return frozenset(out)


def _count_votes(pairs: Iterable[tuple[str, ...]], credentials: Credentials) -> Counter[str]:
    """Number of credentials, other than its own, with which each agent is paired."""
    both = ((a, b) for pair in pairs for a, b in (pair, pair[::-1]))
    return Counter(a for a, _ in {(a, credentials[b]) for a, b in both if credentials[a] != credentials[b]})


class AgentIdentities:
    """Identities of runs. An identity is named after its first run; an unregistered run is one by itself.

    unverified: identities that must be compared with others before they share a map; suspected: those of them
    whose name was suspected. The credential of a name is the key that authenticated its newest run, where
    keys are used; a key has one vote.
    """

    def __init__(self) -> None:
        self.unverified: set[str] = set()
        self.suspected: set[str] = set()
        self._credentials: dict[str, str | None] = {}  # of names with a key
        self._identity_by_run: dict[str, str] = {}
        self._names: dict[str, str] = {}  # of identities
        self._runs: dict[str, dict[str, None]] = {}  # of identities, the newest last
        self._newest: dict[str, str] = {}  # newest identity of each name
        self._suspect_names: dict[str, bool] = {}  # names of removed suspects; whether one was quarantined

    def add_run(
        self, run: str, name: str, suspect_identities: Iterable[str], credential: str | None = ""
    ) -> None:
        """Register a run of this name; a known run only gets the credential.

        suspect_identities: those currently suspected. credential: see `set_credential`.
        """
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
        """Set the key of a name; "": none, the name has a vote of its own; None: unknown."""
        if credential == "":
            self._credentials.pop(name, None)
        else:
            self._credentials[name] = credential

    def mark_verified(self, identity: str) -> None:
        """The identity has been compared, and agrees."""
        self.unverified.discard(identity)
        self.suspected.discard(identity)

    def mark_unverified(self, runs: Collection[str]) -> None:
        """Group these runs of an earlier session into one unverified identity per name."""
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
        self._runs.setdefault(identity, {})[run] = None

    def remove_run(self, run: str, quarantined: Collection[str], disputed: Collection[str]) -> str | None:
        """Forget a run; return its identity if that was its last run.

        quarantined, disputed: current identities. Suspicion passes to the next run of the name.
        """
        identity = self.identity(run)
        runs = self._runs.get(identity, {run: None})
        if run in runs:
            del runs[run]
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
        """Identity of a run; an unregistered run is its own."""
        return self._identity_by_run.get(run, run)

    def name(self, run: str) -> str:
        identity = self.identity(run)
        return self._names.get(identity, identity)

    def credential(self, identity: str) -> str | None:
        """Credential of an identity, shared by all names of one key; None: unknown."""
        name = self.name(identity)
        return self._credentials.get(name, f"of {name}")  # no key has a space

    def credential_hypotheses(self, identities: Iterable[str]) -> list[dict[str, str | None]]:
        """Credentials of these identities under each relevant assumption on unknown ones.

        Each has its own, all have the same, or all have that of a known identity.
        """
        credentials = {identity: self.credential(identity) for identity in sorted(identities)}
        unknown = [identity for identity, credential in credentials.items() if credential is None]
        if not unknown:
            return [credentials]
        known = sorted({credential for credential in credentials.values() if credential is not None})
        together = [credentials | dict.fromkeys(unknown, credential) for credential in (None, *known)]
        return [credentials | {identity: f"of {identity}" for identity in unknown}, *together]

    def runs(self, identity: str) -> Iterable[str]:
        """Return the runs of an identity, the newest last; of an unregistered run itself."""
        return self._runs.get(identity, {identity: None})

    def newest_run(self, identity: str) -> str:
        return next(reversed(self._runs.get(identity, {identity: None})))

    def had_quarantined_run(self, run: str, quarantined: Iterable[str]) -> bool:
        """Return whether another identity of the run's name was quarantined, or is in `quarantined`."""
        identity, name = self.identity(run), self.name(run)
        others = (other for other in quarantined if other != identity)
        return any(self._names.get(other) == name for other in others) or self._suspect_names.get(name, False)
