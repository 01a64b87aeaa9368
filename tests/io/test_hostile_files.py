"""Files made to hurt: each is refused in one line, or costs itself, in little time and memory."""

from __future__ import annotations

import json
import os
import socket
import sqlite3
import struct
import time
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from live import RIG, frames, live
from map_changes import ANN, pose, small_map
from recordings import HEIGHT, STEP_NS, WIDTH, depth_mm, make_euroc, make_tum, picture

from share.config import Config
from share.core.keeping import KeepLink, Kept
from share.core.measurement import Measurement
from share.core.sequencer import SequencerCounters
from share.errors import ConfigError, DataError, MisfitError, ShareError, UsageError, one_line
from share.geometry import se3
from share.io.calibration import read_calibration
from share.io.files import atomic_write, fresh
from share.io.image_header import image_header
from share.io.images import ArrayImage, EncodedImage, decode_gray
from share.io.inside import inside
from share.io.json_file import read_json
from share.io.line_file import LineFile
from share.io.map_store import MapStore
from share.io.mcap.chunks import MOST_CHUNK
from share.io.mcap.recorder import Recorder
from share.io.mcap.recover import recover
from share.io.regular_file import read_bytes
from share.io.section import read_yaml
from share.io.session import read_session
from share.io.source import open_source
from share.io.tables import longest_rising, read_table
from share.merge.join import Key
from share.run.pipeline import frames_of
from share.strict import load_yaml

SOON_S = 20.0  # of CPU time, generous: most take milliseconds


@pytest.fixture(autouse=True)
def soon():
    began = time.process_time()
    yield
    assert time.process_time() - began < SOON_S


# ------------------------------------------------------------------ YAML and JSON

BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{k}: &{k} [{','.join([f'*{before}'] * 9)}]\n" for before, k in zip("abcdefgh", "bcdefghi", strict=True)
)
MERGES = "a: &a {x: 1}\n" + "".join(
    f"{k}: &{k} {{<<: [{','.join([f'*{before}'] * 9)}]}}\n"
    for before, k in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[" * 100_000, "nested deeper than 40"),
        ("{a: " * 100_000, "nested deeper than 40"),
        ("- " * 100_000, "nested deeper than 40"),
        (BOMB, "more than 200,000 values, aliases counted in full"),
        (MERGES, "more than 200,000 values, aliases counted in full"),
        ("a: &a [*a]", "alias 'a' stands within what it stands for"),
        ("a: " + "9" * 100_000, "a number of 100000 characters"),
        ("a: 0x" + "f" * 100_000, "a number of 100002 characters"),
        ("a: " + ":".join(["59"] * 100_000), "a number of 299999 characters"),
        ("a: 2026-99-99", "is not what its tag says"),
        ("a: !!bool maybe", "is not what its tag says"),
        ("a: !!int ''", "is not what its tag says"),
        ("a: !!python/object/apply:os.system [id]", "could not determine a constructor"),
        ("a: \0", "special characters are not allowed"),
        ("[1, 2", "not valid YAML"),
    ],
)
def test_yaml_that_asks_for_more_than_settings_need(text, says):
    with pytest.raises(ConfigError, match=says) as error:
        load_yaml(text, "x.yaml")
    assert str(error.value).startswith("x.yaml")


def test_yaml_that_is_honest_stays():
    assert load_yaml("a: &a [1, 2.5]\nb: *a\nc: {<<: {d: 1e-3}}\ne: 2026-11-26", "x")["b"] == [1, 2.5]
    assert load_yaml("[" * 30 + "]" * 30, "x")


def test_yaml_is_bounded_in_every_place_it_is_read(tmp_path, share):
    deep = tmp_path / "deep.yaml"
    deep.write_text("a: " + "[" * 10_000)
    room = make_euroc(tmp_path / "room")
    for arguments in (
        ["track", room, "--config", deep],
        ["track", room, "--calib", deep],
        ["emulate", "--scene", "plain", "--motion", "walk:", "--profile", deep, "--out", tmp_path / "x"],
        ["calibrate", "target", "--target", deep, "--out", tmp_path / "x.pdf"],
    ):
        done = share(*arguments)
        assert (done.code, done.err.count("\n")) == (2, 1), done.err
    (tmp_path / "session.yaml").write_text("a: " + "[" * 10_000)
    assert "nested deeper" in share("dataset", "info", tmp_path / "ann").err
    (room / "mav0/cam0/sensor.yaml").write_text("a: " + "[" * 10_000)
    assert "nested deeper" in share("track", room).err


