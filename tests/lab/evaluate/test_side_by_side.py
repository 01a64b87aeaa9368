"""Two policies on the same recordings, side by side."""

from __future__ import annotations

from pathlib import Path

import pytest

from share.config import Config
from share.lab.evaluate.real_time import RunOptions
from share.lab.evaluate.side_by_side import ScoredTrial, comparison_rows, draw_side_by_side, headline
from share.lab.evaluate.trial import run_trial
from share.recordings.session import read_session

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
