"""`share dataset` as real processes: output, exit codes, one clear line."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.live import RIG, live
from helpers.recordings import make_euroc, make_tum

from share.recordings.calibration import kalibr_texts
from share.recordings.mcap.recorder import Recorder


def share(*arguments: object) -> subprocess.CompletedProcess:
    program = "from share.cli.main import main; main()"
    command = [sys.executable, "-c", program, "dataset", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


def good(*arguments: object) -> str:
    done = share(*arguments)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def bad(code: int, *arguments: object) -> str:
    """Return the one error line."""
    done = share(*arguments)
    assert done.returncode == code, done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("share: ")
    assert done.stdout == ""
    return done.stderr


@pytest.fixture
def walk(tmp_path):
    return make_euroc(tmp_path / "walk")


def test_info(walk):
    text = good("info", walk)
    assert text.startswith("walk: stereo+imu, 0.")
    assert "cam0         6 at 20 Hz" in text
    assert "imu         71 at 200 Hz" in text
    assert "baseline 11.00 cm" in text
    assert "truth  6 poses, 0.50 m" in text
    data = json.loads(good("info", walk, "--json", "--frames", "1:4"))
    assert data["streams"]["cam1"]["count"] == 3
    assert data["calibration"]["cam0"]["resolution"] == [64, 48]


@pytest.mark.long
def test_convert_and_recover(walk, tmp_path):
    first, second, saved = (tmp_path / "out" / f"{n}.mcap" for n in ("first", "second", "saved"))
    assert good("convert", walk, "--out", first) == f"{first}: 6 frames\n"
    assert good("convert", first, "--out", second) == f"{second}: 6 frames\n"
    one, two = (json.loads(good("info", p, "--json")) for p in (first, second))
    assert {**one, "name": ""} == {**two, "name": ""}
    assert second.with_name("second.truth.tum").read_text() == first.with_name("first.truth.tum").read_text()
    first.write_bytes(first.read_bytes()[:-2000])
    assert "share dataset recover" in bad(1, "info", first)
    text = good("recover", first, "--out", saved)
    assert text.startswith(f"{saved}: ")
    assert json.loads(good("info", saved, "--json"))["streams"]["cam0"]["count"] == 6
    assert "exists and is not overwritten" in bad(2, "recover", first, "--out", saved)
    whole = good("recover", second, "--out", tmp_path / "whole.mcap")
    assert whole.splitlines()[-1] == f"nothing was lost: {second} can be deleted"


@pytest.mark.long
def test_convert_to_euroc_and_jpeg(walk, tmp_path):
    good("convert", walk, "--out", tmp_path / "asl", "--format", "euroc")
    assert (tmp_path / "asl" / "mav0" / "cam1" / "sensor.yaml").read_text().startswith("%YAML:1.0\n")
    good("convert", walk, "--out", tmp_path / "small.mcap", "--jpeg", "20", "--frames", ":3")
    assert json.loads(good("info", tmp_path / "small.mcap", "--json"))["streams"]["cam0"]["count"] == 3
    assert "not an empty folder" in bad(2, "convert", walk, "--out", tmp_path / "asl", "--format", "euroc")


@pytest.mark.long
def test_wrong_use(walk, tmp_path):
    assert "no such file" in bad(2, "info", tmp_path / "no")
    assert "not a recording that SHARE reads" in bad(2, "info", tmp_path)
    assert "share capture" in bad(2, "info", "realsense")
    assert "ends in .mcap" in bad(2, "convert", walk, "--out", tmp_path / "x.bag")
    assert "below a file" in bad(2, "convert", walk, "--out", walk / "mav0/cam0/data.csv/x.mcap")
    assert "cannot be written" in bad(2, "convert", walk, "--out", "/proc/share/x.mcap")
    assert "selects nothing" in bad(2, "convert", walk, "--out", tmp_path / "x.mcap", "--frames", "9:12")
    assert "no such file" in bad(2, "recover", tmp_path / "no.mcap", "--out", tmp_path / "x.mcap")
    good("convert", walk, "--out", tmp_path / "x.mcap")
    assert "is the source itself" in bad(2, "convert", tmp_path / "x.mcap", "--out", tmp_path / "x.mcap")


def test_damaged_source_leaves_no_partial_output(tmp_path):
    folder = make_tum(tmp_path / "kitchen")
    for image in (folder / "depth" / "3.png", folder / "depth" / "4.png"):
        image.write_bytes(image.read_bytes()[:-20])
    out = tmp_path / "out"
    assert "3.png: the image is cut short" in bad(1, "convert", folder, "--out", out / "x.mcap")
    assert os.listdir(out) == []


@pytest.mark.long
def test_full_disk_is_one_line_and_leaves_no_output(walk, tmp_path):
    out = tmp_path / "out"
    program = "from share.cli.main import main; main()"
    limited = 'ulimit -f 16; exec "$@"'  # blocks of 1 kB
    command = ["bash", "-c", limited, "-", sys.executable, "-c", program, "dataset", "convert", str(walk)]
    done = subprocess.run([*command, "--out", str(out / "x.mcap")], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (1, f"share: {out}/x.mcap: cannot be written: File too large\n")
    assert os.listdir(out) == []


@pytest.mark.parametrize("command", ["info", "convert", "recover"])
def test_help_has_an_example(command):
    assert f"Example:  share dataset {command} " in good(command, "--help")


def test_real_recording(shared_data: Path):
    data = json.loads(good("info", shared_data / "real" / "redkitchen_0000_0499", "--json"))
    assert data["kind"] == "rgbd"
    assert data["streams"]["depth"] == {
        "count": 500,
        "rate_hz": 30.0,
        "gaps": 0,
        "longest_gap_s": 0.0,
        "duplicates": 0,
        "backward": 0,
    }
    assert data["truth"]["poses"] == 500


@pytest.mark.long
def test_calibration_of_another_device_gives_a_warning(tmp_path):
    with Recorder(tmp_path / "a.mcap", RIG, serial="0123") as recorder:
        for measurement in live(3):
            recorder.write(measurement)
    for file, text in kalibr_texts(RIG, "another's", "0456").items():
        (tmp_path / file).write_text(text)
    done = share("convert", tmp_path / "a.mcap", "--calib", tmp_path, "--out", tmp_path / "b.mcap")
    assert done.returncode == 0
    assert done.stderr.startswith("share: a: the calibration is of device 0456, this is 0123: ")
    assert "device 0123\n" in good("info", tmp_path / "b.mcap")
