"""Encode messages to byte frames and decode them; the format is in docs/lookup/wire.md.

The first frame is a small msgpack header: wire version, message code, scalar fields, and dtype and shape of
each array. Each array follows in its own frame, little-endian, C order, not copied. A declared size is
compared with the bytes received before anything is allocated. What each message consists of:
`share.wire.layouts`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, TypeVar

import msgspec

from share.errors import VersionError, WireError, printable
from share.wire import messages as m
from share.wire.layouts import KEYFRAME_WITHOUT_IMAGE, LAYOUTS, MESSAGE_TYPES, Bytes, Header, encode_plain

M = TypeVar("M", bound=m.Message)

WIRE_VERSION = 8
OLDEST_VERSION = 2  # the STABLE_MESSAGES have not changed since
MAX_HEADER_BYTES = 4096
_IMAGE_VERSION = 6  # of the first keyframes with an image; map files keep older ones
STABLE_MESSAGES = (m.Ping, m.Pong, m.Refused)  # the same since OLDEST_VERSION: peers find a mismatch by them


class _VersionHeader(msgspec.Struct, array_like=True):
    """The start of a header, the same in all versions."""

    version: int
    code: Any = None


_decode_version = msgspec.msgpack.Decoder(_VersionHeader).decode
_decode_header = msgspec.msgpack.Decoder(Header).decode

# All that msgspec, numpy and our own validation raise on bad bytes.
_DECODE_ERRORS = (msgspec.MsgspecError, ValueError, OverflowError, RecursionError)


def encode(message: m.Message, version: int | None = None) -> list[Bytes]:
    """Return the frames of a message; array frames are views of its (read-only) arrays.

    version: another than ours only for STABLE_MESSAGES. Raises WireError if a field does not fit the wire, so
    every sent message can be decoded.
    """
    version = WIRE_VERSION if version is None else version
    assert version == WIRE_VERSION or isinstance(message, STABLE_MESSAGES)
    layout = LAYOUTS[type(message)]
    arrays = [array.get(message) for array in layout.arrays]
    table = [(field.dtype, array.shape) for field, array in zip(layout.arrays, arrays, strict=True)]
    try:
        scalars = layout.encode_scalars(message)
    except _DECODE_ERRORS as error:
        raise _wire_error(type(message).__name__, error) from None
    header = encode_plain((version, layout.code, scalars, table))
    return [header, *(array.data.cast("B") if array.size else b"" for array in arrays)]


def decode(frames: Sequence[Bytes], versions: Sequence[int] = (WIRE_VERSION,)) -> m.Message:
    """Return the message in `frames`; its arrays may be read-only views of them.

    versions: accepted ones; stored messages may have several. Raises VersionError for others, else WireError.
    """
    kind = message_type(frames, versions)
    try:
        header = _decode_header(frames[0])
        layout = LAYOUTS[kind]
        if header.code == KEYFRAME_WITHOUT_IMAGE.code and header.version < _IMAGE_VERSION:
            layout = KEYFRAME_WITHOUT_IMAGE
        return layout.build(**layout.decode_scalars(header.scalars), **layout.decode_arrays(header, frames))
    except _DECODE_ERRORS as error:
        raise _wire_error(kind.__name__, error) from None


def decode_only(frames: Sequence[Bytes], *kinds: type[M]) -> M | None:
    """Return the message if its header says one of these kinds, else None, without reading the rest. Raises
    as `decode`."""
    if message_type(frames) not in kinds:
        return None
    message = decode(frames)
    assert isinstance(message, kinds)
    return message


def message_type(frames: Sequence[Bytes], versions: Sequence[int] = (WIRE_VERSION,)) -> type[m.Message]:
    """Return what `frames` say they are, from the start of the header alone: the rest may be invalid.

    Raises as `decode`.
    """
    if not frames:
        raise WireError("empty message")
    if (header_bytes := memoryview(frames[0]).nbytes) > MAX_HEADER_BYTES:
        raise WireError(f"header of {header_bytes} bytes, at most {MAX_HEADER_BYTES}")
    try:
        start = _decode_version(frames[0])
    except _DECODE_ERRORS as error:
        raise _wire_error("header", error) from None
    code = start.code if isinstance(start.code, int) else None
    if start.version not in versions:
        raise VersionError(start.version, code, WIRE_VERSION)
    if code is None or (kind := MESSAGE_TYPES.get(code)) is None:
        raise WireError(f"unknown message type {printable(repr(start.code))[:40]}")
    return kind


def message_bytes(frames: Sequence[Bytes]) -> int:
    """Return the size of a message without the transport's overhead (ZMTP: 2 or 9 bytes a frame)."""
    return sum([memoryview(frame).nbytes for frame in frames])


# A peer's text in an error, as repr quotes it. It may have any length, so it is cut before the line is.
_QUOTED = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*\"""")
_MAX_QUOTED = 40  # characters


def _shorten_quote(match: re.Match[str]) -> str:
    text = match[0]
    return text if len(text) <= _MAX_QUOTED + 2 else f"{text[:_MAX_QUOTED]}…{text[0]}"


def _wire_error(where: str, error: Exception) -> WireError:
    """Return a WireError of one short printable line; quotes of the peer's text are cut but stay closed."""
    text = _QUOTED.sub(_shorten_quote, str(error))
    return WireError(printable(f"{where}: {text}")[:200])
