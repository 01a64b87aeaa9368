"""Malicious MCAP recordings and map files are refused in one line, or lose the damaged parts only."""

from __future__ import annotations

import sqlite3
import struct
from pathlib import Path

import numpy as np
import pytest
from helpers.live import RIG, frames, live
from helpers.map_changes import ANN, pose, small_map
from helpers.recordings import STEP_NS
from helpers.special_files import KINDS, special

from share.config import Config
from share.errors import DataError, ShareError, UsageError
from share.geometry import se3
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import SaveLink, StoredMap
from share.recordings.images import ArrayImage
from share.recordings.mcap.file import MAX_CHUNK_BYTES
from share.recordings.mcap.recorder import Recorder, recover_recording
from share.runtime.pipeline import read_frames
from share.runtime.source import open_source
from share.sensors.measurement import Measurement
from share.sensors.sequencer import SequencerCounters
from share.store.map_store import MapStore

pytestmark = pytest.mark.usefixtures("soon")


# ------------------------------------------------------------------ MCAP


def _chunk(compression: str, data: bytes, said: int) -> bytes:
    """Return an MCAP file of one chunk."""
    body = struct.pack("<QQQI", 0, 10, said, 0) + struct.pack("<I", len(compression)) + compression.encode()
    body += struct.pack("<Q", len(data)) + data
    head = struct.pack("<BQ", 1, 8) + bytes(8)
    chunk = struct.pack("<BQ", 6, len(body)) + body
    at = 8 + len(head)
    index = struct.pack("<QQQQ", 0, 10, at, len(chunk)) + struct.pack("<IQ", 0, 0)
    index += struct.pack("<I", len(compression)) + compression.encode() + struct.pack("<QQ", len(data), said)
    index = struct.pack("<BQ", 8, len(index)) + index
    end = struct.pack("<BQI", 15, 4, 0)
    footer = struct.pack("<BQQQI", 2, 20, at + len(chunk) + len(end), 0, 0)
    magic = b"\x89MCAP0\r\n"
    return magic + head + chunk + end + index + footer + magic


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("said", [1000, 2 * 10**9, 2**63])
def test_a_chunk_is_unpacked_only_to_its_declared_size(tmp_path, compression, said):
    import lz4.frame
    import zstandard
    from mcap.records import Chunk

    from share.recordings.mcap.file import chunk_records, damage_errors

    pack = zstandard.ZstdCompressor().compress if compression == "zstd" else lz4.frame.compress
    data = pack(bytes(50 * 10**6))
    with pytest.raises(damage_errors()):
        chunk_records(Chunk(compression, data, 10, 0, 0, said))
    (tmp_path / "x.mcap").write_bytes(_chunk(compression, data, said))
    with pytest.raises(DataError, match="has no complete message"):
        recover_recording(tmp_path / "x.mcap", tmp_path / "y.mcap")
    with pytest.raises(ShareError):
        list(open_source(str(tmp_path / "x.mcap")).measurements())
    assert MAX_CHUNK_BYTES < 2 * 10**9


def _recorded(path: Path, images: int = 40) -> Path:
    with Recorder(path, RIG) as recorder:
        for m in live(images):
            recorder.write(m)
    return path


def test_unreadable_messages_are_skipped(tmp_path):
    path = tmp_path / "a.mcap"
    with Recorder(path, RIG) as recorder:
        for k, m in enumerate(live(100)):
            recorder.write(m)
            if k == 100:
                broken = (b"", b"\0\1\0\0", b"\xff" * 40, bytes(8) + b"\xff" * 300)
                for number, data in enumerate(broken):
                    writer = recorder._writer
                    for channel in writer._channels.values():
                        writer._writer.add_message(channel, recorder._log_ns + number, data, 0, 0)
    source = open_source(str(path))
    out = frames(source)
    assert [f.stamp_ns for f in out] == [10**9 + k * STEP_NS for k in range(100)]
    topics = ("/imu0", "/cam0/image_raw", "/depth/image_raw")
    assert source.losses.counts == {f"messages of {topic}": 4 for topic in topics}


def test_absurd_image_sizes_and_non_finite_samples_are_skipped(tmp_path):
    path = tmp_path / "a.mcap"
    with Recorder(path, RIG) as recorder:
        for m in live(40):
            recorder.write(m)
            if m.stamp_ns == 10**9 + 20 * STEP_NS and m.stream == "imu":
                recorder.write(Measurement("imu", m.stamp_ns - 1, (np.nan, 0, 0, 0, 0, 9.8)))
    source = open_source(str(path))
    assert len(frames(source)) == 40
    assert source.losses.counts == {"messages of /imu0": 1}
    other = tmp_path / "b.mcap"
    with Recorder(other, RIG) as recorder:
        for m in live(40):
            wrong = m.stream == "cam0" and m.stamp_ns == 10**9 + 20 * STEP_NS
            recorder.write(
                Measurement("cam0", m.stamp_ns, ArrayImage(np.zeros((3, 5000), np.uint8))) if wrong else m
            )
    source = open_source(str(other))
    assert len(list(read_frames(source, Config(), SequencerCounters()))) == 39
    assert "is 5000x3, but the calibration is for 64x48" in source.losses.lines()[0]


