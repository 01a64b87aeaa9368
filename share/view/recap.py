"""What a live room that starts again has to be told: what is there, without how it came to be.

Pictures are left out, and all but the newest keyframes; with a map file, it reads the older ones there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from share.mapping.loops import KeyframeKey
from share.view import events as ev

MAX_KEYFRAMES = 5000  # some kB each


class Recap:
    """Follows the events of a session."""

    def __init__(self) -> None:
        self._begin(ev.SessionBegun())

    def _begin(self, session: ev.SessionBegun) -> None:
        self._session = session
        self._runs: dict[str, ev.RunArrived] = {}
        self._keyframes: dict[KeyframeKey, ev.KeyframeArrived] = {}
        self._corrections: dict[str, ev.CorrectionArrived] = {}
        self._solved: ev.MapsSolved | None = None
        self._loops: dict[frozenset[KeyframeKey], ev.LoopAccepted] = {}

    def apply(self, event: ev.RoomEvent) -> None:
        match event:
            case ev.SessionBegun():
                self._begin(event)
            case ev.RunArrived():
                self._runs[event.run] = event
            case ev.KeyframeArrived():
                self._keyframes[event.key] = replace(event, jpeg=b"")
                if len(self._keyframes) > MAX_KEYFRAMES:
                    del self._keyframes[next(iter(self._keyframes))]
            case ev.CorrectionArrived():
                self._corrections[event.run] = event
            case ev.MapsSolved():
                self._solved = event
            case ev.LoopAccepted():
                self._loops[frozenset((event.a, event.b))] = event
            case ev.LoopsRemoved():
                self._loops.pop(frozenset((event.a, event.b)), None)
            case ev.KeyframesRemoved():
                self._remove(set(event.keys))
            case ev.RunRemoved():
                self._runs.pop(event.run, None)
                self._corrections.pop(event.run, None)
                self._remove({key for key in self._keyframes if key.agent == event.run})

    def _remove(self, keys: set[KeyframeKey]) -> None:
        for key in keys:
            self._keyframes.pop(key, None)
        self._loops = {pair: loop for pair, loop in self._loops.items() if not pair & keys}

    def events(self) -> Iterator[ev.RoomEvent]:
        """Yield the events that lead to the same room."""
        yield self._session
        yield from self._runs.values()
        yield from self._keyframes.values()
        yield from self._corrections.values()  # before what is solved, which is better known
        if self._solved is not None:
            yield self._solved
        yield from self._loops.values()
