"""Runs of IMU samples that no motion explains are rejected; true motion is not."""

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
    """Gyro and accel (count, 6) at 200 Hz of a walk, with noise."""
    t, rng = np.arange(count)[:, None] * 0.005, np.random.default_rng(seed)
    gyro = 0.8 * quickly * np.sin(9 * t + np.arange(3))
    accel = 3 * quickly * np.sin(12 * t + np.arange(3)) + [0, 0, 9.81]
    return np.hstack([gyro, accel]) + rng.normal(size=(count, 6)) * np.repeat([0.01, 0.1], 3)


def batch(values: np.ndarray, first: int = 0, step: int = STEP) -> ImuBatch:
    return ImuBatch((first + np.arange(len(values))) * step, values[:, :3], values[:, 3:])


def rejected(values: np.ndarray, each: int = 10, step: int = STEP) -> list[int]:
    """Numbers of the samples that are left out, in frames of so many."""
    breaks, kept = ImuOutlierDetector(), []
    for k in range(0, len(values), each):
        part = values[k : k + each]
        good = breaks.accepted_mask((k + np.arange(len(part))) * step, part)
        kept += [k + n for n in range(len(part)) if good is None or good[n]]
    assert breaks.rejected_count == len(values) - len(kept)
    return sorted(set(range(len(values))) - set(kept))


@pytest.mark.parametrize("each", [1, 10, 400])
@pytest.mark.parametrize("length", [1, 2, 6, 30])
@pytest.mark.parametrize(("axis", "by"), [(0, 3.0), (2, -30.0), (3, 40.0), (5, -150.0)])
def test_exactly_a_run_of_wrong_samples_is_rejected(axis: int, by: float, length: int, each: int) -> None:
    for at in (100, 107):
        values = walking()
        values[at : at + length, axis] += by
        assert rejected(values, each) == list(range(at, at + length))


@pytest.mark.parametrize("length", [4, 10, 30])
def test_a_run_of_any_values_is_rejected(length: int) -> None:
    values, rng = walking(), np.random.default_rng(3)
    values[203 : 203 + length] = rng.uniform(-1, 1, (length, 6)) * np.repeat([34.0, 150.0], 3)
    left = rejected(values)
    assert set(left) <= set(range(203, 203 + length))
    assert len(left) >= length - 1


