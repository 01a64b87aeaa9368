"""The runs of agents that an edge knows, also those that are over."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from share.core.inorder import InOrder
from share.core.peer import Known, Peer
from share.merge.join import Key
from share.wire.messages import peer_id

_MAX_IDLE = 256  # gone without a keyframe; the oldest is forgotten
_MAX_FORGOTTEN = (
    65_536  # runs that are known to have been forgotten; of the others nobody was heard for hours
)


class Runs(Mapping[bytes, Peer]):
    """By who speaks for them on the link. Each has a key, which names it everywhere else, and of each name
    the one that came or came back last is that agent's present one."""

    def __init__(self) -> None:
        self._peers: dict[bytes, Peer] = {}
        self._by_key: dict[str, bytes] = {}
        self._of_name: dict[str, dict[str, Peer]] = {}  # by key, the present one last
        # runs of which the map has nothing any more, and their newest keyframe
        self._emptied: dict[str, int] = {}
        self._forgotten: dict[bytes, None] = {}
        self.forgotten = 0  # how many, since the edge began

    def __getitem__(self, peer: bytes) -> Peer:
        return self._peers[peer]

    def __iter__(self) -> Iterator[bytes]:
        return iter(self._peers)

    def __len__(self) -> int:
        return len(self._peers)

    @property
    def by_key(self) -> Mapping[str, bytes]:
        """Who speaks for each run."""
        return self._by_key

    def is_latest(self, peer: Peer) -> bool:
        """Whether no other run of that name came, or came back, after it."""
        return next(reversed(self._of_name[peer.hello.name])) == peer.key

    def label(self, peer: Peer) -> str:
        """Of this run in reports: its name, if it is the latest of that; else also the end of its key, behind
        a character that is in no name, so that no name can be taken for it."""
        name = peer.hello.name
        return name if self.is_latest(peer) else f"{name}/{peer.key.removeprefix(f'{name}-')}"

    def add(self, peer_id: bytes, peer: Peer) -> None:
        """It is its name's present one from now on."""
        self._peers[peer_id] = peer
        self._by_key[peer.key] = peer_id
        self.came_back(peer)

    def came_back(self, peer: Peer) -> None:
        """It is its name's present one again."""
        runs = self._of_name.setdefault(peer.hello.name, {})
        runs.pop(peer.key, None)
        runs[peer.key] = peer

    def recall(self, run: Known) -> None:
        """One of an earlier life: it is not here, but may go on where it was."""
        asked = run.next_keyframe
        peer = Peer(run.hello, run.key, 0, InOrder(asked), asked, run.foot, gone=True, greeted=False)
        peer.newest, peer.was_heard, peer.voice = run.finding, False, run.voice
        self.add(peer_id(run.hello.run_id), peer)
        if run.foot is None:
            self._emptied[run.key] = -1

    def emptied(self, runs: Iterable[Key]) -> None:
        """The map has nothing of these any more, that has had their keyframes up to those."""
        self._emptied.update(runs)

    def forgettable(self) -> list[Peer]:
        """Runs that are gone and of which nothing is left. One that has come back meanwhile is kept."""
        out = []
        for key, newest in list(self._emptied.items()):
            peer = self._peers[self._by_key[key]] if key in self._by_key else None
            if peer is None or (peer.foot is not None and peer.foot.id > newest):
                del self._emptied[key]
            elif peer.gone and not peer.unsafe:
                out.append(peer)
        return out

    def forget(self, peer: Peer) -> bool:
        """For good; returns whether it was its name's present one."""
        peer_id = self._by_key.pop(peer.key)
        del self._peers[peer_id]
        self._emptied.pop(peer.key, None)
        was_latest, name = self.is_latest(peer), peer.hello.name
        del self._of_name[name][peer.key]
        if not self._of_name[name]:
            del self._of_name[name]
        if peer.foot is not None:
            self.forgotten += 1
            self._forgotten[peer_id] = None
            if len(self._forgotten) > _MAX_FORGOTTEN:
                del self._forgotten[next(iter(self._forgotten))]
        return was_latest

    def was_forgotten(self, peer_id: bytes) -> bool:
        """Whether this run was, in this life of the edge: keyframes that were acknowledged are not known."""
        return peer_id in self._forgotten

    def forget_idle(self) -> tuple[Peer, bool] | None:
        """Who joins again and again without a keyframe fills no memory: the run that is forgotten now, if one
        is, and whether it was its name's present one."""
        idle = [(peer.heard_ns, peer_id) for peer_id, peer in self._peers.items() if peer.is_idle]
        if len(idle) < _MAX_IDLE:
            return None
        peer = self._peers[min(idle)[1]]
        return peer, self.forget(peer)
