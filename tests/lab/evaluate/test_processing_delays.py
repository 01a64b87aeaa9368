"""Delays measured in a run, for runs in virtual time."""

import json
from pathlib import Path

import pytest

from share.errors import DataError, ShareError, UsageError
from share.lab.evaluate.processing_delays import Delay, MeasuredDelay, ProcessingDelays
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
    assert costs.finish_keyframe == MeasuredDelay(tuple(slower * ms for ms in usual.finish_keyframe.ms))
    for name in ("receive", "add", "check_loop", "apply_solution"):
        assert getattr(costs, name).p50 == pytest.approx(0.5 * getattr(usual, name).p50)


def with_images(folder: Path, align_n: int = 10) -> Path:
    """An edge that describes images in twice the usual time."""
    path = run(folder) / "edge" / "edge.json"
    usual = ProcessingDelays()
    report = json.loads(path.read_text()) | {
        "describe_ms": spread(2 * usual.describe.p50, 30.0),
        "align_ms": spread(7.0, 21.0, align_n),
    }
    path.write_text(json.dumps(report))
    return folder


def test_describing_and_aligning_images_take_as_long_as_in_the_run(tmp_path):
    costs, usual = read_delays(with_images(tmp_path)), ProcessingDelays()
    assert costs.describe == Delay(2 * usual.describe.p50, 30.0)
    assert costs.align_accepted == costs.align_refused == Delay(7.0, 21.0)
    assert costs.verify_images_accepted == costs.verify_images_refused == Delay(2.0, 5.0)
    for name in ("receive", "add", "check_loop", "apply_solution"):
        assert getattr(costs, name).p50 == pytest.approx(2 * getattr(usual, name).p50)


def test_where_nothing_was_described_or_aligned_both_are_in_proportion(tmp_path):
    (tmp_path / "some").mkdir()
    (tmp_path / "none").mkdir()
    usual, some, none = (
        ProcessingDelays(),
        read_delays(with_images(tmp_path / "some", align_n=0)),
        read_delays(run(tmp_path / "none")),
    )
    assert some.align_accepted == Delay(2 * usual.align_accepted.p50, 2 * usual.align_accepted.p95)
    for name in (
        "describe",
        "index",
        "align_accepted",
        "align_refused",
        "verify_images_accepted",
        "verify_images_refused",
    ):
        assert getattr(none, name).p50 == pytest.approx(0.5 * getattr(usual, name).p50)


def test_missing_delays_are_reported(tmp_path):
    with pytest.raises(UsageError, match="not a folder of"):
        read_delays(tmp_path)
    folder = run(tmp_path, solved=0)
    with pytest.raises(DataError, match="has no measured delays"):
        read_delays(folder)
    (folder / "ann" / "report.json").write_text("{")
    with pytest.raises(ShareError, match="is damaged"):
        read_delays(folder)
