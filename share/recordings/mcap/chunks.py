"""Read the chunks and the summary of an untrusted MCAP file: every declared size and offset is checked.

A few kilobytes of zstd or lz4 can unpack to gigabytes, a record may claim to be longer than its file, and an
index may point anywhere, many times. The file's own size bounds all of it.
"""

from __future__ import annotations

import os
import zlib
from typing import IO, Any

from share.files.reading import MB

MAX_CHUNK_BYTES = 128 * MB  # unpacked; writers close a chunk at 0.2 to 4 MB, or after a single image
MAX_HELD_BYTES = 4 * MAX_CHUNK_BYTES  # messages in memory of chunks that overlap in time
_MAX_WINDOW_LOG2 = 27  # zstd window, log2 of bytes
_RECORD_HEAD_BYTES = 1 + 8  # opcode, length


class BoundedFile:
    """A file whose reads are limited to what is left: Python allocates the size asked for beforehand."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._size = os.fstat(file.fileno()).st_size
        self.seek, self.tell = file.seek, file.tell

    def read(self, count: int = -1) -> bytes:
        left = max(0, self._size - self._file.tell())
        return self._file.read(left if count < 0 else min(count, left))


def chunk_records(chunk: Any) -> list[Any]:
    """Return the records in a chunk. Raises the errors in `share.recordings.mcap.file.damage_errors`."""
    from mcap.records import Chunk
    from mcap.stream_reader import CRCValidationError, breakup_chunk

    data = _decompress(chunk)
    if chunk.uncompressed_crc and (crc := zlib.crc32(data)) != chunk.uncompressed_crc:
        raise CRCValidationError(chunk.uncompressed_crc, crc, chunk)
    plain = Chunk("", data, chunk.message_end_time, chunk.message_start_time, 0, len(data))
    return list(breakup_chunk(plain))


def _decompress(chunk: Any) -> bytes:
    """Unpack a chunk to exactly its declared size; never hold more than that."""
    from mcap.exceptions import McapError, UnsupportedCompressionError

    declared_size = chunk.uncompressed_size
    if declared_size > MAX_CHUNK_BYTES:
        raise McapError(f"a chunk has {declared_size / MB:,.0f} MB, the limit is {MAX_CHUNK_BYTES / MB:g}")
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
        raise McapError(f"a chunk does not unpack to its declared {declared_size} bytes")
    return data


def _decompress_zstd(data: bytes, declared_size: int) -> bytes:
    import zstandard
    from mcap.exceptions import McapError

    head = zstandard.get_frame_parameters(data)
    if (
        head.content_size not in (declared_size, zstandard.CONTENTSIZE_UNKNOWN)
        or head.window_size > 1 << _MAX_WINDOW_LOG2
    ):
        raise McapError(f"a chunk declares {declared_size} bytes, its zstd frame {head.content_size}")
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=declared_size + 1)


def read_summary(file: IO[bytes]) -> Any | None:
    """Return the summary at the end of a file; None if it has none.

    Raises the errors in `damage_errors`; McapError also for chunks that overlap or lie outside the file.
    """
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
    """Iterate over the records from the position of `file`; chunks are not unpacked."""
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
    """Raise McapError unless reading all chunks reads each byte of the file at most once."""
    from mcap.exceptions import McapError

    end = 0
    for chunk in sorted(summary.chunk_indexes, key=lambda chunk: int(chunk.chunk_start_offset)):
        index = chunk.chunk_start_offset + chunk.chunk_length
        after = index + chunk.message_index_length
        offsets = chunk.message_index_offsets
        if chunk.chunk_start_offset < end or after > size or chunk.chunk_length < _RECORD_HEAD_BYTES:
            raise McapError("its index points out of the file, or to one chunk twice")
        if (
            any(not index <= offset < after for offset in offsets.values())
            or offsets.keys() - summary.channels
        ):
            raise McapError("its index points to messages outside of its chunks")
        end = after
