"""The frozen program, as a device without Python would run it: every command, from outside the checkout."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.fake_device import make_device
from helpers.frozen_program import ROOT, frozen_program
from helpers.recordings import make_euroc, make_tum
from helpers.ssh_server import HOST, ssh_server

from share import __version__
from share.cli.commands import COMMANDS

MB = 1_000_000

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def program() -> Path:
    return frozen_program()


@pytest.fixture
def share(program, tmp_path):
    """Runs `share ARGUMENTS` in an environment that knows neither this Python nor this checkout. code: of
    its end, None for any."""

    def run(*arguments, code=0):
        bare = {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "LANG": "C.UTF-8"}
        command = [str(program), *(str(argument) for argument in arguments)]
        done = subprocess.run(command, env=bare, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert code is None or done.returncode == code, done.stderr
        assert "Traceback" not in done.stderr
        return done

    return run


def test_version_and_help_at_once(share):
    assert share("--version").stdout.split()[-1] == __version__
    took = []
    for _ in range(5):
        began = time.monotonic()
        listed = share("--help").stdout
        took.append(time.monotonic() - began)
    assert all(name in listed for name in COMMANDS if " " not in name)
    assert min(took) < 0.5


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_of_the_table_is_in_it(share, name):
    assert share(*name.split(), "--help").stdout.startswith(f"Usage: share {name}")


def test_recordings_of_all_kinds_are_read_and_written(share, tmp_path):
    euroc, tum, mcap = make_euroc(tmp_path / "euroc"), make_tum(tmp_path / "tum"), tmp_path / "x.mcap"
    share("dataset", "convert", euroc, "--out", mcap)
    share("dataset", "convert", mcap, "--format", "euroc", "--out", tmp_path / "back")
    share("dataset", "recover", mcap, "--out", tmp_path / "again.mcap")
    sources = {euroc: 6, mcap: 6, tmp_path / "back": 6, tmp_path / "again.mcap": 6, tum: 5}
    for source, frames in sources.items():
        reported = json.loads(share("dataset", "info", source, "--json").stdout)
        assert reported["streams"]["cam0"]["count"] == frames


def test_the_node_of_a_robot_is_printed(share):
    node = Path(__file__).parents[2] / "share" / "robot" / "share_robot_node.py"
    assert share("robot", "node").stdout == node.read_text()


def test_wrong_use_is_one_line(share):
    done = share("track", "nothing-here", code=2)
    assert len(done.stderr.splitlines()) == 1
    assert "no such file or folder" in done.stderr


def test_an_edge_listens_and_ends_when_asked(program):
    edge = subprocess.Popen(
        [program, "edge", "--bind", "tcp://127.0.0.1:0"], stderr=subprocess.PIPE, text=True
    )
    try:
        assert re.match(r"listening on tcp://127\.0\.0\.1:\d+", edge.stderr.readline())
        edge.send_signal(2)
        assert edge.wait(10) == 0
    finally:
        edge.kill()
        edge.stderr.close()


def test_the_whole_system_and_the_same_digits_as_from_source(share, tmp_path):
    """Child processes, MCAP, poselib, SciPy, filterpy and matplotlib all work frozen."""
    done = share("demo", "--seconds", 20, "--out", tmp_path / "demo")
    said = done.stdout
    assert "Warning" not in done.stderr
    assert re.search("[23] of 3 agents in one map", said), said  # a busy machine may lose one, in real time
    assert (tmp_path / "demo" / "trajectories.png").stat().st_size > 10_000
    (session,) = (tmp_path / ".cache" / "share").glob("session-*")
    share("track", session / "ar1", "--out", tmp_path / "frozen.tum")
    source = [ROOT / ".venv" / "bin" / "share", "track", session / "ar1", "--out", tmp_path / "source.tum"]
    subprocess.run(source, check=True, capture_output=True)
    assert (tmp_path / "frozen.tum").read_bytes() == (tmp_path / "source.tum").read_bytes()

    settings, out = tmp_path / "settings.yaml", tmp_path / "agent"
    settings.write_text("agent: {error_model: shipped}")
    who = ("--name", "ar1", "--kind", "ar", "--edge", "tcp://127.0.0.1:9", "--frames", "0:120")
    share("agent", session / "ar1", *who, "--config", settings, "--out", out, code=1)  # no edge there
    assert json.loads((out / "report.json").read_text())["error_model"]["estimate_ms"]["n"] > 0


def test_pictures_and_pages_are_drawn_with_the_fonts_that_are_there(share, tmp_path):
    share("calibrate", "target", "--out", tmp_path / "board.pdf")
    lying = tmp_path / "rest.csv"
    noise = np.random.default_rng(1).normal([0, 0, 0, 0, 0, 9.81], 0.01, (24_000, 6)).round(6)
    rows = [",".join(map(str, (5_000_000 * k, *row))) for k, row in enumerate(noise.tolist())]
    lying.write_text("\n".join(["#t,wx,wy,wz,ax,ay,az", *rows]) + "\n")
    said = share("calibrate", "imu", lying, "--out", tmp_path / "imu").stderr
    assert "font" not in said
    assert (tmp_path / "imu" / "imu-report.png").stat().st_size > 10_000


def test_nothing_is_in_it_that_no_command_needs(program):
    inside = program.parent / "_internal"
    names = {path.name for path in inside.iterdir()}
    assert not names & {
        "gtsam",
        "torch",
        "tkinter",
        "_tkinter",
        "IPython",
        "pandas",
        "onnx",
        "sklearn",
        "dask",
        "distributed",
        "ray",
        "embreex",
        "moderngl",
        "trimesh",
    }


def test_it_stays_small(program):
    sizes = (path.lstat().st_size for path in program.parent.rglob("*") if not path.is_dir())
    assert sum(sizes) < 300 * MB  # what is in it, and what is not: docs/do/freeze.md


def test_every_library_in_it_loads(program):
    """What was stripped, hollowed out or led elsewhere, too. Each in a process of its own: they are not meant
    to be in one."""
    broken = []
    for path in sorted((program.parent / "_internal").rglob("*.so*")):
        if path.is_symlink():
            continue
        load = [sys.executable, "-c", "import ctypes, os, sys; ctypes.CDLL(sys.argv[1]); os._exit(0)", path]
        done = subprocess.run(load, capture_output=True, text=True, check=False)
        if done.returncode:
            broken.append(f"{path.name}: {done.stderr.strip().splitlines()[-1]}")
    assert not broken


def test_what_is_left_out_is_said_in_one_line(share, tmp_path):
    room = (
        "emulate",
        "--scene",
        "warehouse",
        "--motion",
        "ann=walk:",
        "--seconds",
        3,
        "--out",
        tmp_path / "r",
    )
    for words in (room, ("train", "fit", tmp_path, "--out", tmp_path / "model")):
        said = share(*words, code=None).stderr
        assert len(said.splitlines()) == 1
        assert "this frozen program has no " in said
    assert list(tmp_path.iterdir()) == []


def test_cv2_reads_pictures_without_its_video_codecs(share, tmp_path):
    """Each picture passes by every reader of OpenCV, AVIF's among them."""
    euroc = make_euroc(tmp_path / "euroc")
    assert "none of its 6 frames could be tracked" in share("track", euroc, code=1).stderr  # small, but read


@pytest.mark.skipif(importlib.util.find_spec("pyrealsense2") is None, reason="pyrealsense2 is not installed")
def test_a_device_captures_with_it(share):
    findings = json.loads(share("doctor", "--json", code=None).stdout)["findings"]
    states = {one["name"]: one["state"] for one in findings}
    assert (states["librealsense"], states["libraries"]) == ("OK", "OK")


def test_it_is_put_onto_a_device(program, tmp_path):
    """The whole of it over a real ssh, into a folder; only systemd is made up."""
    device = make_device(tmp_path, os.environ["PATH"], tmp_path)
    command = ("agent", "--name", "ann", "--edge", "tcp://127.0.0.1:5555")
    with ssh_server(tmp_path / "ssh", device.path) as ssh:
        done = device.deploy(*command, host=HOST, ssh=ssh, dist=program.parent)
    assert done.code == 0, done.err
    there = device.root / "opt" / "share" / "current" / "share"
    reported = subprocess.run([there, "--version"], env={}, capture_output=True, text=True, check=True).stdout
    assert reported.split()[-1] == __version__ == (program.parent / "VERSION").read_text().strip()
