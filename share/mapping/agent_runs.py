"""The runs of each agent: which are present, which is the latest of a name, and which ones a report lists.

An edge that ten agents use ten times a day knows thousands of runs after a month, and its map file keeps
them. So nothing that is done for each message, keyframe or report looks at all of them.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import islice
from typing import NamedTuple

_MAX_LEFT = 16  # runs that left last, in a report


class _Run(NamedTuple):
    """A run. number: by when it was added."""

    name: str
    number: int


class AgentRuns:
    """Runs by their keys. The latest run of a name is the one that joined or came back last. A run that was
    never added is present under a name of its own."""

    def __init__(self) -> None:
        self._count = 0
        self._runs: dict[str, _Run] = {}
        # Dicts as ordered sets, in which who came or left last is last:
        self._by_name: dict[str, dict[str, None]] = {}
        self._present: dict[str, None] = {}
        self._absent: dict[str, None] = {}

    def __contains__(self, run: object) -> bool:
        return run in self._runs

    def __len__(self) -> int:
        return len(self._runs)

    def add(self, run: str, name: str) -> None:
        """Add a run, which is present and becomes the latest of its name."""
        if run in self._runs:
            self.remove(run)
        self._runs[run], self._count = _Run(name, self._count), self._count + 1
        self.set_present(run, True)

    def set_present(self, run: str, is_present: bool) -> bool:
        """Set whether a run is present; return whether that changed.

        A run that comes back becomes the latest of its name again. One that is absent again, since it was
        heard from, becomes the one that left last.
        """
        if run not in self._runs:
            self.add(run, run)
        has_changed = is_present != (run in self._present)
        self._present.pop(run, None)
        self._absent.pop(run, None)
        if not is_present:
            self._absent[run] = None
            return has_changed
        self._present[run] = None
        name = self._runs[run].name
        runs = self._by_name.pop(name, {})
        runs.pop(run, None)
        runs[run] = None
        self._by_name[name] = runs
        return has_changed

    def remove(self, run: str) -> None:
        """Forget a run. The one before it becomes the latest of its name."""
        runs = self._by_name.get(name := self.name(run), {})
        for known in (self._runs, self._present, self._absent, runs):
            known.pop(run, None)
        if not runs:
            self._by_name.pop(name, None)

    def name(self, run: str) -> str:
        return self._runs[run].name if run in self._runs else run

    def present(self) -> Collection[str]:
        """Return the runs that are present, by when they came."""
        return self._present.keys()

    def is_absent(self, run: str) -> bool:
        return run in self._absent

    def is_latest(self, run: str) -> bool:
        """Return whether no other run of its name joined or came back later."""
        return self._latest(self.name(run)) == run

    def is_name_absent(self, name: str) -> bool:
        """Return whether the latest run of this name is absent."""
        return self._latest(name) in self._absent

    def is_superseded(self, run: str) -> bool:
        """Return whether the run is absent and not the latest of its name."""
        return run in self._absent and not self.is_latest(run)

    def presence_order(self) -> dict[str, int]:
        """Rank of each name by when its latest run last came, oldest first."""
        return {name: i for i, name in enumerate(self._by_name)}

    def listed(self, max_names: int) -> list[str]:
        """Return the runs that a report lists, in the order in which they were added: those present, the
        latest of each of `max_names` names, those that came last, and the few that left last."""
        latest = map(self._latest, islice(reversed(self._by_name), max_names))
        left = islice(reversed(self._absent), _MAX_LEFT)
        return sorted({*self._present, *latest, *left}, key=lambda run: self._runs[run].number)

    def _latest(self, name: str) -> str:
        """Return the latest run of a name; of an unknown name a run of that name."""
        return next(reversed(self._by_name.get(name, {name: None})))