def test_json_that_is_nested_without_end(tmp_path):
    (tmp_path / "x.json").write_text('{"a":' + "[" * 200_000)
    with pytest.raises(DataError, match="is damaged"):
        read_json(tmp_path / "x.json")


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("intrinsics", "[1e-300, 1e-300, 30, 20]", "no camera's"),
        ("intrinsics", "[1e308, 50, 30, 20]", "no camera's"),
        ("intrinsics", "[.nan, 50, 30, 20]", "not finite"),
        ("intrinsics", "[.inf, 50, 30, 20]", "not finite"),
        ("intrinsics", "[a, 50, 30, 20]", "expected numbers"),
        ("intrinsics", "[50, 50, 1e300, 20]", "principal point"),
        ("resolution", "[1000000000, 1000000000]", "more than a camera has"),
        ("resolution", "[64.5, 48]", "whole numbers"),
        ("resolution", "[-64, 48]", "not positive"),
        ("distortion_coefficients", "[1e300, 0, 0, 0]", "no lens's"),
        ("T_BS", "5", "expected a 4x4 matrix"),
        ("T_BS", "{data: [[[1]]]}", "expected a 4x4 matrix, found 1 numbers"),
        ("T_BS", "[[1,0,0,0],[0,2,0,0],[0,0,1,0],[0,0,0,1]]", "not a rigid transform"),
        ("T_BS", "[[1,0,0,1e300],[0,1,0,0],[0,0,1,0],[0,0,0,1]]", "not a rigid transform"),
    ],
)
def test_calibrations_of_no_camera(tmp_path, key, value, says):
    room = make_euroc(tmp_path / "room")
    sheet = room / "mav0/cam0/sensor.yaml"
    kept = [line for line in sheet.read_text().splitlines() if not line.startswith((key, "  ", "T_BS"))]
    if key != "T_BS":
        kept.append("T_BS: [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]")
    sheet.write_text("\n".join([*kept, f"{key}: {value}", ""]))
    with pytest.raises(ConfigError, match=says):
        open_source(str(room))


# ------------------------------------------------------------------ what is no regular file


def _special(path: Path, kind: str) -> None:
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "device":
            path.symlink_to("/dev/zero")
        case "folder":
            path.mkdir()
        case "socket":
            server = socket.socket(socket.AF_UNIX)
            here = os.getcwd()
            os.chdir(path.parent)  # a socket's path is short
            server.bind(path.name)
            os.chdir(here)
            server.close()


KINDS = ("pipe", "device", "folder", "socket")


@pytest.mark.parametrize("kind", KINDS)
def test_only_regular_files_are_read(tmp_path, kind):
    _special(tmp_path / "x.yaml", kind)
    with pytest.raises(OSError, match=f"a {kind}, not a regular file"):
        read_bytes(tmp_path / "x.yaml", 100)
    with pytest.raises(ConfigError, match=f"a {kind}, not a regular file"):
        read_yaml(tmp_path / "x.yaml")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("file", ["rgb/2.jpg", "depth/2.png"])
def test_an_image_that_is_no_file_costs_itself(tmp_path, kind, file):
    room = make_tum(tmp_path / "room", frames=30)
    (room / file).unlink()
    _special(room / file, kind)
    source = open_source(str(room))
    assert len(list(frames_of(source, Config(), SequencerCounters()))) == 29
    (said,) = source.losses.lines()
    assert f"a {kind}, not a regular file" in said


@pytest.mark.parametrize("name", ["camera.yaml", "rgb.txt", "depth.txt", "groundtruth.txt"])
def test_a_table_or_calibration_that_never_ends(tmp_path, name, share):
    room = make_tum(tmp_path / "room")
    (room / name).unlink()
    (room / name).symlink_to("/dev/zero")
    done = share("track", room)
    if name != "groundtruth.txt":  # which then is not there
        assert done.code in (1, 2) and done.err.count("\n") == 1


