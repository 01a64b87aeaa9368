"""The drawings that have changed since a viewer last took them."""

from __future__ import annotations

from collections.abc import Callable

from share.view.drawing import Drawing, Lines, RemoveDrawing, Text, named

MakeDrawings = Callable[[], list[Drawing]]


class PendingDrawings:
    """How to draw each thing that has changed, by name. A thing that changes twice is drawn once."""

    def __init__(self) -> None:
        self._shown: set[str] = set()
        self._pending: dict[str, MakeDrawings] = {}
        self._end_s: dict[str, float] = {}  # of things that are shown for a while

    def __len__(self) -> int:
        return len(self._pending)

    @property
    def has_shown(self) -> bool:
        """Whether something is shown."""
        return bool(self._shown)

    def put(self, name: str, draw: MakeDrawings) -> None:
        """Draw the thing of this name again; without drawings it is removed."""
        self._pending[name] = draw

    def remove(self, name: str) -> None:
        self._pending[name] = _nothing

    def remove_all(self) -> None:
        """Remove all that is shown, and forget what was to be drawn."""
        self._pending = dict.fromkeys(self._shown, _nothing)
        self._end_s = {}

    def show_until(self, name: str, drawing: Lines | Text, end_s: float) -> None:
        """Show a drawing until `expire` is called at end_s or later."""
        self._end_s[name] = end_s
        drawings: list[Drawing] = [named(drawing, name)]
        self._pending[name] = lambda: drawings

    def add_shown(self, name: str) -> None:
        """Record that the caller itself draws the thing of this name."""
        self._shown.add(name)

    def expire(self, now_s: float) -> None:
        """Remove what was to be shown until now."""
        for name in [name for name, end_s in self._end_s.items() if now_s >= end_s]:
            del self._end_s[name]
            if name in self._shown:
                self._pending[name] = _nothing
            else:
                self._pending.pop(name, None)

    def take(self, most: int) -> list[Drawing]:
        """Return the drawings of the oldest `most` changes."""
        out: list[Drawing] = []
        for name in list(self._pending)[:most]:
            drawings = self._pending.pop(name)()
            out += drawings
            if drawings:
                self._shown.add(name)
            elif name in self._shown:
                self._shown.remove(name)
                out.append(RemoveDrawing(name))
        return out


def _nothing() -> list[Drawing]:
    return []
