"""`share emulate`: its output, its files and its errors."""

import json
import os
import pty
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.recordings import make_euroc
from helpers.shell import Done
from helpers.small_session import small_profile

from share.lab.emulate.types import START_NS

SHARE = [sys.executable, "-m", "share"]
QUICK = ["--scene", "plain", "--seconds", "3", "--workers", "1", "--effect", "blur=off"]


@pytest.fixture
def emulate(share, tmp_path, monkeypatch) -> Callable[..., Done]:
    """`share emulate ARGUMENTS` in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return partial(share, "emulate")


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    return small_profile(tmp_path_factory.mktemp("profile"))


def complaint(done: Done, code: int) -> str:
    """Return the one error line; assert that no file was added."""
    assert done.code == code, done
    assert done.out == ""
    assert done.err.startswith("share: ")
    assert done.err.count("\n") == 1, done.err
    return done.err.removeprefix("share: ").rstrip("\n")


# ------------------------------------------------------------------ what was typed

TYPED = {
    "scene": (["--scene", "warehuose"], "scene 'warehuose' is not known; did you mean 'warehouse'?"),
    "plain scene": (["--scene", "plian"], "scene 'plian' is not known; did you mean 'plain'?"),
    "strange scene": (
        ["--scene", "kitchen.obj"],
        "scene 'kitchen.obj' is not known; known: warehouse, firestation, corridor-twins, whitewall, board, "
        "charuco-board, plain, or give a .glb file",
    ),
    "no such file": (["--scene", "room.glb"], "room.glb: no such file"),
    "motion": (["--motion", "wlak:"], "'wlak:': 'wlak' is not a kind of motion; did you mean 'walk:'?"),
    "key": (["--motion", "walk:sped=1"], "'walk:sped=1': unknown key 'sped'; did you mean 'speed'?"),
    "value": (["--motion", "walk:speed=9"], "'walk:speed=9': speed=9: expected 0.2 to 2 m/s"),
    "experiment": (["--motion", "paper:6"], "'paper:6': the paper has five experiments; say paper:1 to"),
    "no folder": (["--motion", "euroc:"], "'euroc:': names no folder or file"),
    "folder": (["--motion", "euroc:V1_02"], "V1_02: no recorded motion is here; expected mav0/imu0/data.csv"),
    "file": (["--motion", "tum:poses.txt"], "poses.txt: no such file"),
    "twice": (["--motion", "a=walk:", "--motion", "a=robot:"], "two agents are named 'a'; give each its own"),
    "taken": (["--motion", "truth=walk:"], "an agent cannot be named 'truth': a folder of the"),
    "size": (["--size", "50x50x50"], "the plain room can be 5 x 4 x 2.2 to 12 x 9 x 4 m"),
    "word for a size": (["--size", "big"], "'big' is not a size in metres such as 9x6x4"),
    "halls": (
        ["--scene", "firestation", "--size", "3x3x3"],
        "a firestation cannot be 3 x 3 x 3 m: give a size between 9 x 6 x 3.6 m and 30 x 20 x 8 m",
    ),
    "profile": (
        ["--profile", "d436"],
        "profile 'd436' is not known; known: d435i-n100-headset, d435i-turtlebot4, d435i, euroc, laptop-edge",
    ),
    "profile file": (["--profile", "mine.yaml"], "mine.yaml: no such profile file"),
    "mode": (["--profile", "d435i:9x9"], "mode '9x9' is not known; known: 640x480@30/15/60/90, 848x480"),
    "whose profile": (["--profile", "bob=d435i"], "'bob' is not one of the agents: walk1"),
    "two profiles": (
        ["--profile", "d435i", "--profile", "euroc"],
        "--profile is given twice for all; give it once",
    ),
    "sensors": (["--sensors", "lidar"], "sensors 'lidar' are not known; known: stereo, rgbd, mono"),
    "whose sensors": (["--sensors", "bob=rgbd"], "'bob' is not one of the agents: walk1"),
    "effect": (["--effect", "drop=0.1"], "effect 'drop' is not known; did you mean 'drops'?"),
    "much of it": (["--effect", "drops=2"], "effect drops: 2 must lie in 0 .. 0.9"),
    "switch": (["--effect", "noise=maybe"], "effect noise: expected noise=on or noise=off, found 'maybe'"),
    "seconds": (["--seconds", "2"], "2 seconds: a session lasts 3 to 3600 seconds"),
    "not a time": (["--seconds", "nan"], "nan seconds: a session lasts 3 to 3600 seconds"),
    "option": (["--sceen", "plain"], "No such option '--sceen'"),
    "format": (["--format", "bag"], "'bag' is not one of 'session', 'euroc'"),
    "depth": (["--format", "euroc", "--sensors", "rgbd"], "walk1: an ASL folder has no place for depth"),
    "lens": (
        ["--profile", "euroc"],
        "walk1: scene 'plain' has no lens distortion; give --profile walk1=d435i",
    ),
    "in a file": (["--out", "note/deep/session"], "note/deep/session: its parent "),
    "there already": (["--out", "note"], "note: exists already; give the name of a new folder"),
}


@pytest.mark.parametrize("case", TYPED)
def test_invalid_arguments_are_refused(case, emulate, tmp_path):
    words, said = TYPED[case]
    (tmp_path / "note").write_text("hello")
    usual = {"--scene": "plain", "--motion": "walk:", "--out": "deep/er/session", "--workers": "1"}
    for option, value in usual.items():
        words = words if option in words else [*words, option, value]
    assert said in complaint(emulate(*words), 2)
    assert os.listdir(tmp_path) == ["note"]


def test_missing_options_are_named(emulate, tmp_path):
    assert "Missing option '--motion'" in complaint(emulate("--scene", "plain", "--out", "x"), 2)
    assert os.listdir(tmp_path) == []


# ------------------------------------------------------------------ files that are damaged


def poses(seconds: float = 5.0, reach: float = 0.5) -> list[str]:
    """Lines of a TUM file of a swinging motion."""
    t = np.arange(0, seconds, 0.02)
    x = reach * np.sin(t)
    return [
        f"{START_NS / 1e9 + s:.6f} {a:.6f} 0 {1.65 + a / 50:.6f} -0.5 0.5 -0.5 0.5\n"
        for s, a in zip(t, x, strict=True)
    ]


def swapped(lines: list[str]) -> list[str]:
    return [*lines[:40], lines[41], lines[40], *lines[42:]]


def changed(lines: list[str], old: str, new: str) -> list[str]:
    assert old in lines[40]
    return [*lines[:40], lines[40].replace(old, new, 1), *lines[41:]]


TUM = {
    "empty": (lambda lines: ["# t x y z\n"], "has no data"),
    "stamps out of order": (swapped, "line 42"),
    "no rotation": (lambda lines: changed(lines, "-0.5 0.5 -0.5 0.5", "0 0 0 0"), "quaternion"),
    "NaN": (lambda lines: changed(lines, " 0 ", " nan "), "line 41: 'nan' is not finite"),
    "cut": (lambda lines: [*lines[:40], lines[40][:20] + "\n"], "line 41"),
    "short": (lambda lines: lines[:10], "10 poses in 0.18 s are too few; at least 20 in 1 s are needed"),
    "hole": (
        lambda lines: lines[:60] + poses(20.0)[700:],
        "no pose for 12.8 s, 1.2 s after its start; gaps up",
    ),
    "still": (lambda lines: poses(reach=0.0), "does not move: all poses are the same"),
    "slow": (lambda lines: poses(20.0)[::20], "a pose every 0.40 s says nothing of accelerations; give one"),
}


@pytest.mark.parametrize("damage", TUM)
def test_damaged_poses_are_refused(damage, emulate, tmp_path):
    damaged, said = TUM[damage]
    (tmp_path / "poses.tum").write_text("".join(damaged(poses())))
    line = complaint(emulate(*QUICK, "--seconds", 20, "--motion", "ann=tum:poses.tum", "--out", "x"), 1)
    assert line.startswith("poses.tum")
    assert said in line
    assert os.listdir(tmp_path) == ["poses.tum"]


def test_motion_that_fits_no_room_is_refused(emulate, tmp_path):
    (tmp_path / "poses.tum").write_text("".join(poses(5.0, reach=20.0)))
    line = complaint(emulate(*QUICK, "--motion", "ann=tum:poses.tum", "--out", "x"), 2)
    assert "ann" in line
    assert "--size" in line
    assert os.listdir(tmp_path) == ["poses.tum"]


def shift(path: Path, by_ns: int) -> None:
    head, *rows = path.read_text().splitlines()
    moved = [f"{int(row.split(',')[0]) + by_ns},{row.split(',', 1)[1]}" for row in rows]
    path.write_text("\n".join([head, *moved]) + "\n")


def edit(path: Path, line: int, change: Callable[[list[str]], list[str]]) -> None:
    lines = path.read_text().splitlines()
    lines[line] = ",".join(change(lines[line].split(",")))
    path.write_text("\n".join(lines) + "\n")


_TRUTH = "mav0/state_groundtruth_estimate0/data.csv"
EUROC = {
    "no overlap": (
        lambda r: shift(r / _TRUTH, 10**12),
        1,
        "flight: IMU and ground truth do not overlap in time; give",
    ),
    "no rotation": (
        lambda r: edit(r / _TRUTH, 9, lambda row: [*row[:4], "0", "0", "0", "0"]),
        1,
        "quaternion",
    ),
    "NaN": (lambda r: edit(r / _TRUTH, 9, lambda row: [row[0], "nan", *row[2:]]), 1, "'nan' is not finite"),
    "order": (lambda r: edit(r / _TRUTH, 9, lambda row: ["5", *row[1:]]), 1, "data.csv"),
    "no IMU": (lambda r: (r / "mav0/imu0/data.csv").unlink(), 2, "no recorded motion is here"),
    "no truth": (
        lambda r: shutil.rmtree(r / "mav0/state_groundtruth_estimate0"),
        1,
        "has no ground truth; expected",
    ),
    "too short": (lambda r: edit(r / _TRUTH, 9, lambda row: row), 2, "at least 1 s are needed"),
}


@pytest.mark.parametrize("damage", EUROC)
def test_damaged_recorded_motion_is_refused(damage, emulate, tmp_path):
    do, code, said = EUROC[damage]
    frames = 12 if damage == "too short" else 40
    do(make_euroc(tmp_path / "flight", frames=frames))
    line = complaint(emulate(*QUICK, "--motion", "euroc:flight", "--out", "x"), code)
    assert "flight" in line
    assert said in line
    assert os.listdir(tmp_path) == ["flight"]


@pytest.mark.parametrize(
    "content", [b"", b"glTF\x02\0\0\0\x10\0\0\0", b"\xff" * 4000], ids=["empty", "cut", "noise"]
)
def test_damaged_room_file_is_refused(content, emulate, tmp_path):
    (tmp_path / "room.glb").write_bytes(content)
    line = complaint(emulate("--scene", "room.glb", "--motion", "walk:", "--out", "x"), 1)
    assert line.startswith("room.glb: not a readable glTF 2.0 file: ")
    assert os.listdir(tmp_path) == ["room.glb"]


# ------------------------------------------------------------------ machines that cannot


@pytest.mark.slow
def test_full_disk_is_one_line(small, tmp_path):
    """No file may grow beyond 500 kB: chunks keep within, the recording does not."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (500_000, 500_000))

    words = [*QUICK, "--seconds", "6", "--motion", "walk:", "--profile", str(small), "--out", "session"]
    done = subprocess.run(
        [*SHARE, "emulate", *words], cwd=tmp_path, preexec_fn=limit, capture_output=True, text=True
    )
    line = complaint(Done(done.returncode, done.stdout, done.stderr), 1)
    assert "cannot be written: File too large; run the same command again to resume" in line
    assert os.listdir(tmp_path) == [".session.partial"]


