"""What the last seconds were like."""

from __future__ import annotations

import numpy as np
import pytest

from share.evaluator.odometer import Lately
from share.evaluator.recent import RECENT, Recent
from share.evaluator.scalars import NAMES

S = 1_000_000_000


def told(recent: Recent, stamp_ns: int, value: float, since_ns: int, **moved: float) -> dict[str, float]:
    lately = Lately(since_ns, moved.get("way_m", 0.0), moved.get("turn_rad", 0.0), 1.0)
    scalars = np.linspace(value, value + 0.7, len(NAMES), dtype=np.float32)
    return dict(
        zip(RECENT, recent.after(stamp_ns, scalars, moved.get("surprise", 0.0), lately).tolist(), strict=True)
    )


def test_of_one_keyframe_all_are_itself():
    one = told(Recent(), 0, 0.1, 0)
    for what in ("mean", "least", "most"):
        assert one[f"{what} brightness"] == pytest.approx(0.1)
        assert one[f"{what} tracking score"] == pytest.approx(0.8)


def test_what_was_worst_stays_until_the_window_has_passed():
    recent = Recent()
    told(recent, 0, 0.9, -5 * S)
    told(recent, S, 0.1, -4 * S)
    now = told(recent, 2 * S, 0.2, -3 * S)
    assert now["most brightness"] == pytest.approx(0.9)
    assert now["least brightness"] == pytest.approx(0.1)
    assert now["mean brightness"] == pytest.approx(0.4)
    later = told(recent, 6 * S, 0.3, S)
    assert later["most brightness"] == pytest.approx(0.3)
    assert later["least brightness"] == pytest.approx(0.1)  # at the window's very beginning


def test_surprise_is_told_as_it_is_and_as_it_was():
    recent = Recent()
    told(recent, 0, 0.5, -5 * S, surprise=100.0)
    now = told(recent, S, 0.5, -4 * S, surprise=0.0)
    assert (now["surprise"], now["most surprise"]) == pytest.approx((0, 1))
    assert now["mean surprise"] == pytest.approx(0.5)


def test_how_far_it_went_and_turned():
    moved = told(Recent(), 0, 0.5, 0, way_m=2.5, turn_rad=1.0)
    assert moved["way"] == pytest.approx(0.5)
    assert moved["turn"] == pytest.approx(0.2)
