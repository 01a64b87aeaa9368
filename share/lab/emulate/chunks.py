"""A few encoded frames of one agent on disk until its recording is written, so that an interrupted session
can be resumed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec

from share.errors import DataError
from share.files.reading import MAX_ARRAYS_BYTES, read_bytes
from share.files.writing import atomic_write
from share.recordings.images import EncodedImage
from share.sensors.measurement import DEPTH, Measurement

DEPTH_SCALE = 1000.0  # per metre: millimetres


class EncodedPicture(msgspec.Struct, frozen=True, array_like=True):
    """One image as recorded: JPEG or PNG."""

    stream: str
    stamp_ns: int
    width: int
    height: int
    data: bytes


def write_chunk(path: Path, pictures: list[EncodedPicture]) -> None:
    """Write the chunk atomically. Raises as `atomic_write`."""
    atomic_write(path, msgspec.msgpack.encode(pictures))


def read_chunk(path: Path) -> Iterator[Measurement]:
    """Yield the images in the order in which they were written. Raises DataError if the chunk is damaged."""
    try:
        pictures = msgspec.msgpack.decode(read_bytes(path, MAX_ARRAYS_BYTES), type=list[EncodedPicture])
    except (OSError, msgspec.DecodeError, msgspec.ValidationError) as error:
        raise DataError(f"{path}: is damaged ({error}); delete it and run the command again") from None
    for p in pictures:
        yield Measurement(p.stream, p.stamp_ns, encoded_image(p, str(path)))


def encoded_image(p: EncodedPicture, where: str) -> EncodedImage:
    """Return the image as a reader does. where: named in errors."""
    return EncodedImage(p.data, where, p.width, p.height, DEPTH_SCALE if p.stream == DEPTH else 0.0)
