"""The frozen program, as a device without Python would run it: every command, from outside the checkout."""

from __future__ import annotations

import json
import re
import subprocess
import time
from pathlib import Path

import pytest
from recordings import make_euroc, make_tum

from share import __version__
from share.cli.main import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = ROOT / "dist" / "share" / "share"
SOURCES = ["Makefile", "setup.cfg", "tools/share.spec", "tools/frozen_entry.py", "share/**/*.py"]
MB = 1_000_000

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def program() -> Path:
    """dist/share/share, built anew unless it is younger than what it is made of."""
    newest = max(path.stat().st_mtime for pattern in SOURCES for path in ROOT.glob(pattern))
    if not PROGRAM.exists() or PROGRAM.stat().st_mtime < newest:
        made = subprocess.run(["make", "freeze"], cwd=ROOT, capture_output=True, text=True, check=False)
        assert made.returncode == 0, made.stdout + made.stderr
    return PROGRAM


@pytest.fixture
def share(program, tmp_path):
    """Runs `share ARGUMENTS` in an environment that knows neither this Python nor this checkout."""

    def run(*arguments, code=0):
        bare = {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "LANG": "C.UTF-8"}
        command = [str(program), *(str(argument) for argument in arguments)]
        done = subprocess.run(command, env=bare, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == code, done.stderr
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
    assert all(name in listed for name in COMMANDS)
    assert min(took) < 0.5


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_of_the_table_is_in_it(share, name):
    assert share(name, "--help").stdout.startswith(f"Usage: share {name}")


def test_recordings_of_all_kinds_are_read_and_written(share, tmp_path):
    euroc, tum, mcap = make_euroc(tmp_path / "euroc"), make_tum(tmp_path / "tum"), tmp_path / "x.mcap"
    share("dataset", "convert", euroc, "--out", mcap)
    share("dataset", "convert", mcap, "--format", "euroc", "--out", tmp_path / "back")
    share("dataset", "recover", mcap, "--out", tmp_path / "again.mcap")
    sources = {euroc: 6, mcap: 6, tmp_path / "back": 6, tmp_path / "again.mcap": 6, tum: 5}
    for source, frames in sources.items():
        told = json.loads(share("dataset", "info", source, "--json").stdout)
        assert told["streams"]["cam0"]["count"] == frames


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
    """Spawned workers, child processes, MCAP, poselib, SciPy, filterpy and matplotlib all work frozen."""
    said = share("demo", "--seconds", 20, "--out", tmp_path / "demo").stdout
    assert "3 of 3 agents in one map" in said
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
        "pyrealsense2",
    }
    sizes = (path.lstat().st_size for path in inside.rglob("*") if not path.is_dir())
    assert sum(sizes) < 530 * MB  # 45 of them to bake the light of rooms
