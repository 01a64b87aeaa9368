"""Malicious recordings of the RealSense SDK (SQLite) are refused, or lose the damaged samples only."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from helpers.live import frames
from helpers.made_db3 import ACCEL, DEPTH, EYE, image, make_db3, motion, text
from helpers.special_files import KINDS, special

from share.config import Config
from share.errors import DataError, ShareError
from share.lab.calibrate.imu_table import read_imu
from share.recordings import realsense
from share.recordings.calibration import kalibr_texts
from share.runtime.pipeline import read_frames
from share.runtime.source import open_source
from share.sensors.sequencer import SequencerCounters

pytestmark = pytest.mark.usefixtures("soon")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return make_db3(tmp_path / "a.db3", 24)


def change(path: Path, *statements: str, values: tuple[object, ...] = ()) -> None:
    with sqlite3.connect(path) as connection:
        for statement in statements:
            connection.execute(statement, values)
    connection.close()


def read(path: Path) -> tuple[int, dict[str, int]]:
    """Return the number of frames and the losses."""
    source = open_source(str(path))
    return len(list(read_frames(source, Config(), SequencerCounters()))), source.losses.counts


def test_an_intact_recording_is_read_without_losses(path):
    assert read(path) == (24, {})
    odd = path.with_name("a?mode=rwc#%41.db3")
    path.rename(odd)
    assert read(odd) == (24, {})
    assert os.listdir(path.parent) == [odd.name]  # nothing is made beside it


FOREVER = "WITH RECURSIVE r(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM r) SELECT x AS id"
NOT_OURS = {
    "topics is a view that never ends": (
        "DROP TABLE topics",
        f"CREATE VIEW topics AS {FOREVER}, 'n' || x AS name FROM r",
    ),
    "messages is a view that never ends": (
        "ALTER TABLE messages RENAME TO m",
        f"CREATE VIEW messages AS {FOREVER}, 1 AS topic_id, 1 AS timestamp, x'' AS data FROM r",
    ),
    "messages is a view of what is there": (
        "ALTER TABLE messages RENAME TO m",
        "CREATE VIEW messages AS SELECT * FROM m",
    ),
    "messages is a virtual table": (
        "DROP TABLE messages",
        "CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data)",
    ),
    "data are computed": (
        "DROP TABLE messages",
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data AS (zeroblob(2000000000)))",
    ),
    "rows without numbers": (
        "DROP TABLE messages",
        "CREATE TABLE messages(id TEXT PRIMARY KEY, topic_id, timestamp, data) WITHOUT ROWID",
    ),
    "no data": ("ALTER TABLE messages DROP COLUMN data",),
}


@pytest.mark.parametrize("name", NOT_OURS)
def test_tables_of_another_kind_are_refused(path, name):
    change(path, *NOT_OURS[name])
    with pytest.raises(DataError, match="is not a recording of the RealSense SDK, or damaged"):
        open_source(str(path))


def test_triggers_and_views_are_never_run(path):
    change(
        path,
        "CREATE TRIGGER t AFTER INSERT ON topics BEGIN DELETE FROM messages; END",
        f"CREATE VIEW v AS {FOREVER} FROM r",
        "CREATE INDEX i ON messages(topic_id) WHERE topic_id < 0",
    )
    assert read(path) == (24, {})


def test_the_cost_of_a_query_is_bounded(path, monkeypatch):
    """Rows of other topics may be any number."""
    monkeypatch.setattr("share.files.sqlite_file._MIN_STEPS", 1000)
    monkeypatch.setattr("share.files.sqlite_file._STEPS_PER_BYTE", 0)
    monkeypatch.setattr("share.files.sqlite_file.STEPS_PER_CHECK", 100)
    with pytest.raises(DataError, match="interrupted"):
        open_source(str(path))


@pytest.mark.parametrize("name", [b"\xff\xfe", 5, None, 1.5, "x" * 10_000])
def test_invalid_topic_names_are_ignored(path, name):
    change(path, "DROP TABLE topics", "CREATE TABLE topics(id INTEGER PRIMARY KEY, name)")
    change(path, "INSERT INTO topics(name) VALUES (?)", values=(name,))
    with pytest.raises(ShareError, match="has no compressed left infrared images"):
        open_source(str(path))


def topic(path: Path, name: str) -> int:
    with sqlite3.connect(path) as connection:
        (found,) = connection.execute("SELECT id FROM topics WHERE name = ?", (name,)).fetchone()
    connection.close()
    return int(found)


def spoil(path: Path, name: str, data: object, count: int = 1) -> None:
    """Overwrite messages of a topic, from the second on."""
    query = (
        f"UPDATE messages SET data = ? WHERE id IN "
        f"(SELECT id FROM messages WHERE topic_id = {topic(path, name)} ORDER BY id LIMIT {count} OFFSET 1)"
    )
    change(path, query, values=(data,))


EYE_DATA, EYE_TOLD = f"{EYE}/image/data/compressed", f"{EYE}/image/metadata"
ACCEL_DATA, ACCEL_TOLD = f"{ACCEL}/imu/data", f"{ACCEL}/imu/metadata"
TOLD = "timestamp={};timestamp_domain=Hardware Clock;Frame number={}"


@pytest.mark.parametrize("data", [b"", b"\0", b"\xff" * 100, "text", 5, 2.5])
@pytest.mark.parametrize("name", [EYE_DATA, EYE_TOLD, ACCEL_DATA, ACCEL_TOLD])
def test_a_damaged_message_is_skipped(path, name, data):
    spoil(path, name, data)
    seen, lost = read(path)
    assert seen == (24 if "imu" in name else 23)
    assert sum(lost.values()) == 1


BAD_STAMPS, BAD_NUMBERS = ("nan", "inf", "1e300", "-1e300", "", "x"), ("9" * 30, "-" + "9" * 5000, "x", "1.5")


@pytest.mark.parametrize(
    ("topic", "metadata", "result"),
    [
        *((ACCEL_TOLD, TOLD.format(stamp, 3), (24, {"samples of accel": 1})) for stamp in BAD_STAMPS),
        *((EYE_TOLD, TOLD.format(1100, number), (23, {"samples of cam0": 1})) for number in BAD_NUMBERS),
    ],
)
def test_a_sample_with_an_invalid_stamp_or_frame_number_is_skipped(path, topic, metadata, result):
    spoil(path, topic, text(metadata))
    assert read(path) == result


def test_invalid_samples_and_images_are_skipped(path):
    spoil(path, ACCEL_DATA, motion(1, (0, 0, 0), (np.nan, 0.0, np.inf)))
    spoil(path, EYE_DATA, image(1, b"no image"))
    seen, lost = read(path)
    assert (seen, lost["samples of accel"], lost["frames"]) == (23, 1, 1)
    assert read_imu(str(path)).dropped >= 1


def test_an_oversized_message_is_not_read(path, monkeypatch):
    monkeypatch.setattr(realsense, "MAX_MESSAGE_BYTES", 100_000)
    change(path, "UPDATE messages SET data = zeroblob(200000) WHERE id = (SELECT id FROM messages "
           f"WHERE topic_id = {topic(path, EYE_DATA)} LIMIT 1)")  # fmt: skip
    assert read(path) == (23, {"samples of cam0": 1})


def test_more_than_5_percent_of_damaged_samples_are_refused(path):
    spoil(path, ACCEL_DATA, b"", 100)
    with pytest.raises(DataError, match="samples of accel are damaged: too many to skip"):
        read(path)


UNIT, BAD_UNITS = (
    f"{DEPTH.rpartition('/')[0]}/option/Depth_Units/value",
    ("0", "nan", "inf", "-1", "x", "1e-300"),
)
BAD_LENSES = (
    "",
    "width=x",
    "width=1000000000;height=1000000000",
    "width=64;height=48;fx=nan;fy=1;ppx=1;ppy=1",
)


@pytest.mark.parametrize(
    ("topic", "value", "complaint"),
    [
        *((UNIT, unit, "is not a number from 1e-06 to 1") for unit in (*BAD_UNITS, "9" * 400)),
        *((f"{ACCEL}/info", f"fps={rate}", r"is not a number from 0\.1 to 100000") for rate in BAD_UNITS[:5]),
        *((f"{EYE}/camera_info", lens, "calibration of cam0") for lens in BAD_LENSES),
    ],
)
def test_an_invalid_depth_unit_rate_or_lens_is_refused(tmp_path, topic, value, complaint):
    with pytest.raises(DataError, match=complaint):
        open_source(str(make_db3(tmp_path / "a.db3", 2, {topic: value})))


def test_a_calibrated_imu_that_was_not_recorded_is_left_out(path, tmp_path):
    source = open_source(str(path))
    assert source.rig.kind == "stereo+imu"
    for name, chain in kalibr_texts(source.rig, "made").items():
        (tmp_path / name).write_text(chain)
    change(path, f"UPDATE topics SET name = 'x' || id WHERE name LIKE '{ACCEL}%'")
    tracked = open_source(str(path), calib=str(tmp_path))
    assert tracked.rig.kind == "stereo"
    assert len(frames(tracked)) == 24


def test_a_serial_number_with_control_characters_is_ignored(tmp_path):
    serial = "Serial Number=\x1b[2J"
    assert open_source(str(make_db3(tmp_path / "a.db3", 2, {"/device_0/info": serial}))).serial is None


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("suffix", ["", "-wal"])
def test_a_special_file_is_refused(path, kind, suffix):
    file = path.with_name(path.name + suffix)
    file.unlink(missing_ok=True)
    special(file, kind)
    with pytest.raises(ShareError):
        read(path)


def test_a_sparse_file_is_refused(path):
    os.truncate(path, 10**12)
    with pytest.raises(DataError, match="nearly all holes"):
        read(path)


def test_frames_have_the_stamps_of_the_device(path):
    source = open_source(str(path))
    assert [f.stamp_ns for f in frames(source)] == [10**9 + k * 10**8 + 99 * 10**6 for k in range(24)]