@pytest.mark.parametrize("quickly", [1.0, 4.0])
@pytest.mark.parametrize("step", [STEP, STEP // 2, 2 * STEP])
def test_no_sample_of_a_walk_is_rejected(quickly: float, step: int) -> None:
    assert rejected(walking(4000, quickly=quickly * STEP / step), step=step) == []


def test_shaking_and_a_motor_are_accepted_after_their_start() -> None:
    values, rng = walking(1000), np.random.default_rng(1)
    values[200:600] += rng.normal(size=(400, 6)) * np.repeat([2.0, 60.0], 3)
    assert max(rejected(values), default=0) < 245  # 0.2 s, and what is right by chance
    t = np.arange(400)[:, None] * 0.005
    values = walking(1000)
    shake = np.minimum(1, t / 0.1) * np.sin(2 * np.pi * 6 * t)  # by hand, six times a second, 6 g
    values[200:600] += shake * np.repeat([8.0, 60.0], 3)
    assert rejected(values) == []


def test_a_lasting_change_is_accepted() -> None:
    values = walking()
    values[200:, :3] += 6.0
    values[200:, 3:] += 80.0
    left = rejected(values)
    assert left == list(range(200, left[-1] + 1)) and 35 <= len(left) <= 45


def test_a_gap_restarts_the_comparison() -> None:
    breaks, values = ImuOutlierDetector(), walking()
    values[200:, 0] += 9.0
    assert breaks.accepted_mask(np.arange(200) * STEP, values[:200]) is None
    assert breaks.accepted_mask(np.arange(400, 600) * STEP, values[200:]) is None


def test_rejected_samples_inflate_the_interval_of_their_frame() -> None:
    samples, values = ImuBuffer(), walking()
    values[104:108, 3] += 50.0
    samples.add(batch(values[:100]))
    assert samples.outliers.inflation(0, 100 * STEP) is None
    samples.add(batch(values[100:110], 100))
    inflation = samples.outliers.inflation(100 * STEP, 110 * STEP)
    assert inflation is not None and samples.outliers.rejected_count == 4
    assert inflation.rejected_axes.tolist() == [False] * 3 + [True, False, False]
    assert inflation.turn_rad == 0.0 and inflation.speed_m_s == pytest.approx(4 * 50 * 0.005, abs=0.2)
    assert samples.outliers.inflation(108 * STEP, 118 * STEP) is None
    assert not set(range(104, 108)) & set((samples.samples.stamps_ns // STEP).tolist())


def test_rejected_samples_inflate_one_frame_only() -> None:
    samples, values = ImuBuffer(), walking()
    values[110, 3] += 50.0  # the sample after the image's time that came with it
    samples.add(batch(values[:111]))
    at = 110 * STEP - 1_500_000
    assert samples.outliers.inflation(100 * STEP, at) is None
    assert samples.outliers.inflation(100 * STEP, 110 * STEP) is None
    samples.add(batch(values[111:121], 111))
    inflation = samples.outliers.inflation(at, at + 10 * STEP)
    assert inflation is not None and inflation.rejected_axes[3]
    assert samples.outliers.inflation(110 * STEP, 120 * STEP) is not None


def test_a_copy_with_later_samples_leaves_the_buffer_unchanged() -> None:
    samples, values = ImuBuffer(), walking()
    values[100:104, 0] += 20.0
    samples.add(batch(values[:98]))
    ahead = samples.extended(batch(values[98:110], 98))
    assert (ahead.outliers.rejected_count, samples.outliers.rejected_count) == (4, 0)
    assert samples.outliers.inflation(98 * STEP, 110 * STEP) is None
    samples.add(batch(values[98:110], 98))
    assert samples.outliers.rejected_count == 4


# ---------------------------------------------------------------- beginnings: the first, and after a gap

GAP = 30_000_000


def begun(
    values: np.ndarray, cuts: list[int], gap_at: int | None
) -> tuple[list[int], ImuOutlierDetector, ImuBuffer]:
    """Numbers of the samples that are rejected in the end; frames end before the numbers `cuts`. A gap
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
    assert samples.outliers.rejected_count == breaks.rejected_count == len(out)
    assert set(samples.samples.stamps_ns.tolist()) == set(np.delete(stamps, out).tolist())
    return out, breaks, samples


@pytest.mark.parametrize("count", [1, 4])
@pytest.mark.parametrize("gap_at", [None, 100])
@pytest.mark.parametrize(("axis", "by"), [(0, 1.5), (1, -30.0), (3, 20.0), (4, 150.0), (5, -60.0)])
def test_first_samples_that_contradict_the_next_are_rejected(
    axis: int, by: float, gap_at: int | None, count: int
) -> None:
    values, first = walking(130), gap_at or 0
    values[first : first + count, axis] += by
    assert begun(values, [first + 12, first + 24], gap_at)[0] == list(range(first, first + count))


@pytest.mark.parametrize("gap_at", [None, 100])
def test_a_wrong_sample_among_the_first_is_rejected(gap_at: int | None) -> None:
    rng, first = np.random.default_rng(4), gap_at or 0
    for length in (1, 3, 6):
        values = walking(130)
        at = first + int(rng.integers(3))
        values[at : at + length] = rng.uniform(-1, 1, (length, 6)) * np.repeat([34.0, 150.0], 3)
        assert begun(values, [first + 12], gap_at)[0] == list(range(at, at + length))


@pytest.mark.parametrize(("gap_at", "count", "by"), [(None, 1, 80.0), (None, 8, 80.0), (100, 8, 20.0)])
def test_samples_contradicted_by_the_next_frame_are_retracted(
    gap_at: int | None, count: int, by: float
) -> None:
    values, first, right = walking(130), gap_at or 0, 2 if count > 1 else 0
    values[first : first + count, [1, 5]] += [-by / 4, by]
    past = first + count + right  # the frame ends with them, or with two that are right
    believed_in_it = begun(values[:past], [], gap_at)[0]
    assert believed_in_it == list(range(first + count, past))
    out, breaks, samples = begun(values, [past, past + 13], gap_at)
    assert out == list(range(first, past))
    from_ns = past * STEP + (GAP if gap_at else 0)
    inflation = breaks.inflation(from_ns, from_ns + STEP)  # the filter has used them: inflate from now on
    assert inflation is not None and not inflation.rejected_axes.any()
    off = np.array([by / 4, by]) * (count * STEP + (GAP if gap_at else 0)) * 1e-9
    assert inflation.turn_rad == pytest.approx(min(off[0], 0.3), rel=0.2)
    assert inflation.speed_m_s == pytest.approx(min(off[1], 3.0), rel=0.2)
    assert samples.max_abs.max() < 20  # nor is it the end of a scale


@pytest.mark.parametrize(("count", "by"), [(1, 5.0), (1, 30.0), (8, 10.0)])
def test_a_short_chain_after_a_gap_is_compared_with_the_sample_before(count: int, by: float) -> None:
    values = walking(130)
    assert begun(values, [100, 100 + count], 100)[0] == []
    values[100 : 100 + count, 2] += by
    out, breaks, _ = begun(values, [100, 100 + count], 100)
    assert out == list(range(100, 100 + count)) and breaks.retracted_ns == []
    inflation = breaks.inflation(100 * STEP + GAP, (100 + count) * STEP + GAP)
    assert inflation is not None and inflation.rejected_axes.tolist() == [
        False,
        False,
        True,
        False,
        False,
        False,
    ]


def test_possible_samples_after_a_gap_inflate_for_its_duration() -> None:
    values = walking(104)
    values[100:, 2] += 4.0
    out, breaks, _ = begun(values, [100], 100)
    assert out == []
    inflation = breaks.inflation(99 * STEP, 99 * STEP + GAP)
    assert inflation is not None and not inflation.rejected_axes.any()
    assert inflation.turn_rad == pytest.approx(4.0 * (GAP + STEP) * 1e-9, rel=0.2)


def test_samples_of_a_slow_imu_are_accepted() -> None:
    values = walking(4000, quickly=3.0)[::8]  # 25 Hz
    assert rejected(values, 3, 8 * STEP) == []


@pytest.mark.parametrize("gap_at", [None, 100])
def test_no_first_sample_under_vibration_is_rejected(gap_at: int | None) -> None:
    for seed in range(10):
        values = walking(140, seed)
        values[:, 3:] += np.random.default_rng(seed).normal(size=(140, 3)) * 5.0
        assert begun(values, [5, 18, 31, 100, 104], gap_at)[0] == []


def test_a_copy_with_later_samples_retracts_nothing() -> None:
    samples, values = ImuBuffer(), walking(60)
    values[0, 3] += 80.0
    samples.add(batch(values[:1]))
    assert samples.extended(batch(values[1:10], 1)).outliers.rejected_count == 1
    assert (samples.outliers.rejected_count, len(samples.samples)) == (0, 1)
    samples.add(batch(values[1:10], 1))
    assert (samples.outliers.rejected_count, samples.samples.stamps_ns[0]) == (1, STEP)


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
def test_no_recorded_sample_is_rejected(path: Path) -> None:
    table = np.loadtxt(path, delimiter=",")
    stamps, values = table[:, 0].astype(np.int64), table[:, 1:7]
    breaks = ImuOutlierDetector()
    for k in range(0, len(values), 10):
        breaks.accepted_mask(stamps[k : k + 10], values[k : k + 10])
    assert breaks.rejected_count == 0


@pytest.mark.skipif(not RECORDED, reason="the recorded motions are not here")
@pytest.mark.parametrize("path", RECORDED, ids=lambda path: path.parent.name)
def test_no_recorded_sample_is_rejected_for_any_start_or_gap(path: Path) -> None:
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
