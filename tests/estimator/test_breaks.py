"""Runs of samples that no motion leads to are doubted; what bodies do is not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from share.estimator.inertial.breaks import Breaks
from share.estimator.inertial.samples import Samples
from share.types import ImuBatch

STEP = 5_000_000
MOTION = Path(__file__).parents[3] / "shared" / "data" / "motion"


def walking(count: int = 400, seed: int = 0, quickly: float = 1.0) -> np.ndarray:
    """Gyro and accel (count, 6) at 200 Hz of somebody who walks, with noise."""
    t, rng = np.arange(count)[:, None] * 0.005, np.random.default_rng(seed)
    gyro = 0.8 * quickly * np.sin(9 * t + np.arange(3))
    accel = 3 * quickly * np.sin(12 * t + np.arange(3)) + [0, 0, 9.81]
    return np.hstack([gyro, accel]) + rng.normal(size=(count, 6)) * np.repeat([0.01, 0.1], 3)


def batch(values: np.ndarray, first: int = 0, step: int = STEP) -> ImuBatch:
    return ImuBatch((first + np.arange(len(values))) * step, values[:, :3], values[:, 3:])


def doubted(values: np.ndarray, each: int = 10, step: int = STEP) -> list[int]:
    """Numbers of the samples that are left out, in frames of so many."""
    breaks, kept = Breaks(), []
    for k in range(0, len(values), each):
        part = values[k : k + each]
        good = breaks.believed((k + np.arange(len(part))) * step, part)
        kept += [k + n for n in range(len(part)) if good is None or good[n]]
    assert breaks.count == len(values) - len(kept)
    return sorted(set(range(len(values))) - set(kept))


@pytest.mark.parametrize("each", [1, 3, 10, 400])
@pytest.mark.parametrize("length", [1, 2, 4, 6, 10, 30])
@pytest.mark.parametrize(("axis", "by"), [(0, 3.0), (2, -30.0), (3, 40.0), (5, -150.0)])
def test_a_run_of_wrong_samples_is_left_out_and_no_other(
    axis: int, by: float, length: int, each: int
) -> None:
    for at in (100, 107):
        values = walking()
        values[at : at + length, axis] += by
        assert doubted(values, each) == list(range(at, at + length))


@pytest.mark.parametrize("length", [4, 10, 30])
def test_a_run_of_anything_is_left_out(length: int) -> None:
    values, rng = walking(), np.random.default_rng(3)
    values[203 : 203 + length] = rng.uniform(-1, 1, (length, 6)) * np.repeat([34.0, 150.0], 3)
    left = doubted(values)
    assert set(left) <= set(range(203, 203 + length))
    assert len(left) >= length - 1


@pytest.mark.parametrize("quickly", [1.0, 4.0])
@pytest.mark.parametrize("step", [STEP, STEP // 2, 2 * STEP])
def test_of_a_walk_nothing_is(quickly: float, step: int) -> None:
    assert doubted(walking(4000, quickly=quickly * STEP / step), step=step) == []


def test_a_shake_and_a_motor_are_believed_once_they_have_begun() -> None:
    values, rng = walking(1000), np.random.default_rng(1)
    values[200:600] += rng.normal(size=(400, 6)) * np.repeat([2.0, 60.0], 3)
    assert max(doubted(values), default=0) < 245  # 0.2 s, and what is right by chance
    t = np.arange(400)[:, None] * 0.005
    values = walking(1000)
    shake = np.minimum(1, t / 0.1) * np.sin(2 * np.pi * 6 * t)  # by hand, six times a second, 6 g
    values[200:600] += shake * np.repeat([8.0, 60.0], 3)
    assert doubted(values) == []


def test_what_lasts_is_how_things_are() -> None:
    values = walking()
    values[200:, :3] += 6.0
    values[200:, 3:] += 80.0
    left = doubted(values)
    assert left == list(range(200, left[-1] + 1)) and 35 <= len(left) <= 45


def test_after_a_gap_nothing_is_held_against_what_was_before() -> None:
    breaks, values = Breaks(), walking()
    values[200:, 0] += 9.0
    assert breaks.believed(np.arange(200) * STEP, values[:200]) is None
    assert breaks.believed(np.arange(400, 600) * STEP, values[200:]) is None


def test_what_is_doubted_is_known_for_the_frame_that_it_is_in() -> None:
    samples, values = Samples(), walking()
    values[104:108, 3] += 50.0
    samples.add(batch(values[:100]))
    assert samples.doubt(0, 100 * STEP) is None
    samples.add(batch(values[100:110], 100))
    told = samples.doubt(100 * STEP, 110 * STEP)
    assert told is not None and samples.doubted == 4
    assert told.axes.tolist() == [False] * 3 + [True, False, False]
    assert told.turn == 0.0 and told.speed == pytest.approx(4 * 50 * 0.005, abs=0.2)
    assert samples.doubt(108 * STEP, 118 * STEP) is None
    assert not set(range(104, 108)) & set((samples.all.stamps_ns // STEP).tolist())


def test_what_is_doubted_is_of_one_frame_only() -> None:
    samples, values = Samples(), walking()
    values[110, 3] += 50.0  # the sample after the image's time that came with it
    samples.add(batch(values[:111]))
    at = 110 * STEP - 1_500_000
    assert samples.doubt(100 * STEP, at) is None
    assert samples.doubt(100 * STEP, 110 * STEP) is None
    samples.add(batch(values[111:121], 111))
    told = samples.doubt(at, at + 10 * STEP)
    assert told is not None and told.axes[3]
    assert samples.doubt(110 * STEP, 120 * STEP) is not None


def test_looking_ahead_changes_nothing() -> None:
    samples, values = Samples(), walking()
    values[100:104, 0] += 20.0
    samples.add(batch(values[:98]))
    ahead = samples.with_more(batch(values[98:110], 98))
    assert (ahead.doubted, samples.doubted) == (4, 0)
    samples.add(batch(values[98:110], 98))
    assert samples.doubted == 4


RECORDED = sorted(MOTION.glob("*/*/imu0.csv"))


@pytest.mark.skipif(not RECORDED, reason="the recorded motions are not here")
@pytest.mark.parametrize("path", RECORDED, ids=lambda path: path.parent.name)
def test_of_what_was_recorded_nothing_is(path: Path) -> None:
    table = np.loadtxt(path, delimiter=",")
    stamps, values = table[:, 0].astype(np.int64), table[:, 1:7]
    breaks = Breaks()
    for k in range(0, len(values), 10):
        breaks.believed(stamps[k : k + 10], values[k : k + 10])
    assert breaks.count == 0
