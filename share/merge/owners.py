"""Whose each run is, and which run of a name is its present one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping


class Owners:
    """Runs by name. A run that nobody has introduced is its own name's, and present."""

    def __init__(self) -> None:
        self._name: dict[str, str] = {}
        self._latest: dict[str, str] = {}  # run of each name, the one heard of longest ago first
        self._absent: set[str] = set()

    def join(self, run: str, name: str) -> None:
        """A new run: it is its name's present one from now on."""
        self._name[run] = name
        self.present(run, True)

    def present(self, run: str, here: bool) -> bool:
        """Whether it is heard; returns whether that is news. An older run that comes back is its name's
        present one again."""
        was_absent = run in self._absent
        if not here:
            self._absent.add(run)
            return not was_absent
        self._absent.discard(run)
        name = self.name(run)
        self._latest.pop(name, None)
        self._latest[name] = run
        return was_absent

    def forget(self, run: str) -> None:
        """Nothing of it is left."""
        name = self._name.pop(run, run)
        self._absent.discard(run)
        if self._latest.get(name) == run:
            del self._latest[name]
            if left := [one for one in self._name if self._name[one] == name]:
                self._latest[name] = left[-1]

    def name(self, run: str) -> str:
        return self._name.get(run, run)

    def is_absent(self, run: str) -> bool:
        return run in self._absent

    def is_away(self, name: str) -> bool:
        """Whether none of its runs is heard."""
        return self._latest.get(name, name) in self._absent

    def is_ended(self, run: str) -> bool:
        """Whether it is not heard, and another run of its name has come after it."""
        return run in self._absent and self._latest.get(self.name(run), run) != run

    def heard_of(self) -> dict[str, int]:
        """Of each name, when its present run came or came back: in the order of these numbers."""
        return {name: at for at, name in enumerate(self._latest)}


def dues(held: Counter[str], most: Counter[str], count: int, heard_of: Mapping[str, int]) -> Counter[str]:
    """How many of `count` each name gives: again and again the one that holds most, of several the one heard
    of longest ago. So nobody who holds no more than a fair share gives anything.

    held: keyframes of each name. most: that it can give. heard_of: as `Owners.heard_of`.
    """
    out = Counter[str]()
    for _ in range(min(count, most.total())):
        able = (name for name in held if out[name] < most[name])
        out[max(able, key=lambda one: (held[one] - out[one], -heard_of.get(one, -1)))] += 1
    return out
