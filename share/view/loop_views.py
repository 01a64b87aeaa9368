"""Loops in the live room: their lines, in chunks that are drawn together; small pictures of the newest
keyframes, to show those of a loop; and the loop nearest to a click."""

from __future__ import annotations

import base64
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from html import escape

import cv2
import numpy as np

from share.errors import DataError
from share.mapping.loops import KeyframeKey
from share.types import F64, U8
from share.vision.image_codec import decode_gray

Pair = tuple[KeyframeKey, KeyframeKey]

_LOOPS_PER_CHUNK = 64
_KEPT = 3000  # pictures; 10 kB each
_WIDTH_PX, _QUALITY = 320, 70
_MOST_ANGLE_RAD = 0.05  # between a click's ray and a loop


class LoopLines:
    """Loops between keyframes in the order in which they were accepted. count: of all that were ever added,
    one of each two keyframes."""

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


@dataclass(frozen=True)
class LoopViews:
    """The two keyframes of a loop: titles (agent, id) and JPEGs, b"" if no longer kept."""

    titles: tuple[str, str]
    jpegs: tuple[bytes, bytes]

    def html(self) -> str:
        """Return the pictures with their titles."""
        return "".join(map(_figure, self.titles, self.jpegs))


def _figure(title: str, jpeg: bytes) -> str:
    """Return a picture with its title as HTML."""
    data = base64.b64encode(jpeg).decode()
    picture = (
        f'<img style="max-width:100%;max-height:34vh" src="data:image/jpeg;base64,{data}">'
        if jpeg
        else "image no longer kept"
    )
    return f'<figure style="margin:0 0 10px"><figcaption>{escape(title)}</figcaption>{picture}</figure>'


class KeyframePictures:
    """Small pictures of the newest keyframes."""

    def __init__(self) -> None:
        self._jpegs: OrderedDict[KeyframeKey, bytes] = OrderedDict()

    def add(self, key: KeyframeKey, jpeg: bytes) -> None:
        """Keep a keyframe's picture; one that cannot be decoded is left out."""
        if (small := shrunk(jpeg, _WIDTH_PX)) is None:
            return
        is_done, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        if is_done:
            self._jpegs[key] = data.tobytes()
            if len(self._jpegs) > _KEPT:
                self._jpegs.popitem(last=False)

    def remove(self, key: KeyframeKey) -> None:
        self._jpegs.pop(key, None)

    def get(self, key: KeyframeKey) -> bytes:
        return self._jpegs.get(key, b"")


def shrunk(jpeg: bytes, width: int) -> U8 | None:
    """Return a JPEG as a small gray image (h, width); None if it cannot be decoded."""
    try:
        image = decode_gray(jpeg, "image")
    except DataError:
        return None
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def nearest_to_ray(points: F64, origin: F64, direction: F64) -> int | None:
    """Return which of points (N, 3) is nearest to a ray, seen from its origin; None if none is near."""
    if not len(points):
        return None
    away = points - origin
    along = away @ (direction / np.linalg.norm(direction))
    angle = np.arccos(np.clip(along / np.maximum(np.linalg.norm(away, axis=1), 1e-9), -1, 1))
    best = int(np.argmin(angle))
    return best if angle[best] < _MOST_ANGLE_RAD else None
