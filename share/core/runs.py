"""The runs of agents that an edge knows, also those that are over."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from share.core.inorder import InOrder
from share.core.peer import Known, Peer
from share.wire.messages import peer_id

_MAX_IDLE = 256  # gone without a keyframe; the oldest is forgotten


class Runs(Mapping[bytes, Peer]):
    """By who speaks for them on the link. Each has a key, which names it everywhere else, and the newest of
    a name is that agent's present one."""

    def __init__(self) -> None:
        self._peers: dict[bytes, Peer] = {}
        self._by_key: dict[str, bytes] = {}
        self._latest: dict[str, Peer] = {}  # run of each name

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
        """Whether no other run of that name came after it."""
        return self._latest[peer.hello.name] is peer

    def add(self, peer_id: bytes, peer: Peer) -> None:
        """It is its name's present one from now on."""
        self._peers[peer_id] = self._latest[peer.hello.name] = peer
        self._by_key[peer.key] = peer_id

    def recall(self, run: Known) -> None:
        """One of an earlier life: it is not here, but may go on where it was."""
        asked = run.next_keyframe
        peer = Peer(run.hello, run.key, 0, InOrder(asked), asked, run.foot, gone=True, greeted=False)
        peer.newest, peer.was_heard = run.finding, False
        self.add(peer_id(run.hello.run_id), peer)

    def forget_idle(self) -> tuple[Peer, bool] | None:
        """Who joins again and again without a keyframe fills no memory: the run that is forgotten now, if one
        is, and whether it was its name's present one."""
        idle = [(peer.heard_ns, peer_id) for peer_id, peer in self._peers.items() if peer.is_idle]
        if len(idle) < _MAX_IDLE:
            return None
        peer = self._peers.pop(min(idle)[1])
        del self._by_key[peer.key]
        if was_latest := self.is_latest(peer):
            del self._latest[peer.hello.name]
        return peer, was_latest
