"""The IMU check rejects glitches and accepts measurements."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from share.config import SequencerConfig
from share.sensors.imu_check import ImuCheck, ImuRange
from share.sensors.measurement import Measurement
from share.sensors.sequencer import FrameMerger, SequencerCounters, sequence_frames

STEP = 5_000_000
MOTION = Path(__file__).parents[3] / "shared" / "data" / "motion"


def walking(count: int = 400, seed: int = 0) -> np.ndarray:
    """Return gyro and accel (count, 6) at 200 Hz of a walk, with noise."""
    t, rng = np.arange(count)[:, None] * 0.005, np.random.default_rng(seed)
    gyro, accel = 0.8 * np.sin(9 * t + np.arange(3)), 3 * np.sin(12 * t + np.arange(3)) + [0, 0, 9.81]
    return np.hstack([gyro, accel]) + rng.normal(size=(count, 6)) * np.repeat([0.01, 0.1], 3)


def judged(values: np.ndarray, each: int = 10, step: int = STEP) -> tuple[np.ndarray, ImuCheck]:
    """Return which samples are accepted, in frames of so many."""
    check, stamps = ImuCheck(ImuRange()), np.arange(len(values)) * step
    parts = [
        check.valid_mask(stamps[k : k + each], values[k : k + each]) for k in range(0, len(values), each)
    ]
    return np.concatenate(parts), check


@pytest.mark.parametrize("each", [1, 2, 3, 10, 400])
@pytest.mark.parametrize(
    ("axis", "value"),
    [(0, 500.0), (1, -30.0), (2, 20.0), (0, 5.0), (3, 1e6), (4, -150.0), (5, 90.0), (0, np.nan), (3, np.inf)],
)
def test_a_single_spike_is_rejected_and_nothing_else(axis: int, value: float, each: int) -> None:
    for at in (100, 103, 109):  # at the beginning, in the middle and at the end of a frame
        values = walking()
        values[at, axis] = value
        good, check = judged(values, each)
        assert np.flatnonzero(~good).tolist() == [at]
        assert check.out_of_range + check.spikes == 1


@pytest.mark.parametrize("each", [1, 2, 3, 10, 400])
@pytest.mark.parametrize("step", [STEP, STEP // 2])
@pytest.mark.parametrize(
    "run",
    [
        [(0, 34.0), (0, 34.0)],
        [(3, 180.0), (3, 180.0)],
        [(5, -90.0), (4, 120.0)],
        [(1, -34.0), (1, 34.0), (1, -34.0)],
        [(2, 20.0), (3, -150.0), (4, 80.0)],
    ],
)
def test_two_or_three_spikes_in_a_row_are_rejected_and_nothing_else(
    run: list[tuple[int, float]], step: int, each: int
) -> None:
    for at in range(100, 110):  # everywhere in a frame, and over its end
        values = walking()
        for k, (axis, value) in enumerate(run):
            values[at + k, axis] = value
        good, check = judged(values, each, step)
        assert np.flatnonzero(~good).tolist() == list(range(at, at + len(run)))
        assert check.spikes == len(run)


def test_two_spikes_near_each_other_are_rejected() -> None:
    for at in range(100, 110):
        values = walking()
        values[[at, at + 1, at + 6, at + 7, at + 8], 4] = 150.0
        assert np.flatnonzero(~judged(values)[0]).tolist() == [at, at + 1, at + 6, at + 7, at + 8]


def test_a_spike_across_two_frames_is_rejected_from_its_second_sample_on() -> None:
    for at in range(100, 110):
        values = walking()
        values[[at, at + 1], 3] += 40.0  # at the end of a frame that may be a knock
        assert np.flatnonzero(~judged(values)[0]).tolist() == (
            [at, at + 1] if at < 108 else [110] * (at > 108)
        )


def test_longer_excursions_are_accepted() -> None:
    values = walking()
    values[100:104, 3:] += 150.0
    assert judged(values, each=400)[0].all()
    values = walking()
    values[100:103, 3:] += 150.0
    assert judged(values, 400, STEP // 2)[0].sum() == 397
    assert judged(values, 400, 2 * STEP)[0].all()  # 20 ms


def test_a_step_is_accepted() -> None:
    """A bump: all axes change from one sample to the next, and stay so."""
    values = walking()
    values[204:, :3] += 6.0
    values[204:, 3:] += 80.0
    assert judged(values)[0].all()


@pytest.mark.parametrize("each", [1, 2, 10])
def test_a_step_near_the_end_of_a_frame_costs_at_most_three_samples(each: int) -> None:
    for at in range(200, 210):
        values = walking()
        values[at:, 0] += 6.0
        values[at:, 3:] += 80.0 + 8 * np.random.default_rng(at).normal(size=(400 - at, 3))
        lost = np.flatnonzero(~judged(values, each)[0]).tolist()
        assert set(lost) <= set(range(at, at + 3))
        assert each != 10 or not lost or lost[-1] == 209


def test_shocks_and_vibration_are_accepted() -> None:
    rng, values = np.random.default_rng(1), walking()
    values[100:300, 3:] += 60 * rng.normal(size=(200, 3))  # a motor
    values[100:300, :3] += 2 * rng.normal(size=(200, 3))
    for at in (320, 350, 380):  # knocks that ring
        ring = np.exp(-np.arange(12) / 3) * np.cos(np.arange(12) * 2)
        values[at : at + 12, 3:] += 100 * ring[:, None]
        values[at : at + 12, :3] += 4 * ring[:, None]
    assert judged(values, each=400)[0].mean() > 0.995


def test_a_knock_loses_at_most_its_start_at_the_end_of_a_frame() -> None:
    ring = np.exp(-np.arange(12) / 3) * np.cos(np.arange(12) * 2)
    for at in range(100, 110):
        values = walking()
        values[at : at + 12, 3:] += 100 * ring[:, None]
        values[at : at + 12, :3] += 4 * ring[:, None]
        lost = np.flatnonzero(~judged(values)[0]).tolist()
        assert lost == ([109] if at == 109 else [])


def test_samples_across_a_gap_are_not_compared() -> None:
    values = walking()
    values[200:, 0] += 9.0
    check = ImuCheck(ImuRange())
    stamps = np.arange(400) * STEP
    stamps[200:] += 10**9
    assert (
        check.valid_mask(stamps[:200], values[:200]).all()
        and check.valid_mask(stamps[200:], values[200:]).all()
    )


def test_samples_out_of_range_are_rejected() -> None:
    values = walking()
    values[200:240, 0] = 18.0  # many: no spike
    check = ImuCheck(ImuRange(17.5, 39.3))
    assert np.flatnonzero(~check.valid_mask(np.arange(400) * STEP, values)).tolist() == list(range(200, 240))
    assert (check.out_of_range, check.spikes) == (40, 0)


RECORDED = sorted(MOTION.glob("*/*/imu0.csv"))


@pytest.mark.skipif(not RECORDED, reason="the recorded motions are not here")
@pytest.mark.parametrize("path", RECORDED, ids=lambda path: path.parent.name)
def test_recorded_samples_are_all_accepted(path: Path) -> None:
    table = np.loadtxt(path, delimiter=",")
    stamps, values = table[:, 0].astype(np.int64), table[:, 1:7]
    check, parts = ImuCheck(ImuRange(17.5, 180.0)), range(0, len(values), 10)
    assert all(check.valid_mask(stamps[k : k + 10], values[k : k + 10]).all() for k in parts)


# ---------------------------------------------------------------- in the sequencer


def bundles(values: np.ndarray) -> tuple[list, SequencerCounters]:
    samples = [Measurement("imu", k * STEP, tuple(row)) for k, row in enumerate(values)]
    images = [Measurement("cam0", k * 10 * STEP, f"image {k}") for k in range(len(values) // 10)]
    counters = SequencerCounters()
    both = sorted([*samples, *images], key=lambda m: m.stamp_ns)
    return list(
        sequence_frames(both, FrameMerger(("cam0", "imu"), 20.0, SequencerConfig(), counters))
    ), counters


def test_frames_lack_rejected_samples_and_count_them() -> None:
    values = walking()
    clean, counters = bundles(values)
    assert (counters.imu_out_of_range, counters.imu_spikes) == (0, 0)
    assert counters.imu_samples == 391
    np.testing.assert_array_equal(np.vstack([b.imu.gyro for b in clean]), values[:391, :3])
    values[105, 0], values[155, 3], values[207, 1] = 500.0, np.nan, 25.0
    spoiled, counters = bundles(values)
    assert (counters.imu_out_of_range, counters.imu_spikes, counters.imu_samples) == (2, 1, 388)
    assert [b.stamp_ns for b in spoiled] == [b.stamp_ns for b in clean]
    reported = np.concatenate([b.imu.stamps_ns for b in spoiled]) // STEP
    assert set(range(391)) - set(reported.tolist()) == {105, 155, 207}


def test_an_imu_with_rejected_samples_only_is_silent() -> None:
    values = walking()
    values[100:200] = np.nan
    _, counters = bundles(values)
    assert counters.imu_silent == 9 and counters.imu_out_of_range == 100
