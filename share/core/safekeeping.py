"""When a keyframe is safe, so that it may be acknowledged: once what was to be kept with it is kept."""

from __future__ import annotations

from collections import deque

from share.core.edge_events import Keep
from share.core.keeping import Change
from share.core.peer import Peer


class Safekeeping:
    """Of all agents of an edge. keeps: what is applied is safe once it is kept; else at once."""

    def __init__(self, keeps: bool) -> None:
        self._keeps = keeps
        self._ticket = 0  # of the newest that is to be kept
        self._kept_to = 0  # the newest ticket that is kept
        self._unsafe: deque[tuple[int, Peer, int]] = deque()  # ticket, and what is safe once it is kept

    def keep(self, changes: tuple[Change, ...]) -> Keep | None:
        """These are to be kept, after all before them; None where nothing is."""
        if not self._keeps or not changes:
            return None
        self._ticket += 1
        return Keep(self._ticket, changes)

    def applied(self, peer: Peer, keyframe: int) -> None:
        """A keyframe of this peer: it is safe with the newest that is to be kept."""
        peer.unsafe += 1
        self._unsafe.append((self._ticket, peer, keyframe + 1))

    def kept(self, ticket: int) -> list[Peer]:
        """All up to this ticket is kept. Returns whose keyframes are safe by that."""
        self._kept_to = max(self._kept_to, ticket)
        told = {}
        while self._unsafe and self._unsafe[0][0] <= ticket:
            _, peer, next_keyframe = self._unsafe.popleft()
            peer.safe = next_keyframe
            peer.unsafe -= 1
            told[peer.key] = peer
        return list(told.values())

    def safe(self) -> list[Peer]:
        """The same, of what waits for nothing that is not kept yet."""
        return self.kept(self._kept_to if self._keeps else self._ticket)
