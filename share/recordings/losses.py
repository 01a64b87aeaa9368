"""What of a recording cannot be read and is left out: counted, with the first reason of each kind."""

from __future__ import annotations

from dataclasses import dataclass, field

from share.errors import DataError

MAX_LOSS_RATIO = (
    0.05  # of all lines or images of one list; with more it is another kind of file, or a broken disk
)
_MIN_ALLOWED = 1  # is forgiven however short the list is
_MAX_PLACES = 10_000  # places of one kind, so that one met twice counts once


@dataclass
class _LossKind:
    first_reason: str
    count: int = 0
    places: set[str] = field(default_factory=set)


class DataLosses:
    """Filled while a recording is opened and read."""

    def __init__(self) -> None:
        self._kinds: dict[str, _LossKind] = {}

    def add(self, kind: str, where: str, reason: str) -> None:
        """One more of `entry` (plural: `images of cam0`), at `where`, cannot be read: `reason`, with
        where."""
        entry = self._kinds.setdefault(kind, _LossKind(reason))
        if where not in entry.places:
            entry.count += 1
            if len(entry.places) < _MAX_PLACES:
                entry.places.add(where)

    def check(self, kind: str, total: int) -> None:
        """Raises DataError if all of `total` are lost, or more than 5 % and more than one."""
        entry = self._kinds.get(kind)
        if entry is not None and entry.count > min(max(_MIN_ALLOWED, MAX_LOSS_RATIO * total), total - 1):
            raise DataError(
                f"{entry.first_reason} ({entry.count} of {total} {kind} are damaged: too many to leave out)"
            )

    @property
    def counts(self) -> dict[str, int]:
        """How many of each kind."""
        return {what: kind.count for what, kind in self._kinds.items()}

    def lines(self) -> list[str]:
        """For a person, one a kind."""
        return [
            f"left out, since damaged: {kind.count} of the {what}; the first: {kind.first_reason}"
            for what, kind in self._kinds.items()
        ]
