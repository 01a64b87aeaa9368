"""Whose word a run's is: all runs of one name are one witness, as long as the name is not under suspicion.

So a headset that is restarted before it is found out is found out all the same, with all its runs; a name
counts once however often it came. A run that comes while its name is under suspicion is a subject of its own,
for it may have been calibrated anew; it is kept apart until it has been compared.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping

import numpy as np

from share.mapping.agents.consistency import Estimate, Witness
from share.mapping.graph.edges import Edge
from share.types import F64

# ---- What is held against two agents: how severe it is, and in which words.
#
# A severity of 1 begins a disagreement. Each finding is (severity, of the second agent against the first, of
# the first against the second).

_SIGMAS = 4.5  # that a difference must have: of thousands of comparisons none by chance
_TILT = np.radians(1.0)  # rad, less does no harm
_ENOUGH = 8  # loops before their ups say anything

Finding = tuple[float, str, str]


def tilt_between(
    up_a: F64, sigma_a: float, up_b: F64, sigma_b: float, edge: Edge
) -> tuple[float, float] | None:
    """Angle between two ups (3,) across a loop, and its sigma, rad; None if one is not known."""
    if not up_a.any() or not up_b.any():
        return None
    there = edge.T_a_b[:3, :3] @ up_b
    cross = np.linalg.norm(np.cross(up_a, there)) / np.linalg.norm(up_a) / np.linalg.norm(up_b)
    sigma = np.sqrt(sigma_a**2 + sigma_b**2 + np.trace(edge.cov[:3, :3]) / 3)
    return float(np.arcsin(min(1.0, float(cross)))), float(sigma)


def by_gravity(loops: list[Witness]) -> list[Finding]:
    known = np.array([w.tilt for w in loops if w.tilt is not None]).reshape(-1, 2)
    if len(known) < _ENOUGH:
        return []
    angle, sigmas = float(np.median(known[:, 0])), float(np.median(known[:, 0] / known[:, 1]))
    text = f"its up is {np.degrees(angle):.1f} degrees off"
    return [(min(angle / _TILT, sigmas / _SIGMAS), text, text)]


def severity_of(found: Estimate, harmless: float) -> float:
    """1 where it is as large as may be, or as sure as must be, whichever comes later."""
    return min(abs(found.value) / harmless, found.significance / _SIGMAS)


def told(found: Estimate, harmless: float, text: str, words: tuple[str, str]) -> Finding:
    """Severity, and the text for either side."""
    size = f"{100 * abs(np.expm1(found.value)):.1f} ± {100 * np.exp(found.value) * found.sigma:.1f}"
    more, less = (text.format(size, word) for word in words)
    return (severity_of(found, harmless), *((more, less) if found.value > 0 else (less, more)))


def worst(said: list[str]) -> str:
    """Of each kind of thing the first."""
    kinds = {" ".join(text.split()[:2]): text for text in reversed(said)}
    return ", ".join(text for text in said if text in kinds.values())


# ---- Which agents are outvoted: with whom most others disagree, where one voice counts once.

Voices = Mapping[str, str | None]


def outvoted(
    disagree: Collection[frozenset[str]],
    agree: Collection[tuple[str, str]],
    voices: Voices,
    suspects: Collection[str],
) -> frozenset[str]:
    """Of the pairs of agents that disagree, one after the other, with whom most others do; of equals a
    suspect, then with whom fewer agree. Nobody, where several voices are equal."""
    friends, out, left = _votes(agree, voices), set[str](), set(disagree)
    while left:
        against = _votes((tuple(names) for names in left), voices)
        rank = {name: (count, name in suspects, -friends[name]) for name, count in against.items()}
        who = {agent for agent in rank if rank[agent] == max(rank.values())}
        if len({voices[agent] for agent in who}) != 1:  # 0: who still disagree are of one voice
            break
        out |= who
        left = {names for names in left if not names & who}
    return frozenset(out)


def _votes(pairs: Iterable[tuple[str, ...]], voices: Voices) -> Counter[str]:
    """With how many others each is paired: voices, but for its own."""
    both = ((a, b) for pair in pairs for a, b in (pair, pair[::-1]))
    return Counter(a for a, _ in {(a, voices[b]) for a, b in both if voices[a] != voices[b]})


class Subjects:
    """Of runs. A subject is called as its first run is; one that nobody announced is its own, of its own
    name. unproven: subjects that are yet to be compared with others before they come into a map with them;
    suspected: those of them whose name was under suspicion. A name's voice is the key that spoke for its
    newest run, where keys are used: one key counts once."""

    def __init__(self) -> None:
        self.unproven: set[str] = set()
        self.suspected: set[str] = set()
        self._voices: dict[str, str | None] = {}  # of each name for which a key speaks
        self._of: dict[str, str] = {}
        self._names: dict[str, str] = {}
        self._runs: dict[str, list[str]] = {}
        self._newest: dict[str, str] = {}  # of each name
        self._held: dict[str, bool] = {}  # names of suspects that are gone, and whether one was set apart

    def enter(self, run: str, name: str, suspects: Iterable[str], voice: str | None = "") -> None:
        """A run of this name; suspects: subjects that are; voice: see `speaks`. What is known already changes
        nothing else."""
        self.speaks(name, voice)
        if run in self._of:
            return
        before = self._newest.get(name)
        if before is not None and before not in self.suspected.union(suspects):
            self._add(run, before)
            return
        self._names[run] = name
        self._newest[name] = run
        self._add(run, run)
        if before is not None or name in self._held:
            self.unproven.add(run)
            self.suspected.add(run)

    def speaks(self, name: str, voice: str | None) -> None:
        """Which key speaks for a name from now on; "": none, it has a voice of its own; None: not known."""
        if voice == "":
            self._voices.pop(name, None)
        else:
            self._voices[name] = voice

    def prove(self, subject: str) -> None:
        """It has been compared, and agrees."""
        self.unproven.discard(subject)
        self.suspected.discard(subject)

    def doubt(self, runs: Collection[str]) -> None:
        """Of an earlier life, of which nothing else is known: those of each name are a subject, unproven."""
        for run in runs:
            self.enter(run, run, ())
        known = [(run, self.name(run)) for run in self._of]
        self._of, self._names, self._runs, self._newest = {}, {}, {}, {}
        firsts: dict[tuple[str, bool], str] = {}
        for run, name in known:
            first = firsts.setdefault((name, run in runs), run)
            self._names[first], self._newest[name] = name, first
            self._add(run, first)
        self.unproven = {first for (_, doubted), first in firsts.items() if doubted}
        self.suspected = set()

    def _add(self, run: str, subject: str) -> None:
        self._of[run] = subject
        runs = self._runs.setdefault(subject, [])
        if run not in runs:
            runs.append(run)

    def forget(self, run: str, apart: Collection[str], disputed: Collection[str]) -> str | None:
        """A run that will not come back; apart, disputed: subjects that are. Returns its subject if that was
        its last run. What is held against that is held against the next run of its name."""
        subject = self.of(run)
        runs = self._runs.get(subject, [run])
        if run in runs:
            runs.remove(run)
            self._of.pop(run, None)
        if runs:
            return None
        name, newest = self.name(subject), self._newest.get(self.name(subject)) == subject
        if subject in self.suspected.union(apart, disputed):
            self._held[name] = self._held.get(name, False) or subject in apart
        elif newest:
            self._held.pop(name, None)
        if newest:
            del self._newest[name]
        self.prove(subject)
        self._runs.pop(subject, None)
        self._names.pop(subject, None)
        return subject

    def of(self, run: str) -> str:
        return self._of.get(run, run)

    def name(self, run: str) -> str:
        """Of a run, or of a subject."""
        subject = self.of(run)
        return self._names.get(subject, subject)

    def voice(self, subject: str) -> str | None:
        """Whose it is: names of one key have one. None: not known."""
        name = self.name(subject)
        return self._voices.get(name, f"of {name}")  # no key has a space

    def voicings(self, subjects: Iterable[str]) -> list[dict[str, str | None]]:
        """Voices of these subjects, in every way that matters where some are not known: each its own, all the
        same one, and all that of a subject whose voice is known."""
        voices = {subject: self.voice(subject) for subject in sorted(subjects)}
        unknown = [subject for subject, voice in voices.items() if voice is None]
        if not unknown:
            return [voices]
        known = sorted({voice for voice in voices.values() if voice is not None})
        together = [voices | dict.fromkeys(unknown, voice) for voice in (None, *known)]
        return [voices | {subject: f"of {subject}" for subject in unknown}, *together]

    def newest(self, subject: str) -> str:
        """Its newest run."""
        return self._runs.get(subject, [subject])[-1]

    def follows_one_apart(self, run: str, apart: Iterable[str]) -> bool:
        """Whether another subject of its name was set apart; apart: those that are still there."""
        return self.follows(run, apart) or self._held.get(self.name(run), False)

    def follows(self, run: str, some: Iterable[str]) -> bool:
        """Whether one of these is another subject of its name."""
        subject, name = self.of(run), self.name(run)
        return any(other != subject and self._names.get(other) == name for other in some)
