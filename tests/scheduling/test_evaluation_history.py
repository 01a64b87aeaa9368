"""The newest rows of a table."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from share.config import ControlConfig
from share.scheduling.policies import RateScheduler
from share.timing import RingBuffer
from share.types import AgentKind
from share.wire.messages import Evaluation


@pytest.mark.parametrize("n", [0, 1, 4, 5, 6, 11, 23])
def test_the_newest_rows_are_told_in_order(n: int) -> None:
    history = RingBuffer(3, 5)
    rows = [(float(k), None if k % 3 else k / 7, -k) for k in range(n)]
    for row in rows:
        history.add(row)
    assert len(history) == min(n, 5)
    for k in range(3):
        assert history.column(k) == [row[k] for row in rows[-5:]]


def test_a_row_of_another_width_is_refused() -> None:
    with pytest.raises(ValueError, match="2 numbers, expected 3"):
        RingBuffer(3, 5).add((1.0, 2.0))


def test_what_is_remembered_of_an_agent_takes_little_memory() -> None:
    """5000 evaluations were 1.1 MB of objects an agent: the edge grew for an hour."""
    schedule, draw = RateScheduler(ControlConfig(), "share"), np.random.default_rng(1)
    told = [Evaluation(k, float(d), float(e)) for k, (d, e) in enumerate(draw.random((6000, 2)))]
    schedule.evaluate("ann", AgentKind.AR, told[0], 0, 0.0)
    tracemalloc.start()
    for k, one in enumerate(told):
        schedule.evaluate("ann", AgentKind.AR, one, k * 10**9, k + 0.5)
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown < 450_000  # a free list of the interpreter among it
    series = schedule.series("ann")
    assert series["t_s"] == [k + 0.5 for k in range(1000, 6000)]
    assert series["delay_ms"] == [round(one.delay_ms, 4) for one in told[1000:]]
