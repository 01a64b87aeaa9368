"""`share evaluate compare`, with a stand-in tracker that reports a constant pose."""

from __future__ import annotations

import csv
import shutil
import sys
from functools import partial
from pathlib import Path

import pytest

from share import __version__
from share.lab.peer_trackers import PEERS

SHARE = f"SHARE {__version__}"
INTERPRETER = f"""#!{sys.executable}
import sys
sys.path.insert(0, {str(PEERS["basalt"].path.parent)!r})
from peer_wire import claim_stdout, read_line, read_frame, write_line

answers = claim_stdout()
if "orbslam3" in sys.argv[1]:
    sys.exit(1)  # is not there
if "--version" in sys.argv:
    write_line(answers, dict(version="Idler 1"))
    sys.exit()
print("begins", file=sys.stderr)
read_line(sys.stdin.buffer)
at = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
stamps = []
while (moment := read_frame(sys.stdin.buffer)) is not None:
    stamps.append(moment.stamp_ns)
    write_line(answers, dict(T_world_body=at if len(stamps) > 3 else None, cpu_s=0.002))
    if len(stamps) == BREAKS:
        sys.exit("breaks")
write_line(answers, dict(stamps_ns=stamps, T_world_body=[at] * len(stamps)))
"""


@pytest.fixture
def compare(share):
    return partial(share, "evaluate", "compare")


def idler(folder: Path, breaks: int = 0) -> Path:
    """What is taken for an interpreter."""
    path = folder / "python"
    path.write_text(INTERPRETER.replace("BREAKS", str(breaks)))
    path.chmod(0o755)
    return path


def rows_of(out: Path) -> dict[tuple[str, str], dict[str, str]]:
    rows = csv.DictReader((out / "table.csv").read_text().splitlines())
    return {(row["recording"], row["tracker"]): row for row in rows}


@pytest.mark.slow
def test_all_trackers_are_scored_alike_and_kept(compare, plain_session, tmp_path):
    out = tmp_path / "compared"
    arguments = (plain_session, "--peer", f"basalt={idler(tmp_path)}", "--out", out)
    done = compare(*arguments)
    assert done.code == 0, done.err
    assert done.err.startswith("left out: ORB-SLAM3: ")
    assert "pip install pyorbslam3==" in done.err
    rows = rows_of(out)
    assert len(rows) == 7  # three agents by us, those with stereo by the peer, and by the peer in the end
    assert "left out: Idler 1 on " in done.err
    name = plain_session.name
    ours, idle, end = (rows[f"{name}/ar1", key] for key in (SHARE, "Idler 1", "Idler 1, final trajectory"))
    frames = int(ours["frames"])
    assert float(ours["ate_cm"]) < 1 < float(idle["ate_cm"])
    tracked = (frames - 3) / frames  # and after the last one comes no IMU sample
    assert float(idle["told"]) == pytest.approx(tracked, abs=0.03)
    assert float(idle["cpu_ms"]) == pytest.approx(2)
    assert float(ours["cpu_ms"]) > 0
    assert end["cpu_ms"] == ""
    text = (out / "table.md").read_text()
    assert "| median of 2 | Idler 1 |" in text
    assert "Left out: ORB-SLAM3" in text
    assert text.strip() in done.out
    page = (out / "report.html").read_text()
    assert page.count("data:image/png") == 2
    trajectories = sorted(path.name for path in out.glob("*.tum"))
    assert len(trajectories) == 7
    kept = {path: path.read_bytes() for path in out.glob("*.json")}

    next(iter(kept)).unlink()
    again = compare(*arguments)
    assert again.code == 0, again.err
    assert sum(path.read_bytes() == was for path, was in kept.items()) >= len(kept) - 1


@pytest.mark.long
def test_rows_of_other_settings_are_not_reused(compare, plain_session, tmp_path):
    source, out, other = f"{plain_session}/ar1", tmp_path / "compared", tmp_path / "other.yaml"
    assert compare(source, "--out", out).code == 0
    other.write_text("inertial: {max_speed_m_s: 9}\n")
    done = compare(source, "--config", other, "--out", out)
    assert done.code == 2
    assert "is of another recording, version or setting; give another --out" in done.err


@pytest.mark.long
def test_failing_tracker_does_not_affect_other_rows(compare, plain_session, tmp_path):
    out = tmp_path / "compared"
    peer = idler(tmp_path, breaks=5)
    done = compare(f"{plain_session}/ar1", "--peer", f"basalt={peer}", "--out", out)
    assert done.code == 1
    assert "Idler 1: the peer process ended at frame 5; see " in done.err
    assert "1 of 2 runs failed; run the same command again" in done.err
    assert [tracker for _, tracker in rows_of(out)] == [SHARE]
    (log,) = out.glob("*.log")
    assert "begins" in log.read_text()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--peer", "basalt"), "--peer basalt: give NAME=PYTHON"),
        (("--peer", "slam=python"), "where NAME is basalt or orbslam3"),
        (("--vocabulary", "/nowhere"), "does not exist"),
    ],
)
def test_wrong_use_is_one_line(compare, plain_session, tmp_path, arguments, said):
    done = compare(plain_session, *arguments, "--out", tmp_path / "compared")
    assert done.code == 2
    assert said in done.err
    assert not (tmp_path / "compared").exists()


def test_recording_without_ground_truth_is_refused(compare, plain_session, tmp_path):
    bare = tmp_path / "bare"
    bare.mkdir()
    for path in plain_session.glob("*.*"):
        shutil.copy(path, bare)
    done = compare(f"{bare}/ar1", "--out", tmp_path / "compared")
    assert done.code == 2
    assert "has no ground truth" in done.err