def test_files_larger_than_their_kind_is_and_links_to_regular_files(tmp_path):
    with (tmp_path / "x.yaml").open("wb") as file:
        file.truncate(10**12)  # takes no disk
    with pytest.raises(ConfigError, match=r"it has 1,000,000\.0 MB, a file of this kind may have 2\.0 MB"):
        read_yaml(tmp_path / "x.yaml")
    (tmp_path / "x.csv").write_bytes(b"1,2\0")
    with pytest.raises(DataError, match="is not a text file"):
        read_table(tmp_path / "x.csv", 2)
    (tmp_path / "real.yaml").write_text("a: 1")
    (tmp_path / "link.yaml").symlink_to("real.yaml")
    assert read_yaml(tmp_path / "link.yaml").data == {"a": 1}


# ------------------------------------------------------------------ images


def _png_of(width: int, height: int, bits: int = 8) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")


def _jpeg_of(width: int, height: int) -> bytes:
    data = bytearray(cv2.imencode(".jpg", picture(1))[1].tobytes())
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(data)


@pytest.mark.parametrize("size", [(65_500, 65_500), (30_000, 30_000), (2**31 - 1, 1), (0, 0)])
@pytest.mark.parametrize("make", [_png_of, _jpeg_of])
def test_an_image_that_says_that_it_is_huge_is_never_decoded(monkeypatch, make, size):
    if make is _jpeg_of and max(size) > 65_535:
        pytest.skip("JPEG has 16 bits for it")
    data = make(*size)
    monkeypatch.setattr(cv2, "imdecode", None)  # would be a TypeError
    assert image_header(data)[:2] == size
    with pytest.raises(MisfitError, match=f"is {size[0]}x{size[1]}, but the calibration is for 64x48"):
        EncodedImage(data, "x", WIDTH, HEIGHT).load()
    with pytest.raises(DataError, match="which no camera takes"):
        decode_gray(data, "x")


