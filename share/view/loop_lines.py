"""Loops between keyframes in the order in which they were accepted, in chunks that are drawn together."""

from __future__ import annotations

from collections.abc import Iterator

from share.mapping.loops import KeyframeKey

_LOOPS_PER_CHUNK = 64
Pair = tuple[KeyframeKey, KeyframeKey]


class LoopLines:
    """count: of all loops ever added, one of each two keyframes."""

    def __init__(self) -> None:
        self.count = 0
        self._chunks: dict[int, dict[frozenset[KeyframeKey], Pair]] = {}
        self._chunk_of: dict[frozenset[KeyframeKey], int] = {}
        self._of_keyframe: dict[KeyframeKey, set[frozenset[KeyframeKey]]] = {}

    def add(self, a: KeyframeKey, b: KeyframeKey) -> int:
        """Add a loop; return its chunk."""
        pair = frozenset((a, b))
        if pair in self._chunk_of:
            return self._chunk_of[pair]
        chunk = self.count // _LOOPS_PER_CHUNK
        self.count += 1
        self._chunks.setdefault(chunk, {})[pair] = (a, b)
        self._chunk_of[pair] = chunk
        for key in (a, b):
            self._of_keyframe.setdefault(key, set()).add(pair)
        return chunk

    def remove(self, a: KeyframeKey, b: KeyframeKey) -> set[int]:
        """Remove the loop between two keyframes; return the chunk that it was in, if any."""
        pair = frozenset((a, b))
        if (chunk := self._chunk_of.pop(pair, None)) is None:
            return set()
        del self._chunks[chunk][pair]
        for key in (a, b):
            self._of_keyframe[key].discard(pair)
        return {chunk}

    def remove_keyframe(self, key: KeyframeKey) -> set[int]:
        """Remove the loops of a keyframe; return the chunks that they were in."""
        pairs = [tuple(pair) for pair in self._of_keyframe.pop(key, set())]
        chunks = set[int]()
        for pair in pairs:
            other = next((end for end in pair if end != key), key)
            self._of_keyframe.setdefault(key, set())
            chunks |= self.remove(key, other)
        self._of_keyframe.pop(key, None)
        return chunks

    def __iter__(self) -> Iterator[Pair]:
        for chunk in self._chunks.values():
            yield from chunk.values()

    def chunk(self, chunk: int) -> list[Pair]:
        """Return the loops of a chunk."""
        return list(self._chunks.get(chunk, {}).values())
