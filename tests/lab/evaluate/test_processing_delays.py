"""Delays measured in a run, for runs in virtual time."""

import json
from pathlib import Path

import pytest

from share.errors import DataError, ShareError, UsageError
from share.lab.evaluate.simulation import Delay, ProcessingDelays, Sampled
from share.lab.evaluate.virtual_time import read_delays


def spread(p50: float, p95: float, n: int = 10) -> dict[str, float | None]:
    return {"n": n, "p50": p50 if n else None, "p95": p95 if n else None}


def run(folder: Path, solved: int = 10) -> Path:
    """Two agents, slower than usual, and an edge that verifies in half the usual time."""
    edge = {
        "place_ms": spread(6.0, 9.0),
        "verify_ms": spread(2.0, 5.0),
        "solve_ms": spread(20.0, 50.0, solved),
    }
    files = {
        "ann": {"track_ms": spread(15.0, 30.0)},
        "bob": {"track_ms": spread(25.0, 50.0)},
        "edge": edge,
    }
    for name, report in files.items():
        (folder / name).mkdir()
        (folder / name / ("edge.json" if name == "edge" else "report.json")).write_text(json.dumps(report))
    return folder


def test_unmeasured_delays_are_in_proportion_to_measured_ones(tmp_path):
    costs, usual = read_delays(run(tmp_path)), ProcessingDelays()
    assert costs.frame == Delay(20.0, 40.0)
    assert costs.query == Delay(6.0, 9.0)
    assert costs.verify_accepted == costs.verify_refused == Delay(2.0, 5.0)
    assert costs.solve == Delay(20.0, 50.0)
    slower = 20.0 / usual.frame.p50
    assert costs.keyframe == Delay(slower * usual.keyframe.p50, slower * usual.keyframe.p95)
    assert costs.finish_keyframe == Sampled(tuple(slower * ms for ms in usual.finish_keyframe.ms))
    for name in ("receive", "add", "check_loop", "apply_solution"):
        assert getattr(costs, name).p50 == pytest.approx(0.5 * getattr(usual, name).p50)


def test_missing_delays_are_reported(tmp_path):
    with pytest.raises(UsageError, match="not a folder of"):
        read_delays(tmp_path)
    folder = run(tmp_path, solved=0)
    with pytest.raises(DataError, match="has no measured delays"):
        read_delays(folder)
    (folder / "ann" / "report.json").write_text("{")
    with pytest.raises(ShareError, match="is damaged"):
        read_delays(folder)
