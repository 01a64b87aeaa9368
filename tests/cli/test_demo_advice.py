"""What `share demo` advises after a run."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from share.cli.demo import _advice


def score(has_met: bool) -> Any:
    return SimpleNamespace(joint=object() if has_met else None, agents=dict.fromkeys(("ar1", "ar2", "robot")))


def test_agents_that_did_not_meet_are_given_longer() -> None:
    assert _advice(score(False), 20.0, 0.1, 8) == [
        "no two agents met in 20 s; in a longer run they may: --seconds 40"
    ]
    assert _advice(score(True), 20.0, 0.1, 8) == []


def test_a_busy_machine_is_blamed_before_its_few_cores() -> None:
    (line,) = _advice(score(True), 20.0, 25.0, 2)
    assert line.startswith("other programs kept this machine busy (load 25 on 2 cores before the run)")
    (line,) = _advice(score(True), 20.0, 0.2, 2)
    assert line.startswith("3 agents and the edge shared 2 cores")
