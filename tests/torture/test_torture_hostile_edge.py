"""Real agents against an edge that lies (`lying_edge.py`): their odometry is what it is without any edge."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import harness
import pytest
from harness import Program, Result, Watch
from lying_edge import MODES, LyingEdge

SEED = 20261126
NOBODY = "tcp://127.0.0.1:9"
FRAMES = ":100"
PATIENCE_S = 120.0  # a busy machine plays 100 frames in half a minute
RSS_MB = 200.0
SAID_BYTES = 50_000  # 100 frames take some seconds
MOST_SENT = 1000  # keyframes, each again and again, of 26
FAR_MS = 100 * 365.25 * 86400e3  # no two clocks that run since they were started differ by a century
Start = Callable[..., Program]


@pytest.fixture(scope="session")
def alone(session: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """odom.tum of an agent without any edge."""
    folder = tmp_path_factory.mktemp("alone")
    for _ in range(3):  # until no frame was left out
        program = harness.start_agent(folder, "ann", session / "ann", NOBODY, "--frames", FRAMES)
        assert program.process.wait(PATIENCE_S) == 1, program.said
        if not _report(folder)["dropped_late"]:
            break
    assert not _report(folder)["dropped_late"], "this machine is too slow: it drops frames without any edge"
    return (folder / "ann" / "odom.tum").read_bytes()


def _report(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "ann" / "report.json").read_text()))


def _run(
    mode: str, seed: int, session: Path, traffic: Path, folder: Path, alone: bytes, start: Start
) -> Result:
    result = Result(f"hostile edge: {mode}", "agent", seed)
    edge = LyingEdge(mode, traffic, seed)
    ann = start(folder, "ann", session / "ann", edge.start(), "--frames", FRAMES)
    watch = Watch(ann.process.pid).start()
    try:
        code = ann.process.wait(PATIENCE_S)
    except Exception:
        code = None
        ann.kill()
    finally:
        watch.stop()
        edge.close()
    welcomed = mode != "silent"
    result.figures = {
        "exit_code": code,
        "rss_mb": [round(x) for x in watch.rss_mb()],
        "said": dict(edge.said),
    }
    result.figures["heard"] = dict(edge.heard)
    result.figures["bytes_logged"] = ann.log.stat().st_size
    result.expect(code in ((0,) if welcomed else (0, 1)), f"exit code {code}: {ann.said[-300:]}")
    result.expect("Traceback" not in ann.said, f"a traceback: {ann.said[-300:]}")
    first, most = watch.rss_mb()
    result.expect(most < RSS_MB + max(first, 150), f"its memory grew to {most:.0f} MB")
    result.expect(ann.log.stat().st_size < SAID_BYTES, f"it wrote {ann.log.stat().st_size} bytes of log")
    again = edge.heard["keyframe"]
    result.expect(again < MOST_SENT, f"it sent its keyframes {again} times")
    wild = [line for line in ann.said.splitlines() if not line.isprintable()]
    result.expect(not wild, f"it writes what is not printable: {wild[:1]!r}")
    _check_files(result, folder / "ann", alone)
    return result


def _check_files(result: Result, out: Path, alone: bytes) -> None:
    if not (out / "report.json").exists():
        result.findings.append("no report.json")
        return
    report = json.loads((out / "report.json").read_text())
    result.figures["dropped_late"] = report["dropped_late"]
    result.figures["clock"] = report["clock"]
    offset_ms = report["clock"].get("offset_ms") or 0.0
    result.expect(abs(offset_ms) < FAR_MS, f"a clock that is off by {offset_ms:.3g} ms is believed")
    odometry = (out / "odom.tum").read_bytes()
    if not report["dropped_late"]:
        result.expect(odometry == alone, "odometry differs from that without an edge")
    for line in (out / "map.tum").read_text().splitlines() if (out / "map.tum").exists() else []:
        if not line.startswith("#") and not all(map(math.isfinite, map(float, line.split()))):
            result.findings.append(f"map.tum has {line[:80]}")
            return


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
def test_odometry_beside_a_lying_edge(
    mode: str, session: Path, traffic: Path, tmp_path: Path, alone: bytes, start_agent: Start, results: Path
) -> None:
    _run(mode, SEED, session, traffic, tmp_path, alone, start_agent).write(results).check()


@pytest.mark.torture
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("mode", MODES)
def test_odometry_beside_a_lying_edge_again(
    mode: str,
    seed: int,
    session: Path,
    traffic: Path,
    tmp_path: Path,
    alone: bytes,
    start_agent: Start,
    results: Path,
) -> None:
    """With other draws; a result of its own each."""
    _run(mode, seed, session, traffic, tmp_path, alone, start_agent).write(results / f"seed{seed}").check()


def test_the_judge_notices_another_odometry(tmp_path: Path) -> None:
    """The suite can fail."""
    result = Result("none", "agent", 0)
    (tmp_path / "report.json").write_text(json.dumps({"dropped_late": 0, "clock": {}}))
    (tmp_path / "odom.tum").write_text("1 0 0 0 0 0 0 1\n")
    (tmp_path / "map.tum").write_text("1 nan 0 0 0 0 0 1\n")
    _check_files(result, tmp_path, b"")
    assert [f.split()[0] for f in result.findings] == ["odometry", "map.tum"]
    assert harness.p95([1.0, 2.0]) == 2.0
