"""Two policies on the same recordings, side by side."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib
import numpy as np
import pytest

from share.config import Config
from share.lab.evaluate.real_time import RunOptions
from share.lab.evaluate.side_by_side import (
    ScoredTrial,
    _draw_latency,
    busy_note,
    comparison_rows,
    draw_side_by_side,
    headline,
)
from share.lab.evaluate.trial import run_trial
from share.recordings.session import read_session
from share.types import AgentKind

POLICIES = ("covins-g", "share")


@pytest.mark.long
def test_the_table_the_sentence_and_the_picture(plain_session: Path, tmp_path: Path) -> None:
    session = read_session(plain_session)
    scored = []
    for policy in POLICIES:
        terms = RunOptions(policy, virtual=True)
        trial = run_trial(session, terms, Config(), tmp_path / policy, lambda now: None)
        scored.append(ScoredTrial.of(trial))
    rows = comparison_rows(scored)
    assert rows[0] == ["", "covins-g", "share", "share ÷ covins-g"]
    by_name = {row[0]: row[1:] for row in rows}
    base, mine, ratio = (float(text) for text in by_name["AR latency, ms"])
    assert ratio == pytest.approx(mine / base, rel=0.02)
    assert base == pytest.approx(
        sum(a.latency_ms for a in scored[0].metrics.agents_of_kind("ar")) / 2, rel=0.01
    )
    assert headline(scored).startswith("share against covins-g: AR latency ")
    picture = tmp_path / "compared.png"
    draw_side_by_side(picture, scored)
    assert picture.read_bytes().startswith(b"\x89PNG") and picture.stat().st_size > 20_000


def scored_with(folder: Path, load: float) -> Any:
    agents = {"ann": SimpleNamespace(kind=AgentKind.AR)}
    session = SimpleNamespace(agents=agents)
    record = {"machine": {"load": load, "cores": 2}}
    trial = SimpleNamespace(session=session, folders={"ann": folder}, record=record)
    return SimpleNamespace(policy="share", trial=trial)


def test_a_single_correction_is_a_curve(tmp_path: Path) -> None:
    """A line through one point is none, though the legend had it."""
    (tmp_path / "latency.csv").write_text("track_ms,corrected_ms\n5.0,\n6.0,80.0\n")
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axis = pyplot.subplots()
    _draw_latency(axis, scored_with(tmp_path, 0.0), "#000000")
    drawn = {line.get_label(): np.array(line.get_data()) for line in axis.lines}
    pyplot.close(figure)
    assert drawn["share: corrections (1)"].tolist() == [[80.0, 80.0], [0.0, 100.0]]
    assert drawn["share: poses (2)"].tolist() == [[5.0, 5.0, 6.0], [0.0, 50.0, 100.0]]


def test_a_busy_machine_is_told_of(tmp_path: Path) -> None:
    assert busy_note([scored_with(tmp_path, 0.4)]) == ""
    assert "load 25 on 2 cores" in busy_note([scored_with(tmp_path, 25.0)])
