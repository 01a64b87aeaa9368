"""A run over time, from files of known content."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

from share.lab.evaluate.scoring import merge_locations, traces
from share.recordings.trajectory import Trajectory, format_tum, read_tum

S = 1_000_000_000


@pytest.fixture
def trial(tmp_path):
    """Ann goes a metre a second for ten seconds, Bob half a metre."""
    session = tmp_path / "session"
    (session / "truth").mkdir(parents=True)
    for name, speed in (("ann", 1.0), ("bob", 0.5)):
        seconds = np.arange(11)
        T = np.tile(np.eye(4), (11, 1, 1))
        T[:, 0, 3] = speed * seconds
        (session / "truth" / f"{name}.tum").write_text(format_tum(Trajectory(5 * S + seconds * S, T)))
    edge = tmp_path / "run" / "edge"
    edge.mkdir(parents=True)
    series = {"ann": {"t_s": [1.0, 2.0], "qoe": [0.5, None], "rate_hz": [None, 2.5]}}
    (edge / "edge.json").write_text(json.dumps({"series": series}))
    events = [
        {"t_s": 2.0, "event": "agent joined"},
        {"t_s": 2.5, "event": "agent joined"},
        {"t_s": 4.0, "event": "loop accepted", "agent": "ann"},
        {"t_s": 5.0, "event": "loop refused", "agent": "ann"},
        {"t_s": 6.0, "event": "maps merged", "agent": "bob"},
        {"t_s": 99.0, "event": "loop accepted", "agent": "ann"},
    ]
    (edge / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events))
    agents = {"ann": SimpleNamespace(clock_offset_ns=0), "bob": SimpleNamespace(clock_offset_ns=0)}
    return SimpleNamespace(
        folder=tmp_path / "run",
        session=SimpleNamespace(folder=session, agents=agents),
        options=SimpleNamespace(virtual=False),
    )


def test_corrections_over_time(trial):
    found = traces(trial)
    assert found["ann"].seconds.tolist() == [1.0, 2.0]
    assert np.array_equal(found["ann"].qoe, [0.5, np.nan], equal_nan=True)
    assert np.array_equal(found["ann"].rate_hz, [np.nan, 2.5], equal_nan=True)
    assert len(found["bob"].seconds) == 0  # nobody evaluated Bob


def test_merges_are_located_by_the_path_of_all_agents(trial):
    assert merge_locations(trial).metres.tolist() == pytest.approx([2 * 1.5, 4 * 1.5, 15.0])
    assert merge_locations(trial).xy["ann"].tolist() == [[2.0, 0.0], [10.0, 0.0]]
    assert merge_locations(trial).xy["bob"].tolist() == [[2.0, 0.0]]


def test_start_times_count_in_virtual_time_only(trial):
    bob = trial.session.folder / "truth" / "bob.tum"
    later = read_tum(bob)
    bob.write_text(format_tum(Trajectory(later.stamps_ns + 103 * S, later.T)))
    trial.session.agents["bob"].clock_offset_ns = 100 * S  # by the session's clock 3 s after Ann
    assert merge_locations(trial).metres.tolist() == pytest.approx([2 * 1.5, 4 * 1.5, 15.0])
    trial.options.virtual = True
    assert merge_locations(trial).metres.tolist() == pytest.approx([2.0, 4 + 0.5, 15.0])
