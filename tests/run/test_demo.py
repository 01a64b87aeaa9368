"""`share demo` as a user starts it: a room made, an edge and three agents as processes, a table."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from children import SHARE

from share.config import Config
from share.emulate.plain.session import cached_session
from share.geometry import se3
from share.io.source import open_source
from share.metrics.association import associate
from share.run.track import track


def demo(cache: Path, out: Path, *more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*SHARE, "demo", "--out", str(out), *more],
        capture_output=True,
        text=True,
        timeout=300,
        env={**__import__("os").environ, "XDG_CACHE_HOME": str(cache)},
    )


def test_five_seconds_of_everything(tmp_path):
    done = demo(tmp_path / "cache", tmp_path / "out", "--seconds", "5")
    print(done.stdout)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""  # no progress where nobody watches
    assert re.search(r"3 of 3 agents in one map, joint ATE \d\.\d\d cm", done.stdout)
    for name in ("ar1", "ar2", "robot"):
        assert re.search(rf"^ *{name} ", done.stdout, re.MULTILINE)
        report = json.loads((tmp_path / "out" / name / "report.json").read_text())
        assert report["frames"] == report["tracked"] == 100
    picture = (tmp_path / "out" / "trajectories.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert len(picture) > 20_000


@pytest.mark.slow
def test_the_whole_demo_to_the_centimetre(tmp_path):
    cache = tmp_path / "cache"
    done = demo(cache, tmp_path / "out")
    print(done.stdout)
    joint = re.search(r"3 of 3 agents in one map, joint ATE ([\d.]+) cm", done.stdout)
    assert joint
    assert float(joint[1]) < 2.5


@pytest.mark.slow
def test_odometry_does_not_jump_when_a_place_is_seen_again(tmp_path):
    """ar2 comes round to where it began; what it has drifted is for the edge to correct."""
    session = cached_session(tmp_path, seconds=20)
    source = open_source(f"{session}/ar2")
    run = track(source, Config(), lambda done: None)
    _, estimate, truth = associate(run.trajectory, source.truth())
    moved, should = (se3.inverse(T[:-1]) @ T[1:] for T in (estimate, truth))
    error = np.linalg.norm((se3.inverse(moved) @ should)[:, :3, 3], axis=1)
    assert error.max() < 0.015
