"""Which agents are outvoted: with whom most others disagree, where one voice counts once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping

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