def test_missing_opengl_is_reported(tmp_path):
    environment = os.environ | {"__EGL_VENDOR_LIBRARY_DIRS": "/nonexistent"}
    words = ["--scene", "whitewall", "--seconds", "3", "--motion", "walk:", "--workers", "2", "--out", "x"]
    done = subprocess.run(
        [*SHARE, "emulate", *words], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    line = complaint(Done(done.returncode, done.stdout, done.stderr), 1)
    assert line.startswith("cannot draw without a screen (")
    assert "apt install " in line
    assert os.listdir(tmp_path) == []


# ------------------------------------------------------------------ what it says


@pytest.mark.long
def test_text(emulate, small, tmp_path):
    (tmp_path / "poses.tum").write_text("".join(poses(2.0)))
    words = ["--motion", "ann=walk:", "--motion", "bob=tum:poses.tum", "--profile", small]
    done = emulate(*QUICK, *words, "--sensors", "bob=rgbd", "--out", "room")
    assert done.code == 0
    assert done.err == ""
    note, ann, bob, ready = done.out.splitlines()
    assert note == "bob: ends after 2.0 s"
    assert ann.split()[:3] == ["ann", "ar", "stereo+imu"]
    assert ann.split()[3:-2] == ["30", "frames", "at", "10", "Hz", "3.0", "s"]
    assert bob.split()[:3] == ["bob", "ar", "rgbd+imu"]
    assert ready == "room: ready"


@pytest.mark.long
def test_json(emulate, small, tmp_path):
    words = [*QUICK, "--motion", "walk:", "--profile", small, "--seed", "3", "--json", "--out", "flights"]
    done = emulate(*words, "--format", "euroc")
    assert (done.code, done.err) == (0, "")
    made = json.loads(done.out)
    assert (made["folder"], made["kinds"]) == ("flights", {"walk1": "ar"})
    assert made["provenance"]["seed"] == 3
    assert made["agents"]["walk1"]["streams"]["cam0"]["count"] == 30
    images = sorted((tmp_path / "flights/walk1/mav0/cam0/data").iterdir())
    assert {image.suffix for image in images} == {".png"}
    assert cv2.imread(str(images[0]), cv2.IMREAD_UNCHANGED).shape == (120, 160)


@pytest.mark.long
def test_progress_is_shown_on_terminals_only(small, tmp_path):
    """Each stage is shown to its end."""
    words = [*QUICK, "--motion", "walk:", "--profile", str(small), "--out", "session"]
    ours, theirs = pty.openpty()
    maker = subprocess.Popen(
        [*SHARE, "emulate", *words], cwd=tmp_path, stderr=theirs, stdout=subprocess.DEVNULL
    )
    os.close(theirs)
    shown = b""
    try:
        while part := os.read(ours, 1 << 16):
            shown += part
    except OSError:  # how a pseudo-terminal ends
        pass
    assert maker.wait() == 0
    text = shown.decode()
    for stage in (
        "planning",
        "making the room",
        "setting the exposure of walk1",
        "drawing images",
        "writing recordings",
    ):
        bars = [bar for bar in text.replace("\r", "\n").split("\n") if stage in bar]
        assert bars, stage
        assert "100%" in bars[-1], bars[-1]
