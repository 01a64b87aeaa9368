"""Malicious files are refused in one line, or skipped, in little time and memory."""

from __future__ import annotations

import json
import os
import struct
import zlib

import cv2
import numpy as np
import pytest
from helpers.live import RIG, frames
from helpers.recordings import HEIGHT, WIDTH, depth_mm, make_euroc, make_tum, picture
from helpers.special_files import KINDS, special

from share.config import Config
from share.errors import CalibrationMismatchError, ConfigError, DataError, one_line
from share.files.json_file import read_json
from share.files.line_file import LineFile
from share.files.reading import path_inside, read_bytes
from share.files.writing import atomic_write, open_new
from share.files.yaml_file import read_yaml
from share.recordings.calibration import read_calibration
from share.recordings.images import EncodedImage
from share.recordings.mcap.recorder import Recorder
from share.recordings.session import read_session
from share.recordings.tables import longest_nondecreasing, read_table
from share.runtime.pipeline import read_frames
from share.runtime.source import open_source
from share.sensors.sequencer import SequencerCounters
from share.strict_yaml import load_yaml
from share.vision.image_codec import decode_gray, image_header

pytestmark = pytest.mark.usefixtures("soon")


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
        ("a: &a [*a]", "alias 'a' contains itself"),
        ("a: " + "9" * 100_000, "number of 100000 characters"),
        ("a: 0x" + "f" * 100_000, "number of 100002 characters"),
        ("a: " + ":".join(["59"] * 100_000), "number of 299999 characters"),
        ("a: 2026-99-99", "does not match its tag"),
        ("a: !!bool maybe", "does not match its tag"),
        ("a: !!int ''", "does not match its tag"),
        ("a: !!python/object/apply:os.system [id]", "could not determine a constructor"),
        ("a: \0", "special characters are not allowed"),
        ("[1, 2", "not valid YAML"),
    ],
)
def test_yaml_beyond_the_limits_is_refused(text, says):
    with pytest.raises(ConfigError, match=says) as error:
        load_yaml(text, "x.yaml")
    assert str(error.value).startswith("x.yaml")


def test_ordinary_yaml_is_accepted():
    assert load_yaml("a: &a [1, 2.5]\nb: *a\nc: {<<: {d: 1e-3}}\ne: 2026-11-26", "x")["b"] == [1, 2.5]
    assert load_yaml("[" * 30 + "]" * 30, "x")


@pytest.mark.long
def test_every_yaml_reader_has_the_limits(tmp_path, share):
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


def test_deeply_nested_json_is_refused(tmp_path):
    (tmp_path / "x.json").write_text('{"a":' + "[" * 200_000)
    with pytest.raises(DataError, match="is damaged"):
        read_json(tmp_path / "x.json")


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("intrinsics", "[1e-300, 1e-300, 30, 20]", "are not within"),
        ("intrinsics", "[1e308, 50, 30, 20]", "beyond 1e\\+09"),
        ("intrinsics", "[1e8, 50, 30, 20]", "are not within"),
        ("intrinsics", "[.nan, 50, 30, 20]", "not finite"),
        ("intrinsics", "[.inf, 50, 30, 20]", "not finite"),
        ("intrinsics", "[a, 50, 30, 20]", "expected numbers"),
        ("intrinsics", "[50, 50, 1e8, 20]", "principal point"),
        ("resolution", "[1000000000, 1000000000]", "above the maximum of"),
        ("resolution", "[64.5, 48]", "whole numbers"),
        ("resolution", "[-64, 48]", "not positive"),
        ("distortion_coefficients", "[1e8, 0, 0, 0]", "has coefficients beyond"),
        ("T_BS", "5", "expected a 4x4 matrix"),
        ("T_BS", "{data: [[[1]]]}", "expected a 4x4 matrix, found 1 numbers"),
        ("T_BS", "[[1,0,0,0],[0,2,0,0],[0,0,1,0],[0,0,0,1]]", "not a rigid transform"),
        ("T_BS", "[[1,0,0,1e300],[0,1,0,0],[0,0,1,0],[0,0,0,1]]", "beyond 1e\\+09"),
    ],
)
def test_calibrations_of_impossible_cameras_are_refused(tmp_path, key, value, says):
    room = make_euroc(tmp_path / "room")
    sheet = room / "mav0/cam0/sensor.yaml"
    kept = [line for line in sheet.read_text().splitlines() if not line.startswith((key, "  ", "T_BS"))]
    if key != "T_BS":
        kept.append("T_BS: [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]")
    sheet.write_text("\n".join([*kept, f"{key}: {value}", ""]))
    with pytest.raises(ConfigError, match=says):
        open_source(str(room))


