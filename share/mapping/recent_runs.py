"""Which runs a report lists: present ones, and a bounded number of absent ones, however many there ever were.

An edge that is started ten times a day by ten agents knows thousands of runs after a month, and its map file
keeps them. The edge and its mapper follow the same runs, so both list the same ones.
"""

from __future__ import annotations

from itertools import islice

MAX_EARLIER = 16  # absent runs that are listed beside the latest of each name


class RecentRuns:
    """Runs by key, with the name of their agent. The run of a name that joined or came back last is its
    latest.

    max_names: names of absent agents whose latest run is listed, those that left last.
    """

    def __init__(self, max_names: int) -> None:
        self._max_names, self._count = max_names, 0
        self._numbers: dict[str, int] = {}  # by when it was added
        self._names: dict[str, str] = {}
        self._runs_by_name: dict[str, dict[str, None]] = {}  # the latest last
        self._present: dict[str, None] = {}
        self._absent_latest: dict[str, None] = {}  # of their names; the run that left last is last
        self._absent_earlier: dict[str, None] = {}
        self._listed: tuple[str, ...] | None = None  # None: it has changed

    def __len__(self) -> int:
        return len(self._numbers)

    def add(self, run: str, name: str) -> None:
        """Add a run, which is present."""
        self._count += 1
        self._numbers[run], self._names[run] = self._count, name
        self._runs_by_name.setdefault(name, {})
        self.set_present(run, True)

    def set_present(self, run: str, is_present: bool) -> None:
        """Set whether a run is present. One that comes becomes the latest of its name."""
        self._listed = None
        if not is_present:
            if run in self._present:
                del self._present[run]
                self._mark_absent(run)
            return
        runs = self._runs_by_name[self._names[run]]
        latest = next(reversed(runs), None)
        if latest is not None and latest in self._absent_latest:
            del self._absent_latest[latest]
            self._absent_earlier[latest] = None
        runs.pop(run, None)
        runs[run] = self._present[run] = None
        self._absent_earlier.pop(run, None)

    def remove(self, run: str) -> None:
        """Forget a run. The one before it becomes the latest of its name."""
        self._listed, name = None, self._names.pop(run)
        del self._numbers[run]
        for runs in (self._present, self._absent_latest, self._absent_earlier, self._runs_by_name[name]):
            runs.pop(run, None)
        if not self._runs_by_name[name]:
            del self._runs_by_name[name]
        elif (latest := next(reversed(self._runs_by_name[name]))) in self._absent_earlier:
            del self._absent_earlier[latest]
            self._mark_absent(latest)

    def is_latest(self, run: str) -> bool:
        """Return whether no other run of its name joined or came back later."""
        return next(reversed(self._runs_by_name[self._names[run]])) == run

    def listed(self) -> tuple[str, ...]:
        """Return the runs that a report lists, in the order in which they were added."""
        if self._listed is None:
            latest = islice(reversed(self._absent_latest), self._max_names)
            earlier = islice(reversed(self._absent_earlier), MAX_EARLIER)
            self._listed = tuple(sorted((*self._present, *latest, *earlier), key=self._numbers.__getitem__))
        return self._listed

    def _mark_absent(self, run: str) -> None:
        (self._absent_latest if self.is_latest(run) else self._absent_earlier)[run] = None
