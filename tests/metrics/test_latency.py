import json
import math

import numpy as np
import pytest

from share.metrics.frame_log import ReplayQueue, latency, summary


def test_mean_is_over_the_multiset_of_both():
    found = latency([5.0, 15.0, 25.0, 10.0], [math.nan, 100.0, math.nan, 45.0])
    assert found.latency_ms.n == 6
    assert found.latency_ms.mean == pytest.approx(200 / 6)
    assert found.track_ms.mean == pytest.approx(55 / 4)
    assert found.corrected_ms.n == 2
    assert found.over_20ms == 0.25  # a late correction is not a late frame


def test_percentiles():
    s = summary(np.arange(101.0))
    assert (s.n, s.p50, s.p95, s.p99, s.max) == (101, 50.0, 95.0, 99.0, 100.0)


def test_missing_values_are_null_and_nan_is_refused():
    assert json.loads(json.dumps(summary([]).report(), allow_nan=False)) == {
        "n": 0, "mean": None, "p50": None, "p95": None, "p99": None, "max": None
    }  # fmt: skip
    with pytest.raises(ValueError, match="finite"):
        latency([1.0, math.nan], [])


def test_frame_waits_for_earlier_work():
    queue = ReplayQueue()
    assert queue.wait_ms(5) == 0
    queue.finish_frame(5, 40.0)
    assert queue.wait_ms(5 + 30_000_000) == pytest.approx(10)
    assert queue.wait_ms(5 + 50_000_000) == 0


def test_delay_grows_if_work_exceeds_the_frame_period():
    queue = ReplayQueue()
    for k in range(60):
        stamp = k * 33_000_000
        queue.finish_frame(stamp, queue.wait_ms(stamp) + 50)
    assert queue.wait_ms(60 * 33_000_000) == pytest.approx(60 * 17)