# ------------------------------------------------------------------ what is no regular file


@pytest.mark.parametrize("kind", KINDS)
def test_only_regular_files_are_read(tmp_path, kind):
    special(tmp_path / "x.yaml", kind)
    with pytest.raises(OSError, match=f"a {kind}, not a regular file"):
        read_bytes(tmp_path / "x.yaml", 100)
    with pytest.raises(ConfigError, match=f"a {kind}, not a regular file"):
        read_yaml(tmp_path / "x.yaml")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("file", ["rgb/2.jpg", "depth/2.png"])
def test_an_image_that_is_a_special_file_is_skipped(tmp_path, kind, file):
    room = make_tum(tmp_path / "room", frames=30)
    (room / file).unlink()
    special(room / file, kind)
    source = open_source(str(room))
    assert len(list(read_frames(source, Config(), SequencerCounters()))) == 29
    (said,) = source.losses.lines()
    assert f"a {kind}, not a regular file" in said


@pytest.mark.parametrize("name", ["camera.yaml", "rgb.txt", "depth.txt", "groundtruth.txt"])
def test_an_endless_table_or_calibration_is_refused(tmp_path, name, share):
    room = make_tum(tmp_path / "room")
    (room / name).unlink()
    (room / name).symlink_to("/dev/zero")
    done = share("track", room)
    if name != "groundtruth.txt":  # which then is not there
        assert done.code in (1, 2) and done.err.count("\n") == 1


def test_oversized_files_are_refused_and_links_followed(tmp_path):
    with (tmp_path / "x.yaml").open("wb") as file:
        file.truncate(10**12)  # takes no disk
    with pytest.raises(ConfigError, match=r"it has 1,000,000\.0 MB; the limit for this kind is 2\.0 MB"):
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
def test_an_image_that_claims_a_huge_size_is_not_decoded(monkeypatch, make, size):
    if make is _jpeg_of and max(size) > 65_535:
        pytest.skip("JPEG has 16 bits for it")
    data = make(*size)
    monkeypatch.setattr(cv2, "imdecode", None)  # would be a TypeError
    assert image_header(data)[:2] == size
    with pytest.raises(
        CalibrationMismatchError, match=f"is {size[0]}x{size[1]}, but the calibration is for 64x48"
    ):
        EncodedImage(data, "x", WIDTH, HEIGHT).load()
    with pytest.raises(DataError, match="more than any camera takes"):
        decode_gray(data, "x")


