"""Runs of samples that no motion leads to are doubted; what bodies do is not."""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from share.odometry.imu_outliers import ImuOutlierDetector
from share.odometry.imu_predictor import ImuBuffer
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
    breaks, kept = ImuOutlierDetector(), []
    for k in range(0, len(values), each):
        part = values[k : k + each]
        good = breaks.accepted_mask((k + np.arange(len(part))) * step, part)
        kept += [k + n for n in range(len(part)) if good is None or good[n]]
    assert breaks.rejected_count == len(values) - len(kept)
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
    breaks, values = ImuOutlierDetector(), walking()
    values[200:, 0] += 9.0
    assert breaks.accepted_mask(np.arange(200) * STEP, values[:200]) is None
    assert breaks.accepted_mask(np.arange(400, 600) * STEP, values[200:]) is None


def test_what_is_doubted_is_known_for_the_frame_that_it_is_in() -> None:
    samples, values = ImuBuffer(), walking()
    values[104:108, 3] += 50.0
    samples.add(batch(values[:100]))
    assert samples.inflation(0, 100 * STEP) is None
    samples.add(batch(values[100:110], 100))
    told = samples.inflation(100 * STEP, 110 * STEP)
    assert told is not None and samples.rejected_count == 4
    assert told.rejected_axes.tolist() == [False] * 3 + [True, False, False]
    assert told.turn_rad == 0.0 and told.speed_m_s == pytest.approx(4 * 50 * 0.005, abs=0.2)
    assert samples.inflation(108 * STEP, 118 * STEP) is None
    assert not set(range(104, 108)) & set((samples.samples.stamps_ns // STEP).tolist())


def test_what_is_doubted_is_of_one_frame_only() -> None:
    samples, values = ImuBuffer(), walking()
    values[110, 3] += 50.0  # the sample after the image's time that came with it
    samples.add(batch(values[:111]))
    at = 110 * STEP - 1_500_000
    assert samples.inflation(100 * STEP, at) is None
    assert samples.inflation(100 * STEP, 110 * STEP) is None
    samples.add(batch(values[111:121], 111))
    told = samples.inflation(at, at + 10 * STEP)
    assert told is not None and told.rejected_axes[3]
    assert samples.inflation(110 * STEP, 120 * STEP) is not None


def test_looking_ahead_changes_nothing() -> None:
    samples, values = ImuBuffer(), walking()
    values[100:104, 0] += 20.0
    samples.add(batch(values[:98]))
    ahead = samples.extended(batch(values[98:110], 98))
    assert (ahead.rejected_count, samples.rejected_count) == (4, 0)
    assert samples.inflation(98 * STEP, 110 * STEP) is None
    samples.add(batch(values[98:110], 98))
    assert samples.rejected_count == 4


# ---------------------------------------------------------------- beginnings: the first, and after a gap

GAP = 30_000_000


def begun(
    values: np.ndarray, cuts: list[int], gap_at: int | None
) -> tuple[list[int], ImuOutlierDetector, ImuBuffer]:
    """Numbers of the samples that are not believed in the end; frames end before the numbers `cuts`. A gap
    before number `gap_at`."""
    stamps = np.arange(len(values)) * STEP
    if gap_at is not None:
        stamps[gap_at:] += GAP
    breaks, samples, good = ImuOutlierDetector(), ImuBuffer(), dict.fromkeys(range(len(values)), True)
    for first, past in zip([0, *cuts], [*cuts, len(values)], strict=True):
        part = slice(first, past)
        said = breaks.accepted_mask(stamps[part], values[part])
        good |= {} if said is None else dict(zip(range(first, past), said.tolist(), strict=True))
        good |= dict.fromkeys(np.searchsorted(stamps, breaks.retracted_ns).tolist(), False)
        samples.add(ImuBatch(stamps[part], values[part, :3], values[part, 3:]))
    out = [k for k, is_good in good.items() if not is_good]
    assert samples.rejected_count == breaks.rejected_count == len(out)
    assert set(samples.samples.stamps_ns.tolist()) == set(np.delete(stamps, out).tolist())
    return out, breaks, samples


@pytest.mark.parametrize("count", [1, 2, 4])
@pytest.mark.parametrize("gap_at", [None, 100])
@pytest.mark.parametrize(("axis", "by"), [(0, 1.5), (1, -30.0), (3, 20.0), (4, 150.0), (5, -60.0)])
def test_the_first_samples_are_left_out_where_those_after_them_disagree(
    axis: int, by: float, gap_at: int | None, count: int
) -> None:
    values, first = walking(130), gap_at or 0
    values[first : first + count, axis] += by
    assert begun(values, [first + 12, first + 24], gap_at)[0] == list(range(first, first + count))


@pytest.mark.parametrize("gap_at", [None, 100])
def test_so_is_a_wrong_one_among_them_and_anything(gap_at: int | None) -> None:
    rng, first = np.random.default_rng(4), gap_at or 0
    for length in (1, 3, 6):
        values = walking(130)
        at = first + int(rng.integers(3))
        values[at : at + length] = rng.uniform(-1, 1, (length, 6)) * np.repeat([34.0, 150.0], 3)
        assert begun(values, [first + 12], gap_at)[0] == list(range(at, at + length))


@pytest.mark.parametrize(("gap_at", "count", "by"), [(None, 1, 80.0), (None, 8, 80.0), (100, 8, 20.0)])
def test_what_the_next_frame_outvotes_is_taken_back(gap_at: int | None, count: int, by: float) -> None:
    values, first, right = walking(130), gap_at or 0, 2 if count > 1 else 0
    values[first : first + count, [1, 5]] += [-by / 4, by]
    past = first + count + right  # the frame ends with them, or with two that are right
    believed_in_it = begun(values[:past], [], gap_at)[0]
    assert believed_in_it == list(range(first + count, past))
    out, breaks, samples = begun(values, [past, past + 13], gap_at)
    assert out == list(range(first, past))
    from_ns = past * STEP + (GAP if gap_at else 0)
    told = breaks.inflation(from_ns, from_ns + STEP)  # whoever has heard it is unsure from now on
    assert told is not None and not told.rejected_axes.any()
    off = np.array([by / 4, by]) * (count * STEP + (GAP if gap_at else 0)) * 1e-9
    assert told.turn_rad == pytest.approx(min(off[0], 0.3), rel=0.2)
    assert told.speed_m_s == pytest.approx(min(off[1], 3.0), rel=0.2)
    assert samples._max_abs.max() < 20  # nor is it the end of a scale


@pytest.mark.parametrize(("count", "by"), [(1, 5.0), (1, 30.0), (8, 10.0)])
def test_those_that_alone_came_after_a_gap_are_held_against_what_was_before(count: int, by: float) -> None:
    values = walking(130)
    assert begun(values, [100, 100 + count], 100)[0] == []
    values[100 : 100 + count, 2] += by
    out, breaks, _ = begun(values, [100, 100 + count], 100)
    assert out == list(range(100, 100 + count)) and breaks.retracted_ns == []
    told = breaks.inflation(100 * STEP + GAP, (100 + count) * STEP + GAP)
    assert told is not None and told.rejected_axes.tolist() == [False, False, True, False, False, False]


def test_where_they_may_be_right_the_filter_is_unsure_of_the_gap() -> None:
    values = walking(104)
    values[100:, 2] += 4.0
    out, breaks, _ = begun(values, [100], 100)
    assert out == []
    told = breaks.inflation(99 * STEP, 99 * STEP + GAP)
    assert told is not None and not told.rejected_axes.any()
    assert told.turn_rad == pytest.approx(4.0 * (GAP + STEP) * 1e-9, rel=0.2)


def test_an_imu_slower_than_that_is_believed() -> None:
    values = walking(4000, quickly=3.0)[::8]  # 25 Hz
    assert doubted(values, 3, 8 * STEP) == []


@pytest.mark.parametrize("gap_at", [None, 100])
def test_of_a_beginning_under_vibration_nothing_is_left_out(gap_at: int | None) -> None:
    for seed in range(10):
        values = walking(140, seed)
        values[:, 3:] += np.random.default_rng(seed).normal(size=(140, 3)) * 5.0
        assert begun(values, [5, 18, 31, 100, 104], gap_at)[0] == []


def test_looking_ahead_does_not_take_back() -> None:
    samples, values = ImuBuffer(), walking(60)
    values[0, 3] += 80.0
    samples.add(batch(values[:1]))
    assert samples.extended(batch(values[1:10], 1)).rejected_count == 1
    assert (samples.rejected_count, len(samples.samples)) == (0, 1)
    samples.add(batch(values[1:10], 1))
    assert (samples.rejected_count, samples.samples.stamps_ns[0]) == (1, STEP)


def test_time_is_linear_in_the_samples_of_a_frame() -> None:
    rng, spent = np.random.default_rng(0), []
    for count in (2_000, 16_000):
        wild = rng.normal(size=(count, 6)) * np.repeat([30.0, 150.0], 3)
        stamps = np.sort(rng.choice(66_000_000, count, replace=False)) + 10**9
        breaks = ImuOutlierDetector()
        breaks.accepted_mask(stamps[0] + np.arange(-20, 0) * STEP, np.zeros((20, 6)))
        began = time.process_time()
        breaks.accepted_mask(stamps, wild)
        spent.append(time.process_time() - began)
        assert breaks.inflation(0, 2**62) is not None
    assert spent[1] < 24 * spent[0]  # 8 times as many; it would be 64


RECORDED = sorted(MOTION.glob("*/*/imu0.csv"))


@pytest.mark.skipif(not RECORDED, reason="the recorded motions are not here")
@pytest.mark.parametrize("path", RECORDED, ids=lambda path: path.parent.name)
def test_of_what_was_recorded_nothing_is(path: Path) -> None:
    table = np.loadtxt(path, delimiter=",")
    stamps, values = table[:, 0].astype(np.int64), table[:, 1:7]
    breaks = ImuOutlierDetector()
    for k in range(0, len(values), 10):
        breaks.accepted_mask(stamps[k : k + 10], values[k : k + 10])
    assert breaks.rejected_count == 0


@pytest.mark.skipif(not RECORDED, reason="the recorded motions are not here")
@pytest.mark.parametrize("path", RECORDED, ids=lambda path: path.parent.name)
def test_of_what_was_recorded_nothing_is_wherever_it_begins_or_has_gaps(path: Path) -> None:
    table = np.loadtxt(path, delimiter=",")
    stamps, values, rng = table[:, 0].astype(np.int64), table[:, 1:7], np.random.default_rng(7)
    for first in rng.integers(len(stamps) - 100, size=40).tolist():
        breaks, lost = ImuOutlierDetector(), np.zeros(100, np.bool_)
        gap = int(rng.integers(5, 12))
        lost[40 : 40 + gap] = True
        at, of = stamps[first : first + 100][~lost], values[first : first + 100][~lost]
        cuts = [0, *range(int(rng.integers(1, 14)), len(at), 13), len(at)]
        for k, past in pairwise(cuts):
            breaks.accepted_mask(at[k:past], of[k:past])
        assert breaks.rejected_count == 0