def test_a_jpeg_of_very_many_scans_is_not_decoded():
    data = cv2.imencode(".jpg", picture(1), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    with pytest.raises(DataError, match="scans, which no camera takes"):
        EncodedImage(data[:-2] + b"\xff\xda" * 300 + data[-2:], "x", WIDTH, HEIGHT).load()


def test_headers_agree_with_the_decoder():
    for image, depth in ((picture(1), False), (picture(1, 3), False), (depth_mm(1), True)):
        for suffix in (".png",) if depth else (".png", ".jpg"):
            header = image_header(cv2.imencode(suffix, image)[1].tobytes())
            assert header is not None and header[:3] == (WIDTH, HEIGHT, depth)
    progressive = cv2.imencode(".jpg", picture(1), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    assert image_header(progressive)[:2] == (WIDTH, HEIGHT)
    for nothing in (
        b"",
        b"\x89PNG\r\n\x1a\n",
        b"\xff\xd8",
        b"\xff\xd8\xff\xe0\0\0" * 50,
        b"\xff\xd8" + b"\xff" * 99,
    ):
        assert image_header(nothing) is None


@pytest.mark.parametrize("damage", [_png_of(65_500, 65_500), b"", b"\xff\xd8\xff\xd9", _jpeg_of(640, 480)])
@pytest.mark.parametrize("number", [0, 3])
def test_one_damaged_image_costs_itself_and_its_imu_samples_go_to_the_next(tmp_path, damage, number):
    room = make_euroc(tmp_path / "room", frames=8)
    whole = frames(open_source(str(room)))
    names = [line.split(",")[1] for line in (room / "mav0/cam0/data.csv").read_text().splitlines()[1:]]
    (room / "mav0/cam0/data" / names[number]).write_bytes(damage)
    source = open_source(str(room))
    out = list(frames_of(source, Config(), SequencerCounters()))
    assert [f.stamp_ns for f in out] == [f.stamp_ns for k, f in enumerate(whole) if k != number]
    at = min(number, len(out) - 1)
    expected = np.concatenate([whole[number].imu.stamps_ns, whole[number + 1].imu.stamps_ns])
    np.testing.assert_array_equal(out[at].imu.stamps_ns, expected)
    assert source.losses.counts == {"frames": 1}


def test_a_recording_of_another_size_is_refused_soon(tmp_path):
    room = make_euroc(tmp_path / "room", frames=30)
    sheet = room / "mav0/cam0/sensor.yaml"
    sheet.write_text(sheet.read_text().replace("[64, 48]", "[32, 24]"))
    with pytest.raises(MisfitError, match="is 64x48, but the calibration is for 32x24"):
        list(frames_of(open_source(str(room)), Config(), SequencerCounters()))


# ------------------------------------------------------------------ tables, paths, names


def test_stamps_in_disorder_cost_the_fewest_lines_that_they_can():
    assert longest_rising(np.array([1, 2, 9, 3, 3, 4])).tolist() == [True, True, False, True, True, True]
    assert longest_rising(np.arange(200_000)[::-1]).sum() == 1


def test_a_line_of_100_mb_is_one_short_complaint(tmp_path):
    (tmp_path / "x.csv").write_bytes(b"1,2\n" + b"9" * 20_000_000 + b",1\n1,1\n1,1\n")
    with pytest.raises(DataError) as error:
        read_table(tmp_path / "x.csv", 2)
    assert len(str(error.value)) < 400


def test_a_message_is_one_line_whatever_it_quotes():
    assert one_line("a\nb\x1b[2J\0c") == "a\\nb\\x1b[2J\\x00c"
    assert len(one_line("x" * 10**6)) < 1600


@pytest.mark.parametrize("name", ["../x", "/etc/passwd", "a/../../x", "a\0b", "", "x" * 300, "a/" * 600])
def test_paths_in_files_stay_in_their_folder(tmp_path, name):
    with pytest.raises(DataError, match="is no name of a file below"):
        inside(tmp_path, name, "x.csv, line 1")
    assert inside(tmp_path, "rgb/1.png", "") == tmp_path / "rgb/1.png"


@pytest.mark.parametrize("name", ["../x", "/etc/x", "a\\0b", "x" * 1_000, ".hidden", "a b", ""])
def test_names_of_agents_in_a_session(tmp_path, name):
    agent = "{kind: ar, sensors: stereo, rate_hz: 20}"
    (tmp_path / "session.yaml").write_text(f'schema: 1\nagents: {{"{name}": {agent}}}\n')
    with pytest.raises(ConfigError, match="is no name of an agent: use 1 to 64 letters"):
        read_session(tmp_path)
    for calibration in ("../calib.yaml", "/etc/passwd"):
        text = f"schema: 1\nagents: {{ann: {{kind: ar, calibration: {calibration}}}}}\n"
        (tmp_path / "session.yaml").write_text(text)
        with pytest.raises(DataError, match="is no name of a file below"):
            read_session(tmp_path)


# ------------------------------------------------------------------ what is written


def test_nothing_is_written_through_a_link_in_the_folder(tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("dear")
    for name, write in (
        ("report.json", lambda path: atomic_write(path, "new")),
        ("events.jsonl", lambda path: LineFile(path, print).close()),
        ("log", lambda path: fresh(path).close()),
        ("x.mcap.part", lambda path: Recorder(path.with_suffix(""), RIG).abort()),
    ):
        for link in (os.symlink, os.link):
            path = tmp_path / name
            path.unlink(missing_ok=True)
            link(precious, path)
            write(path)
            assert not path.is_symlink() and path.is_file()
            assert precious.read_text() == "dear"


# ------------------------------------------------------------------ MCAP


def _chunk(compression: str, data: bytes, said: int) -> bytes:
    """An MCAP file of one chunk."""
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
def test_a_chunk_is_unpacked_no_further_than_it_says(tmp_path, compression, said):
    import lz4.frame
    import zstandard
    from mcap.records import Chunk

    from share.io.mcap.chunks import records_of
    from share.io.mcap.file import damage

    pack = zstandard.ZstdCompressor().compress if compression == "zstd" else lz4.frame.compress
    data = pack(bytes(50 * 10**6))
    with pytest.raises(damage()):
        records_of(Chunk(compression, data, 10, 0, 0, said))
    (tmp_path / "x.mcap").write_bytes(_chunk(compression, data, said))
    with pytest.raises(DataError, match="holds no complete message"):
        recover(tmp_path / "x.mcap", tmp_path / "y.mcap")
    with pytest.raises(ShareError):
        list(open_source(str(tmp_path / "x.mcap")).measurements())
    assert MOST_CHUNK < 2 * 10**9


def _recorded(path: Path, images: int = 40) -> Path:
    with Recorder(path, RIG) as recorder:
        for m in live(images):
            recorder.write(m)
    return path


def test_a_message_that_cannot_be_read_costs_itself(tmp_path):
    path = tmp_path / "a.mcap"
    with Recorder(path, RIG) as recorder:
        for k, m in enumerate(live(100)):
            recorder.write(m)
            if k == 100:
                broken = (b"", b"\0\1\0\0", b"\xff" * 40, bytes(8) + b"\xff" * 300)
                for number, data in enumerate(broken):
                    for channel in recorder._channels.values():
                        recorder._writer.add_message(channel, recorder._log_ns + number, data, 0, 0)
    source = open_source(str(path))
    out = frames(source)
    assert [f.stamp_ns for f in out] == [10**9 + k * STEP_NS for k in range(100)]
    topics = ("/imu0", "/cam0/image_raw", "/depth/image_raw")
    assert source.losses.counts == {f"messages of {topic}": 4 for topic in topics}


def test_an_image_message_of_an_absurd_size_and_a_sample_that_is_not_finite(tmp_path):
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
    assert len(list(frames_of(source, Config(), SequencerCounters()))) == 39
    assert "is 5000x3, but the calibration is for 64x48" in source.losses.lines()[0]


@pytest.mark.parametrize(
    "attack", ["twice", "outside", "elsewhere", "summary at the front", "no such channel"]
)
def test_an_index_that_leads_astray(tmp_path, attack):
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
    with pytest.raises(DataError, match="share dataset recover"):
        frames(open_source(str(tmp_path / "b.mcap")))


# ------------------------------------------------------------------ map files


def filled(path: Path) -> Kept:
    T, cov = se3.inverse(pose(0)) @ pose(2), np.eye(6) * 1e-4
    with MapStore.open(path) as store:
        store.write([*small_map(), KeepLink(Key(ANN, 2), 0, T, cov)])
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
def test_a_map_whose_tables_are_not_ours_is_read_without_them(tmp_path, name):
    path = tmp_path / "map.sqlite"
    kept = filled(path)
    with sqlite3.connect(path) as db:
        for statement in EVIL[name]:
            db.execute(statement)
    db.close()
    found = MapStore.read(path).load()
    assert "damaged" in found.complaints[0]
    if "keyframe" not in name:
        assert len(found.keyframes) == len(kept.keyframes)
    with MapStore.open(path) as store:
        assert store.writable
    with sqlite3.connect(path) as db:
        kinds = db.execute("SELECT DISTINCT type FROM sqlite_schema").fetchall()
    db.close()
    assert {kind for (kind,) in kinds} <= {"table", "index"}


def test_rows_that_say_what_cannot_be_cost_themselves(tmp_path):
    from share.io.map_store.rows import COLUMNS, check

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
                (*row, check(table, number, tuple(row)), number),
            )
        db.execute("UPDATE run SET next = 1")
    db.close()
    found = MapStore.read(path).load()
    assert len(found.keyframes) == len(kept.keyframes)
    assert len(found.loops) == len(kept.loops) - 1
    assert found.poses is None
    said = " ".join(found.complaints)
    for what in (
        "odometry edges could not be read",
        "loops could not be read",
        "solutions could not be read",
    ):
        assert what in said


@pytest.mark.parametrize("kind", KINDS)
def test_a_map_that_is_no_file(tmp_path, kind):
    _special(tmp_path / "map.sqlite", kind)
    with pytest.raises(UsageError):
        MapStore.read(tmp_path / "map.sqlite")
    with pytest.raises(ShareError):
        MapStore.open(tmp_path / "map.sqlite")


# ------------------------------------------------------------------ reports


def test_calibration_folders_and_reports_are_read_like_all_else(tmp_path):
    (tmp_path / "r.json").write_text(json.dumps([1]))
    with pytest.raises(DataError, match="no JSON object"):
        read_json(tmp_path / "r.json")
    with pytest.raises(ConfigError):
        read_calibration(tmp_path)
