"""Chunks of an MCAP file, and its summary, read so that no declared size is believed.

A few kilobytes of zstd or lz4 can stand for gigabytes, a record may claim to be longer than its file, and an
index may lead anywhere, many times: all of it is bounded by what the file itself has.
"""

from __future__ import annotations

import os
import zlib
from typing import IO, Any

from share.files.reading import MB

MAX_CHUNK_BYTES = 128 * MB  # unpacked; writers close one at 0.2 to 4 MB, or behind a single image
MAX_HELD_BYTES = 4 * MAX_CHUNK_BYTES  # of messages of chunks that overlap in time
_MAX_WINDOW_LOG2 = 27  # log2 of what zstd looks back
_RECORD_HEAD_BYTES = 1 + 8  # bytes of a record's head: opcode, length


class BoundedFile:
    """A file that is asked for no more than it has: Python reserves what is asked for beforehand."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._size = os.fstat(file.fileno()).st_size
        self.seek, self.tell = file.seek, file.tell

    def read(self, count: int = -1) -> bytes:
        left = max(0, self._size - self._file.tell())
        return self._file.read(left if count < 0 else min(count, left))


def chunk_records(chunk: Any) -> list[Any]:
    """The records in a chunk. Raises what `share.recordings.mcap.file.damage` lists."""
    from mcap.records import Chunk
    from mcap.stream_reader import CRCValidationError, breakup_chunk

    data = _decompress(chunk)
    if chunk.uncompressed_crc and (crc := zlib.crc32(data)) != chunk.uncompressed_crc:
        raise CRCValidationError(chunk.uncompressed_crc, crc, chunk)
    plain = Chunk("", data, chunk.message_end_time, chunk.message_start_time, 0, len(data))
    return list(breakup_chunk(plain))


def _decompress(chunk: Any) -> bytes:
    """Of the size that the chunk says, and no byte more while it is unpacked."""
    from mcap.exceptions import McapError, UnsupportedCompressionError

    declared_size = chunk.uncompressed_size
    if declared_size > MAX_CHUNK_BYTES:
        raise McapError(f"a chunk of {declared_size / MB:,.0f} MB, more than {MAX_CHUNK_BYTES / MB:g}")
    match chunk.compression:
        case "zstd":
            data = _decompress_zstd(chunk.data, declared_size)
        case "lz4":
            import lz4.frame  # type: ignore[import-untyped]

            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=declared_size + 1)
        case "":
            data = chunk.data
        case other:
            raise UnsupportedCompressionError(other)
    if len(data) != declared_size:
        raise McapError(f"a chunk has not the {declared_size} bytes that it says")
    return data


def _decompress_zstd(data: bytes, declared_size: int) -> bytes:
    import zstandard
    from mcap.exceptions import McapError

    head = zstandard.get_frame_parameters(data)
    if (
        head.content_size not in (declared_size, zstandard.CONTENTSIZE_UNKNOWN)
        or head.window_size > 1 << _MAX_WINDOW_LOG2
    ):
        raise McapError(f"a chunk of {declared_size} bytes says inside that it has {head.content_size}")
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=declared_size + 1)


def read_summary(file: IO[bytes]) -> Any | None:
    """The summary at the end, None where it has none. Raises what `damage` lists; McapError also for chunks
    that overlap in the file or lie outside it."""
    from mcap.exceptions import McapError
    from mcap.reader import FOOTER_SIZE
    from mcap.records import Footer
    from mcap.stream_reader import MAGIC_SIZE

    size = os.fstat(file.fileno()).st_size
    file.seek(size - FOOTER_SIZE - MAGIC_SIZE)
    footer = next(_records(file))
    if not isinstance(footer, Footer):
        raise McapError("it has no footer")
    if footer.summary_start == 0:
        return None
    file.seek(footer.summary_start)
    summary = _collect_summary(_records(file))
    _check_index_offsets(summary, size)
    return summary


def _records(file: IO[bytes]) -> Any:
    """From where `file` is, chunks as they are."""
    from mcap.stream_reader import StreamReader

    return StreamReader(BoundedFile(file), skip_magic=True, emit_chunks=True, record_size_limit=2**30).records


def _collect_summary(records: Any) -> Any:
    from mcap import records as kinds
    from mcap.summary import Summary

    summary = Summary()
    for record in records:
        match record:
            case kinds.Statistics():
                summary.statistics = record
            case kinds.Schema():
                summary.schemas[record.id] = record
            case kinds.Channel():
                summary.channels[record.id] = record
            case kinds.ChunkIndex():
                summary.chunk_indexes.append(record)
            case kinds.MetadataIndex():
                summary.metadata_indexes.append(record)
    return summary


def _check_index_offsets(summary: Any, size: int) -> None:
    """So that reading all of it is reading the file once."""
    from mcap.exceptions import McapError

    end = 0
    for chunk in sorted(summary.chunk_indexes, key=lambda chunk: int(chunk.chunk_start_offset)):
        index = chunk.chunk_start_offset + chunk.chunk_length
        after = index + chunk.message_index_length
        offsets = chunk.message_index_offsets
        if chunk.chunk_start_offset < end or after > size or chunk.chunk_length < _RECORD_HEAD_BYTES:
            raise McapError("its index leads out of the file, or to one chunk twice")
        if (
            any(not index <= offset < after for offset in offsets.values())
            or offsets.keys() - summary.channels
        ):
            raise McapError("its index leads to no messages of its chunks")
        end = after