@pytest.mark.parametrize(
    "attack", ["twice", "outside", "elsewhere", "summary at the front", "no such channel"]
)
def test_an_invalid_index_is_refused(tmp_path, attack):
    from mcap.reader import SeekingReader

    data = _recorded(tmp_path / "a.mcap").read_bytes()
    with (tmp_path / "a.mcap").open("rb") as file:
        summary = SeekingReader(file).get_summary()
        first, second = summary.chunk_indexes[:2]
    old, new = struct.pack("<QQ", first.chunk_start_offset, first.chunk_length), None
    match attack:
        case "twice":
            new = struct.pack("<QQ", second.chunk_start_offset, second.chunk_length)
        case "outside":
            new = struct.pack("<QQ", 2**62, first.chunk_length)
        case "elsewhere":
            channel, offset = next(iter(first.message_index_offsets.items()))
            old, new = struct.pack("<HQ", channel, offset), struct.pack("<HQ", channel, 30)
        case "no such channel":
            channel, offset = next(iter(first.message_index_offsets.items()))
            old, new = struct.pack("<HQ", channel, offset), struct.pack("<HQ", 999, offset)
        case "summary at the front":
            start = data.rindex(struct.pack("<BQ", 2, 20)) + 9
            old, new = data[start : start + 8], struct.pack("<Q", 8)
    assert old in data
    (tmp_path / "b.mcap").write_bytes(new.join(data.rsplit(old, 1)))
    if attack == "summary at the front":  # all of the file is read as one, which is no harm
        assert len(frames(open_source(str(tmp_path / "b.mcap")))) == 40
        return
    with pytest.raises(DataError, match="share dataset recover"):
        frames(open_source(str(tmp_path / "b.mcap")))


# ------------------------------------------------------------------ map files


def filled(path: Path) -> StoredMap:
    T, cov = se3.inverse(pose(0)) @ pose(2), np.eye(6) * 1e-4
    with MapStore.open(path) as store:
        store.write([*small_map(), SaveLink(KeyframeKey(ANN, 2), 0, T, cov)])
    return MapStore.read(path).load()


FOREVER = "WITH RECURSIVE r(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM r) SELECT x AS number"
EVIL = {
    "about is a view that never ends": (
        "DROP TABLE about",
        f"CREATE VIEW about AS {FOREVER}, 'schema' AS name, '3' AS value, 0 AS crc FROM r",
    ),
    "keyframe is a view that never ends": (
        "DROP TABLE keyframe",
        f"CREATE VIEW keyframe AS {FOREVER}, 'r' AS run, x AS id, 0 AS stretch, 0 AS ordinal, 3 AS codec,"
        " x'' AS message, 0 AS crc FROM r",
    ),
    "a trigger": ("CREATE TRIGGER t AFTER INSERT ON run BEGIN DELETE FROM keyframe; END",),
    "a virtual table": ("DROP TABLE loop", "CREATE VIRTUAL TABLE loop USING fts5(a_run)"),
    "a generated column": (
        "DROP TABLE loop",
        "CREATE TABLE loop(number INTEGER PRIMARY KEY, a_run TEXT, a_id INTEGER, b_run TEXT, b_id INTEGER,"
        " T_a_b BLOB AS (zeroblob(1000000000)), cov BLOB, inliers INTEGER, found REAL, crc INTEGER)",
    ),
}


@pytest.mark.parametrize("name", EVIL)
def test_foreign_tables_of_a_map_are_ignored(tmp_path, name):
    path = tmp_path / "map.sqlite"
    kept = filled(path)
    with sqlite3.connect(path) as db:
        for statement in EVIL[name]:
            db.execute(statement)
    db.close()
    found = MapStore.read(path).load()
    assert "damaged" in found.problems[0]
    if "keyframe" not in name:
        assert len(found.keyframes) == len(kept.keyframes)
    with MapStore.open(path) as store:
        assert store.writable
    with sqlite3.connect(path) as db:
        kinds = db.execute("SELECT DISTINCT type FROM sqlite_schema").fetchall()
    db.close()
    assert {kind for (kind,) in kinds} <= {"table", "index"}


def test_invalid_rows_of_a_map_are_skipped(tmp_path):
    from share.store.rows import COLUMNS, row_crc

    path = tmp_path / "map.sqlite"
    kept = filled(path)
    far = np.eye(4)
    far[0, 3] = 1e308
    changes = {
        "link": {"T_ref_body": far.tobytes()},
        "loop": {"cov": (-np.eye(6)).tobytes(), "inliers": 10**15},
        "poses": {"T_map_body": np.full((len(kept.poses.keys), 4, 4), np.nan).tobytes()},
    }
    with sqlite3.connect(path) as db:
        for table, change in changes.items():
            names = ("number", *COLUMNS[table])
            number, *row = db.execute(
                f"SELECT {', '.join(names)} FROM {table} ORDER BY number LIMIT 1"
            ).fetchone()
            row = [change.get(name, value) for name, value in zip(COLUMNS[table], row, strict=True)]
            sets = ", ".join(f"{name} = ?" for name in (*COLUMNS[table], "crc"))
            db.execute(
                f"UPDATE {table} SET {sets} WHERE number = ?",
                (*row, row_crc(table, number, tuple(row)), number),
            )
        db.execute("UPDATE run SET next = 1")
    db.close()
    found = MapStore.read(path).load()
    assert len(found.keyframes) == len(kept.keyframes)
    assert len(found.loops) == len(kept.loops) - 1
    assert found.poses is None
    said = " ".join(found.problems)
    for what in (
        "odometry edges could not be read",
        "loops could not be read",
        "solutions could not be read",
    ):
        assert what in said


@pytest.mark.parametrize("kind", KINDS)
def test_a_map_that_is_a_special_file_is_refused(tmp_path, kind):
    special(tmp_path / "map.sqlite", kind)
    with pytest.raises(UsageError):
        MapStore.read(tmp_path / "map.sqlite")
    with pytest.raises(ShareError):
        MapStore.open(tmp_path / "map.sqlite")