def test_a_jpeg_with_too_many_scans_is_not_decoded():
    data = cv2.imencode(".jpg", picture(1), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    with pytest.raises(DataError, match="scans, more than any camera"):
        EncodedImage(data[:-2] + b"\xff\xda" * 300 + data[-2:], "x", WIDTH, HEIGHT).load()


def test_parsed_headers_agree_with_the_decoder():
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
def test_a_damaged_image_is_skipped_and_the_next_frame_gets_its_imu_samples(tmp_path, damage, number):
    room = make_euroc(tmp_path / "room", frames=8)
    whole = frames(open_source(str(room)))
    names = [line.split(",")[1] for line in (room / "mav0/cam0/data.csv").read_text().splitlines()[1:]]
    (room / "mav0/cam0/data" / names[number]).write_bytes(damage)
    source = open_source(str(room))
    out = list(read_frames(source, Config(), SequencerCounters()))
    assert [f.stamp_ns for f in out] == [f.stamp_ns for k, f in enumerate(whole) if k != number]
    at = min(number, len(out) - 1)
    expected = np.concatenate([whole[number].imu.stamps_ns, whole[number + 1].imu.stamps_ns])
    np.testing.assert_array_equal(out[at].imu.stamps_ns, expected)
    assert source.losses.counts == {"frames": 1}


def test_a_recording_of_another_image_size_is_refused_at_its_first_image(tmp_path):
    room = make_euroc(tmp_path / "room", frames=30)
    sheet = room / "mav0/cam0/sensor.yaml"
    sheet.write_text(sheet.read_text().replace("[64, 48]", "[32, 24]"))
    with pytest.raises(CalibrationMismatchError, match="is 64x48, but the calibration is for 32x24"):
        list(read_frames(open_source(str(room)), Config(), SequencerCounters()))


# ------------------------------------------------------------------ tables, paths, names


def test_out_of_order_stamps_drop_as_few_lines_as_possible():
    assert longest_nondecreasing(np.array([1, 2, 9, 3, 3, 4])).tolist() == [
        True,
        True,
        False,
        True,
        True,
        True,
    ]
    assert longest_nondecreasing(np.arange(200_000)[::-1]).sum() == 1


def test_a_line_of_100_mb_gives_a_short_error(tmp_path):
    (tmp_path / "x.csv").write_bytes(b"1,2\n" + b"9" * 20_000_000 + b",1\n1,1\n1,1\n")
    with pytest.raises(DataError) as error:
        read_table(tmp_path / "x.csv", 2)
    assert len(str(error.value)) < 400


def test_an_error_is_one_line_whatever_it_quotes():
    assert one_line("a\nb\x1b[2J\0c") == "a\\nb\\x1b[2J\\x00c"
    assert len(one_line("x" * 10**6)) < 1600


@pytest.mark.parametrize("name", ["../x", "/etc/passwd", "a/../../x", "a\0b", "", "x" * 300, "a/" * 600])
def test_listed_paths_cannot_leave_their_folder(tmp_path, name):
    with pytest.raises(DataError, match="is not a file name below"):
        path_inside(tmp_path, name, "x.csv, line 1")
    assert path_inside(tmp_path, "rgb/1.png", "") == tmp_path / "rgb/1.png"


@pytest.mark.parametrize("name", ["../x", "/etc/x", "a\\0b", "x" * 1_000, ".hidden", "a b", ""])
def test_invalid_agent_names_in_a_session_are_refused(tmp_path, name):
    agent = "{kind: ar, sensors: stereo, rate_hz: 20}"
    (tmp_path / "session.yaml").write_text(f'schema: 1\nagents: {{"{name}": {agent}}}\n')
    with pytest.raises(ConfigError, match="is not a valid agent name; use 1 to 64 letters"):
        read_session(tmp_path)
    for calibration in ("../calib.yaml", "/etc/passwd"):
        text = f"schema: 1\nagents: {{ann: {{kind: ar, calibration: {calibration}}}}}\n"
        (tmp_path / "session.yaml").write_text(text)
        with pytest.raises(DataError, match="is not a file name below"):
            read_session(tmp_path)


# ------------------------------------------------------------------ what is written


def test_nothing_is_written_through_a_link_in_the_folder(tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("dear")
    for name, write in (
        ("report.json", lambda path: atomic_write(path, "new")),
        ("events.jsonl", lambda path: LineFile(path, print).close()),
        ("log", lambda path: open_new(path).close()),
        ("x.mcap.part", lambda path: Recorder(path.with_suffix(""), RIG).abort()),
    ):
        for link in (os.symlink, os.link):
            path = tmp_path / name
            path.unlink(missing_ok=True)
            link(precious, path)
            write(path)
            assert not path.is_symlink() and path.is_file()
            assert precious.read_text() == "dear"


# ------------------------------------------------------------------ reports


def test_calibration_folders_and_reports_have_the_same_limits(tmp_path):
    (tmp_path / "r.json").write_text(json.dumps([1]))
    with pytest.raises(DataError, match="not a JSON object"):
        read_json(tmp_path / "r.json")
    with pytest.raises(ConfigError):
        read_calibration(tmp_path)
