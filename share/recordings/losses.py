"""Count the damaged parts of a recording that are skipped, with the first reason of each kind."""

from __future__ import annotations

from dataclasses import dataclass, field

from share.errors import DataError

MAX_LOSS_RATIO = 0.05  # of one list of lines or images; beyond, it is another kind of file, or a broken disk
_MIN_ALLOWED = 1  # losses that are allowed however short the list
_MAX_PLACES = 10_000  # remembered per kind, so that a place met twice counts once


@dataclass
class _LossKind:
    first_reason: str
    count: int = 0
    places: set[str] = field(default_factory=set)


class DataLosses:
    """Losses of one recording, filled while it is opened and read."""

    def __init__(self) -> None:
        self._kinds: dict[str, _LossKind] = {}

    def add(self, kind: str, where: str, reason: str) -> None:
        """Count a loss. kind: plural, `images of cam0`. where: its place. reason: a line that names it."""
        entry = self._kinds.setdefault(kind, _LossKind(reason))
        if where not in entry.places:
            entry.count += 1
            if len(entry.places) < _MAX_PLACES:
                entry.places.add(where)

    def check(self, kind: str, total: int) -> None:
        """Raise DataError if all of `total` are lost, or more than 5 % and more than one."""
        entry = self._kinds.get(kind)
        if entry is not None and entry.count > min(max(_MIN_ALLOWED, MAX_LOSS_RATIO * total), total - 1):
            raise DataError(
                f"{entry.first_reason} ({entry.count} of {total} {kind} are damaged: too many to skip)"
            )

    @property
    def counts(self) -> dict[str, int]:
        """Number of losses by kind."""
        return {what: kind.count for what, kind in self._kinds.items()}

    def lines(self) -> list[str]:
        """Return a line per kind."""
        return [
            f"skipped as damaged: {kind.count} of the {what}; the first: {kind.first_reason}"
            for what, kind in self._kinds.items()
        ]
