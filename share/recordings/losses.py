"""What of a recording cannot be read and is left out: counted, with the first reason of each kind."""

from __future__ import annotations

from dataclasses import dataclass, field

from share.errors import DataError

FORGIVEN = 0.05  # of all lines or images of one list; with more it is another kind of file, or a broken disk
_FEW = 1  # is forgiven however short the list is
_REMEMBERED = 10_000  # places of one kind, so that one met twice counts once


@dataclass
class _Kind:
    first: str
    count: int = 0
    places: set[str] = field(default_factory=set)


class Losses:
    """Filled while a recording is opened and read."""

    def __init__(self) -> None:
        self._kinds: dict[str, _Kind] = {}

    def add(self, what: str, where: str, why: str) -> None:
        """One more of `what` (plural: `images of cam0`), at `where`, cannot be read: `why`, with where."""
        kind = self._kinds.setdefault(what, _Kind(why))
        if where not in kind.places:
            kind.count += 1
            if len(kind.places) < _REMEMBERED:
                kind.places.add(where)

    def check(self, what: str, total: int) -> None:
        """Raises DataError if all of `total` are lost, or more than 5 % and more than one."""
        kind = self._kinds.get(what)
        if kind is not None and kind.count > min(max(_FEW, FORGIVEN * total), total - 1):
            raise DataError(
                f"{kind.first} ({kind.count} of {total} {what} are damaged: too many to leave out)"
            )

    @property
    def counts(self) -> dict[str, int]:
        """How many of each kind."""
        return {what: kind.count for what, kind in self._kinds.items()}

    def lines(self) -> list[str]:
        """For a person, one a kind."""
        return [
            f"left out, since damaged: {kind.count} of the {what}; the first: {kind.first}"
            for what, kind in self._kinds.items()
        ]
