"""Error estimates of agents beside the true errors."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from share.lab.evaluate.scoring import AgentScore, SessionScore
from share.metrics.ate import Ate, JointAte
from share.recordings.trajectory import Trajectory

TOOLS = Path(__file__).resolve().parents[2] / "tools" / "experiments"
S = 1_000_000_000


@pytest.fixture(scope="module")
def tool():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(TOOLS)
        yield importlib.import_module("measure_error_estimates")


@pytest.fixture
def trial(tool, tmp_path, monkeypatch):
    """ann stands still; after 5 s it joins the map, where its pose moves 1 cm a second away from where it is.
    The edge counts from 10 s before she joined it."""
    stamps_ns = (100 + np.arange(11)) * S
    T = np.tile(np.eye(4), (11, 1, 1))
    reported = T.copy()
    reported[:, 1, 3] = 0.01 * np.arange(11)
    score = AgentScore({}, None, Trajectory(stamps_ns[5:], reported[5:]), Trajectory(stamps_ns, T))
    whole = Ate(0.0, 0.0, 0.0, 0.0, 11, np.eye(4))
    monkeypatch.setattr(
        tool, "score_session", lambda *_: SessionScore({"ann": score}, JointAte(whole, {"ann": whole}))
    )
    series = {"t_s": [12.0, 16.0, 17.5, 19.0, 30.0], "error_cm": [0.1, 3.0, 7.5, None, 1.0]}
    (tmp_path / "edge").mkdir()
    (tmp_path / "edge" / "edge.json").write_text(json.dumps({"series": {"ann": series}}))
    (tmp_path / "edge" / "events.jsonl").write_text('{"t_s": 10.0, "event": "agent joined"}\n')
    session = SimpleNamespace(agents={"ann": SimpleNamespace(kind="ar")})
    return SimpleNamespace(folder=tmp_path, folders={}, session=session)


def test_estimates_are_paired_with_the_true_error_of_their_time(tool, trial):
    [pairs] = tool.estimated_and_true(trial)
    assert pairs.kind == "ar"
    assert pairs.estimated_cm.tolist() == [3.0, 7.5]  # in the map, and with an estimate
    assert pairs.true_cm.tolist() == pytest.approx([6.0, 7.5])


def test_row_compares_estimated_and_true_errors(tool):
    one = tool.Pairs("ar", np.array([1.0, 2.0]), np.array([2.0, 1.0]))
    other = tool.Pairs("ar", np.array([3.0, 4.0]), np.array([8.0, 9.0]))
    row = dict(zip(tool.HEAD[1:], tool.figures([one, other]), strict=True))
    assert row == {
        "runs": "2",
        "N": "4",
        "estimated, cm": "2.74",
        "true, cm": "6.12",
        "true / estimated": "2.12",
        "within twice, %": "50",
        "rank": "0.80",
        "of runs": "1.00",
    }


def test_folder_without_a_run_is_refused(tool, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["measure_error_estimates", str(tmp_path)])
    assert tool.main() == 2
    assert "give a folder by `share evaluate`" in capsys.readouterr().err
